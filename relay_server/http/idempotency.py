"""The same request twice is done once (draft-ietf-httpapi-idempotency-key-header): by a key that its sender makes up.

A client that has got no answer does not know whether what it asked for was done. Sent again with the same key, it is
given the answer of the first time, or waits for it.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Coroutine
from typing import Any, NamedTuple

from twisted.internet.defer import Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol.errors import Invalid, NotFound, PeerError, Refused, SwitchboardError, Unavailable
from relay_protocol.limits import MIB
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.resources.goals import GoalOwner

KEY_HEADER = "idempotency-key"

KEY = 255
"""Longest key, characters."""

KEPT_SECONDS = 600.0
"""An answer is kept for so long."""

KEYS = 256
ANSWERS_BYTES = 4 * MIB
"""Of one user: the answers that are longest known go first, the newest stays."""

NOTHING_DONE = (Refused, Invalid, NotFound, PeerError, Unavailable)
"""What was answered so may be tried again with the same key."""

_QUOTED = re.compile(r'"((?:[ !#-\[\]-~]|\\["\\])*)"')
_PLAIN = re.compile(r"[!-~]+")


class KeyReused(Refused):
    """A key that stands for another request."""

    code = "key_reused"


class StoredReply(NamedTuple):
    """What was answered.

    :param body: JSON; empty for none
    :param location: where to go on, or empty
    """

    status: int
    body: bytes = b""
    location: str = ""


class Target(NamedTuple):
    """What a key is for: it means nothing anywhere else.

    :param address: what is asked, of the robot
    """

    owner: GoalOwner
    robot: str
    address: str
    key: str


def key_in(values: list[str]) -> str | None:
    """The key of a request: a string of RFC 9651 section 3.3.3, in quotes; without them as it is.

    :param values: of all header fields of that name
    :raises Invalid: more than one, or none that can be
    """
    if not values:
        return None
    text = values[0].strip(" \t")
    quoted = _QUOTED.fullmatch(text)
    key = re.sub(r"\\(.)", r"\1", quoted[1]) if quoted else text
    if len(values) > 1 or not key or not (quoted or (_PLAIN.fullmatch(text) and not text.startswith('"'))):
        raise Invalid(f"'{KEY_HEADER}' must be there once, and be a string of printable ASCII characters")
    if len(key) > KEY:
        raise Invalid(f"'{KEY_HEADER}' may have {KEY} characters at most")
    return key


class _Known:
    """One request: under way, or answered."""

    def __init__(self, digest: bytes) -> None:
        self.digest = digest
        self.outcome: StoredReply | BaseException | None = None
        self.waiting: list[Deferred[StoredReply]] = []
        self.forgetting: Timer | None = None

    @property
    def size(self) -> int:
        """Bytes that are kept of it."""
        return len(self.outcome.body) if isinstance(self.outcome, StoredReply) else 0

    def reply(self) -> Deferred[StoredReply]:
        """What it is answered, when it is; who gives up waiting ends nothing."""
        waiting: Deferred[StoredReply] = Deferred(self._given_up)
        self.waiting.append(waiting)
        if self.outcome is not None:
            self.tell()
        return waiting

    def tell(self) -> None:
        """Tell all who wait."""
        waiting, self.waiting = self.waiting, []
        for each in waiting:
            if isinstance(self.outcome, BaseException):
                each.errback(Failure(self.outcome.with_traceback(None)))
            elif self.outcome is not None:
                each.callback(self.outcome)

    def _given_up(self, waiting: Deferred[StoredReply]) -> None:
        self.waiting.remove(waiting)


class Idempotency:
    """Requests that were sent with a key, and what they were answered."""

    log = Logger()

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._of: dict[int, dict[Target, _Known]] = {}
        """By user; those that are answered behind those that are under way, in the order of their answers."""

    async def once(
        self,
        target: Target,
        body: bytes,
        work: Callable[[], Coroutine[Deferred[Any], Any, StoredReply]],
        may: Callable[[], Coroutine[Deferred[Any], Any, None]],
    ) -> StoredReply:
        """Do something unless it was done already. It is done to its end, also when who asked for it has left.

        :param body: of the request; another one is another request
        :param may: raises what keeps the asker from being given the answer of an earlier request
        :raises KeyReused: the key stands for a request with another body
        :raises Unavailable: too many requests of the user are under way
        :raises SwitchboardError: as ``work`` did
        """
        digest = hashlib.sha256(body).digest()
        known = self._of.get(target.owner.user, {}).get(target)
        if known is None:
            known = self._begin(target, digest, work)
        elif known.digest != digest:
            raise KeyReused(f"this '{KEY_HEADER}' was sent with another body; make up a new one")
        else:
            await may()
        return await known.reply()

    def _begin(
        self,
        target: Target,
        digest: bytes,
        work: Callable[[], Coroutine[Deferred[Any], Any, StoredReply]],
    ) -> _Known:
        mine = self._of.get(target.owner.user, {})
        if sum(each.outcome is None for each in mine.values()) >= KEYS:
            raise Unavailable(f"{KEYS} requests of yours with an '{KEY_HEADER}' are under way already")
        known = _Known(digest)
        self._of.setdefault(target.owner.user, {})[target] = known
        running = Deferred.fromCoroutine(work())
        running.addBoth(self._answered, target, known)
        return known

    def _answered(self, outcome: StoredReply | Failure, target: Target, known: _Known) -> None:
        known.outcome = outcome.value if isinstance(outcome, Failure) else outcome
        self._remove(target)
        if isinstance(outcome, Failure) and not known.waiting and not outcome.check(SwitchboardError):
            self.log.failure("what nobody waits for any more has failed", outcome)
        if not isinstance(known.outcome, NOTHING_DONE):
            mine = self._of.setdefault(target.owner.user, {})
            mine[target] = known
            known.forgetting = self._clock.callLater(KEPT_SECONDS, self._remove, target)
            self._see_room(mine)
        known.tell()

    def _see_room(self, mine: dict[Target, _Known]) -> None:
        answered = [target for target, known in mine.items() if known.outcome is not None]
        size = sum(known.size for known in mine.values())
        for target in answered[:-1]:
            if len(mine) <= KEYS and size <= ANSWERS_BYTES:
                return
            size -= mine[target].size
            self._remove(target)

    def _remove(self, target: Target) -> None:
        mine = self._of.get(target.owner.user, {})
        known = mine.pop(target, None)
        if known is not None:
            cancel(known.forgetting)
        if not mine:
            self._of.pop(target.owner.user, None)
