"""Idempotency keys (draft-ietf-httpapi-idempotency-key-header): a request that is sent twice is carried out once.

A client without an answer cannot know whether its request was carried out. If it sends the request again with the same
key, it gets the first answer, or waits for it.
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
from relay_server.http.endpoint import ApiRequest
from relay_server.resources.goals import GoalOwner

KEY_HEADER = "idempotency-key"

KEY = 255
"""Longest key, characters."""

KEPT_SECONDS = 600.0
"""Seconds for which an answer is kept."""

KEYS = 256
ANSWERS_BYTES = 4 * MIB
"""Most keys, and most bytes of answers, of one user. The oldest answers go first; the newest stays."""

NOTHING_DONE = (Refused, Invalid, NotFound, PeerError, Unavailable)
"""Errors after which the same key may be used again: nothing was carried out."""

_QUOTED = re.compile(r'"((?:[ !#-\[\]-~]|\\["\\])*)"')
_PLAIN = re.compile(r"[!-~]+")


class KeyReused(Refused):
    """The key was used for another request."""

    code = "key_reused"


class StoredReply(NamedTuple):
    """A stored answer.

    :param body: JSON; empty for none
    :param location: the ``Location`` header, or empty
    """

    status: int
    body: bytes = b""
    location: str = ""


class Target(NamedTuple):
    """The scope of a key: the same key at another address is another key.

    :param address: path of the request
    """

    owner: GoalOwner
    robot: str
    address: str
    key: str


def key_in(values: list[str]) -> str | None:
    """The key of a request: a quoted string of RFC 9651 section 3.3.3, or a text without quotes.

    :param values: of all header fields of that name
    :raises Invalid: there are several, or the key is not valid
    """
    if not values:
        return None
    text = values[0].strip(" \t")
    quoted = _QUOTED.fullmatch(text)
    key = re.sub(r"\\(.)", r"\1", quoted[1]) if quoted else text
    if len(values) > 1 or not key or not (quoted or (_PLAIN.fullmatch(text) and not text.startswith('"'))):
        raise Invalid(f"'{KEY_HEADER}' must be sent once, as a string of printable ASCII characters")
    if len(key) > KEY:
        raise Invalid(f"'{KEY_HEADER}' may have at most {KEY} characters, not {len(key)}")
    return key


class _Known:
    """One request that is running or answered."""

    def __init__(self, digest: bytes) -> None:
        self.digest = digest
        self.outcome: StoredReply | BaseException | None = None
        self.waiting: list[Deferred[StoredReply]] = []
        self.forgetting: Timer | None = None

    @property
    def size(self) -> int:
        """Bytes of the stored answer."""
        return len(self.outcome.body) if isinstance(self.outcome, StoredReply) else 0

    def reply(self) -> Deferred[StoredReply]:
        """The answer, now or later. Cancelling the deferred does not end the request."""
        waiting: Deferred[StoredReply] = Deferred(self._given_up)
        self.waiting.append(waiting)
        if self.outcome is not None:
            self.answer_all()
        return waiting

    def answer_all(self) -> None:
        """Give the answer to all that wait for it."""
        waiting, self.waiting = self.waiting, []
        for each in waiting:
            if isinstance(self.outcome, BaseException):
                each.errback(Failure(self.outcome.with_traceback(None)))
            elif self.outcome is not None:
                each.callback(self.outcome)

    def _given_up(self, waiting: Deferred[StoredReply]) -> None:
        self.waiting.remove(waiting)


class Idempotency:
    """Requests that were sent with a key, and their answers."""

    log = Logger()

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._of: dict[int, dict[Target, _Known]] = {}
        """By user: first the running requests, then the answered ones in the order of their answers."""

    async def once(
        self,
        target: Target,
        body: bytes,
        work: Callable[[], Coroutine[Deferred[Any], Any, StoredReply]],
        may: Callable[[], Coroutine[Deferred[Any], Any, None]],
    ) -> StoredReply:
        """Carry out a request unless that was done already. It completes even if the sender disconnects.

        :param body: body of the request
        :param may: raises an error if the sender may not get the answer of the earlier request
        :raises KeyReused: the key was used with another body
        :raises Unavailable: too many requests of the user are running
        :raises SwitchboardError: as ``work``
        """
        digest = hashlib.sha256(body).digest()
        known = self._of.get(target.owner.user, {}).get(target)
        if known is None:
            known = self._begin(target, digest, work)
        elif known.digest != digest:
            raise KeyReused(f"this '{KEY_HEADER}' was sent with another body; use a new key")
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
            raise Unavailable(
                f"{KEYS} of your requests with an '{KEY_HEADER}' are running already; wait until one has ended"
            )
        known = _Known(digest)
        self._of.setdefault(target.owner.user, {})[target] = known
        running = Deferred.fromCoroutine(work())
        running.addBoth(self._answered, target, known)
        return known

    def _answered(self, outcome: StoredReply | Failure, target: Target, known: _Known) -> None:
        known.outcome = outcome.value if isinstance(outcome, Failure) else outcome
        self._remove(target)
        if isinstance(outcome, Failure) and not known.waiting and not outcome.check(SwitchboardError):
            self.log.failure("a request failed after its sender had disconnected", outcome)
        if not isinstance(known.outcome, NOTHING_DONE):
            mine = self._of.setdefault(target.owner.user, {})
            mine[target] = known
            known.forgetting = self._clock.callLater(KEPT_SECONDS, self._remove, target)
            self._see_room(mine)
        known.answer_all()

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


async def once(
    memory: Idempotency,
    request: ApiRequest,
    robot: str,
    work: Callable[[], Coroutine[Deferred[Any], Any, StoredReply]],
    may: Callable[[], Coroutine[Deferred[Any], Any, None]],
) -> StoredReply:
    """Carry out a request, unless that was already done for the same key.

    :param robot: robot of the path, or empty
    :param may: raises an error if the sender may not get the answer of the earlier request
    :raises SwitchboardError: as ``work``; also for an invalid key, or one of a different request
    """
    key = key_in(request.http.requestHeaders.getRawHeaders(KEY_HEADER, []))
    if key is None:
        return await work()
    address = request.http.path.decode("ascii", "replace")
    target = Target(GoalOwner.of(request.principal), robot, address, key)
    return await memory.once(target, request.content(), work, may)
