"""Whom administrators ask over HTTP: each for his own realm, and what he changed holds before he is answered."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

from sqlalchemy.orm import Session
from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from relay_server.access import Principal
from relay_server.common.clock import shield
from relay_server.common.database import AsyncDatabase
from relay_server.common.token_bucket import Buckets
from relay_server.realms import robots
from relay_server.realms.limits import (
    CHANGES_A_SECOND,
    CHANGES_AT_ONCE,
    PASSWORDS_AT_ONCE,
    PATTERNS_A_CHANGE,
    REALMS,
)
from relay_server.realms.realm_change import RealmChangeTransaction, see_administrator
from relay_server.recordings.recordings import Recordings

P = ParamSpec("P")
T = TypeVar("T")


class TooManyChanges(Refused):
    """A realm is changed too much; this may be tried again after ``retry_after`` seconds."""

    code = "too_often"

    def __init__(self, retry_after: float) -> None:
        super().__init__("this realm is changed too often; try again in a moment")
        self.retry_after = retry_after


class Hashing(Protocol):
    """Who hashes passwords; see :class:`relay_server.auth.authenticator.Authenticator`."""

    async def new_hash(self, password: str) -> str:
        """What may be stored of a new password."""


class RealmService:
    """See the module's text. The functions it carries out are those of ``people`` and ``machines``.

    :param take_up: has the relay look at the database; what was revoked is cut then
    :param robots_port: where robots dial
    :param wall: Unix time in seconds
    :param seconds: a monotonic clock
    """

    log = Logger()

    def __init__(
        self,
        store: AsyncDatabase,
        hashing: Hashing,
        recordings: Recordings,
        take_up: Callable[[], Awaitable[None]],
        robots_port: Callable[[], int],
        wall: Callable[[], float] = time.time,
        seconds: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store
        self._hashing = hashing
        self._recordings = recordings
        self._take_up = take_up
        self._robots_port = robots_port
        self._wall = wall
        self._passwords = 0
        self._realms = Buckets(CHANGES_A_SECOND, CHANGES_AT_ONCE, REALMS, seconds)
        # Nobody uses up alone what others need to shut him out.
        self._tokens = Buckets(CHANGES_A_SECOND / 2, CHANGES_AT_ONCE / 2, REALMS, seconds)

    def admit(self, principal: Principal, *, changes: bool = False) -> None:
        """Let an administrator in.

        :param changes: he is about to change something, which is counted
        :raises Refused: he is none, or the realm is changed too much
        """
        see_administrator(principal)
        if changes:
            self.count(principal)

    def count(self, principal: Principal, patterns: int = 0) -> None:
        """Count a change that somebody who was admitted is about to make.

        :param patterns: of a right that he gives
        :raises Refused: the realm is changed too much; then nothing is counted
        """
        cost = 1 + patterns / PATTERNS_A_CHANGE
        own, all_ = self._tokens.of(principal.token_id), self._realms.of(principal.realm)
        wait = max(own.wait_for(cost), all_.wait_for(cost))
        if wait > 0:
            raise TooManyChanges(wait)
        own.take(cost)
        all_.take(cost)

    async def read(
        self,
        principal: Principal,
        query: Callable[Concatenate[Session, str, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> T:
        """Look at the realm of somebody who was admitted.

        :param query: gets a session and the name of the realm before its arguments
        :raises Unavailable: the database can't be asked
        """
        return await self._store.read(query, principal.realm, *args, **kwargs)

    async def new_hash(self, principal: Principal, password: str) -> str:
        """What may be stored of a new password that somebody gives who was admitted.

        :raises Refused: his token is not for this
        :raises Invalid: it breaks the rules
        :raises Unavailable: too many are hashed now
        """
        principal.needs_whole()
        if self._passwords >= PASSWORDS_AT_ONCE:
            raise Unavailable("too many passwords are set now; try again in a moment")
        # A thread hashes on when who asked has left: the place is taken for as long.
        return await shield(Deferred.fromCoroutine(self._hash(password)))

    async def _hash(self, password: str) -> str:
        self._passwords += 1
        try:
            return await self._hashing.new_hash(password)
        finally:
            self._passwords -= 1

    async def change(
        self,
        principal: Principal,
        origin: str,
        work: Callable[Concatenate[RealmChangeTransaction, P], T],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> T:
        """Change the realm of somebody who was admitted, and have the relay go by it: also when he does not wait.

        :param origin: his address
        :raises SwitchboardError: it can't be done, and nothing was
        """

        def carry_out(session: Session) -> T:
            return work(RealmChangeTransaction(session, principal, origin, self._wall), *args, **kwargs)

        return await shield(Deferred.fromCoroutine(self._changed(carry_out)))

    def enrolling(
        self, work: Callable[Concatenate[RealmChangeTransaction, P], dict[str, Any]]
    ) -> Callable[Concatenate[RealmChangeTransaction, P], dict[str, Any]]:
        """Work that gives a robot a code; told with it is at which port of the relay it enrols."""

        def carry_out(change: RealmChangeTransaction, /, *args: P.args, **kwargs: P.kwargs) -> dict[str, Any]:
            return {**work(change, *args, **kwargs), "robots_port": self._robots_port()}

        return carry_out

    async def _changed(self, work: Callable[[Session], T]) -> T:
        result = await self._store.write(work)
        try:
            await self._take_up()
        except SwitchboardError as error:
            # It is done all the same, and the relay looks again by itself.
            self.log.error("a change is taken up later: {reason}", reason=str(error))
        except Exception:
            self.log.failure("a change is taken up later")
        return result

    async def remove_robot(self, principal: Principal, origin: str, name: str) -> Any:
        """The robot with its keys and all rights on it; the relay deletes what is recorded of it.

        :raises NotFound: no such robot
        :raises SwitchboardError: as :meth:`change`
        """
        number = await self.read(principal, robots.number, name)
        kept = len(self._recordings.library.of(number))
        await self.change(principal, origin, robots.remove_robot, name, kept)
