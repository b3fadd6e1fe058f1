"""Administration of realms over HTTP. A change is in effect before its response is sent."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

from sqlalchemy.orm import Session
from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from relay_server.access import Principal
from relay_server.common.concurrency import shield
from relay_server.common.database import AsyncDatabase
from relay_server.common.token_bucket import Buckets
from relay_server.realms import robots
from relay_server.realms.realm_change import RealmChangeTransaction, check_administrator
from relay_server.realms.schemas import (
    CHANGES_BURST,
    CHANGES_PER_SECOND,
    PASSWORDS_AT_ONCE,
    PATTERNS_PER_CHANGE,
    REALMS,
)
from relay_server.recordings.recordings import Recordings

P = ParamSpec("P")
T = TypeVar("T")


class TooManyChanges(Refused):
    """A realm is changed too often; try again after ``retry_after`` seconds."""

    code = "too_often"

    def __init__(self, retry_after: float) -> None:
        super().__init__("this realm is changed too often; try again in a moment")
        self.retry_after = retry_after


class PasswordHasher(Protocol):
    """Hashes passwords; see :class:`relay_server.auth.authenticator.Authenticator`."""

    async def new_hash(self, password: str) -> str:
        """The hash to store for a new password."""


class RealmService:
    """Runs the functions of :mod:`~relay_server.realms.users` and :mod:`~relay_server.realms.robots`.

    :param apply: applies changes of the database in the relay, so that revoked connections are closed
    :param robots_port: the port that robots dial
    :param wall: Unix time in seconds
    :param seconds: a monotonic clock
    """

    log = Logger()

    def __init__(
        self,
        store: AsyncDatabase,
        hashing: PasswordHasher,
        recordings: Recordings,
        apply: Callable[[], Awaitable[None]],
        robots_port: Callable[[], int],
        wall: Callable[[], float] = time.time,
        seconds: Callable[[], float] = time.monotonic,
    ) -> None:
        self._store = store
        self._hashing = hashing
        self._recordings = recordings
        self._apply = apply
        self._robots_port = robots_port
        self._wall = wall
        self._passwords = 0
        self._realms = Buckets(CHANGES_PER_SECOND, CHANGES_BURST, REALMS, seconds)
        # No administrator can use up alone what others need to lock them out.
        self._tokens = Buckets(CHANGES_PER_SECOND / 2, CHANGES_BURST / 2, REALMS, seconds)

    def admit(self, principal: Principal, *, changes: bool = False) -> None:
        """Check that the caller is an administrator.

        :param changes: a change follows, which is counted
        :raises Refused: not an administrator, or the realm is changed too often
        """
        check_administrator(principal)
        if changes:
            self.count(principal)

    def count(self, principal: Principal, patterns: int = 0) -> None:
        """Count a change of an administrator.

        :param patterns: of a right to be granted
        :raises Refused: the realm is changed too often; then nothing is counted
        """
        cost = 1 + patterns / PATTERNS_PER_CHANGE
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
        """Read from the realm of an administrator.

        :param query: gets a session and the realm's name before its arguments
        :raises Unavailable: the database cannot be asked
        """
        return await self._store.read(query, principal.realm, *args, **kwargs)

    async def new_hash(self, principal: Principal, password: str) -> str:
        """The hash of a new password that an administrator sets.

        :raises Refused: the token does not allow it
        :raises Invalid: it breaks the rules
        :raises Unavailable: too many are being hashed
        """
        principal.require_full_scope()
        if self._passwords >= PASSWORDS_AT_ONCE:
            raise Unavailable("too many passwords are being set; try again in a moment")
        # The thread continues after the client has disconnected, and keeps its slot.
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
        """Change the realm of an administrator, and apply it in the relay, even if the client has disconnected.

        :param origin: the client's address
        :raises SwitchboardError: it was not possible, and nothing was changed
        """

        def carry_out(session: Session) -> T:
            return work(RealmChangeTransaction(session, principal, origin, self._wall), *args, **kwargs)

        return await shield(Deferred.fromCoroutine(self._write_and_apply(carry_out)))

    def with_robots_port(
        self, work: Callable[Concatenate[RealmChangeTransaction, P], dict[str, Any]]
    ) -> Callable[Concatenate[RealmChangeTransaction, P], dict[str, Any]]:
        """Wraps work that makes an enrolment code: its result also names the port that robots dial."""

        def carry_out(change: RealmChangeTransaction, /, *args: P.args, **kwargs: P.kwargs) -> dict[str, Any]:
            return {**work(change, *args, **kwargs), "robots_port": self._robots_port()}

        return carry_out

    async def _write_and_apply(self, work: Callable[[Session], T]) -> T:
        result = await self._store.write(work)
        try:
            await self._apply()
        except SwitchboardError as error:
            # The change is stored all the same, and the relay reads it by itself later.
            self.log.error("a change takes effect later: {reason}", reason=str(error))
        except Exception:
            self.log.failure("a change takes effect later")
        return result

    async def remove_robot(self, principal: Principal, origin: str, name: str) -> Any:
        """Remove a robot with its keys and all rights on it; the relay deletes its recordings.

        :raises NotFound: no such robot
        :raises SwitchboardError: as :meth:`change`
        """
        number = await self.read(principal, robots.number, name)
        kept = len(self._recordings.library.of(number))
        await self.change(principal, origin, robots.remove_robot, name, kept)
