"""People and programs who come by HTTP: a connection to a robot is kept for them from one request to the next.

So what they listen to, what they publish and the control they have outlast a request, and end soon after the last.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from typing import Any, TypeVar

from twisted.internet.defer import CancelledError, Deferred

from relay_protocol.errors import Unavailable
from relay_server.access import Permit, Principal
from relay_server.common import close_codes
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.http_sessions.latest_value import LatestValue
from relay_server.http_sessions.loopback_client import LoopbackClient
from relay_server.sessions.manager import AuthorizedSession, SessionManager, ShuttingDown
from relay_server.sessions.session import Session

T = TypeVar("T")

LINGER_SECONDS = 10.0
"""A guest who asks for nothing is kept for so long."""

OVER = "the connection that was kept for you has ended, as nothing was asked of it"
"""What those are told who still wait for something then."""

GUESTS = 16
"""Connections of one user, over all robots and tokens, with those that follow a topic."""


Key = tuple[int, str, str]
"""Which connection: the number of the token, the realm, the robot's name there."""


def key_of(principal: Principal, robot: str) -> Key:
    """That of a principal's connection to a robot."""
    return principal.token_id, principal.realm, robot


class PooledSession:
    """One principal at one robot.

    :ivar client: asks
    :ivar session: is asked
    """

    def __init__(self, clock: Clock, session: Session, client: LoopbackClient) -> None:
        self.session = session
        self.client = client
        self._clock = clock
        self._feeds: dict[str, LatestValue] = {}
        self._doing: set[Deferred[Any]] = set()

    def feed(self, topic: str, type_name: str = "") -> LatestValue:
        """What is said on a topic, from now on.

        :raises SwitchboardError: it may not be heard, or can't be
        """
        feed = self._feeds.get(topic)
        if feed is not None and not self.session.listening.hears(topic):
            # The right to was withdrawn meanwhile; perhaps there is one again.
            self._forget(topic)
            feed = None
        if feed is None:
            feed = LatestValue(self._clock)
            self.client.hear(topic, type_name, feed.heard, queue_length=1)
            self._feeds[topic] = feed
        feed.used()
        return feed

    async def while_here(self, work: Coroutine[Deferred[Any], Any, T]) -> T:
        """Do something that must not go on when the connection is over.

        :raises SwitchboardError: it is over, with the reason; or what the work raises
        """
        doing = Deferred.fromCoroutine(work)
        self._doing.add(doing)
        try:
            return await doing
        except CancelledError:
            self.client.check()
            raise
        finally:
            self._doing.discard(doing)

    def tidy(self) -> None:
        """Listen no longer to what nobody has asked for of late."""
        for topic, feed in list(self._feeds.items()):
            if feed.idle(LINGER_SECONDS):
                self._forget(topic)

    def closed(self) -> None:
        """The connection is over: nobody need wait for anything."""
        for feed in self._feeds.values():
            feed.end()
        for doing in list(self._doing):
            doing.cancel()

    def _forget(self, topic: str) -> None:
        self._feeds.pop(topic).end()
        self.client.hear_no_more(topic)


class SessionPool:
    """All who are there by HTTP.

    :param clock_ns: the relay's monotonic nanoseconds
    """

    def __init__(self, clock: Clock, front: SessionManager, clock_ns: Callable[[], int]) -> None:
        self._clock = clock
        self._front = front
        self._clock_ns = clock_ns
        self._here: dict[Key, _Lease] = {}
        self._counted: Counter[int] = Counter()

    @asynccontextmanager
    async def at(self, principal: Principal, robot: str, address: str) -> AsyncIterator[PooledSession]:
        """A principal's connection to a robot, for one request.

        :raises NotFound: no such robot, or no right on it
        :raises Unavailable: the user has too many, or the relay is going down
        """
        guest, leave = await self.keep(principal, robot, address)
        try:
            yield guest
        finally:
            leave()

    async def keep(
        self, principal: Principal, robot: str, address: str
    ) -> tuple[PooledSession, Callable[[], None]]:
        """The same until what comes with it is called; a second time does nothing.

        :raises SwitchboardError: as :meth:`at`
        """
        key = key_of(principal, robot)
        stay = self._here.get(key)
        if stay is None:
            stay = await self._arrive(key, principal, robot, address)
        return stay.guest, stay.enter()

    def there(self, principal: Principal, robot: str) -> tuple[PooledSession, Callable[[], None]] | None:
        """What :meth:`keep` gives, where it is kept already: nobody comes in by this, and nothing is looked up."""
        stay = self._here.get(key_of(principal, robot))
        return None if stay is None else (stay.guest, stay.enter())

    @asynccontextmanager
    async def permit(self, principal: Principal, robot: str, address: str) -> AsyncIterator[Permit]:
        """What a principal may do at a robot now, without a connection where there is none.

        :raises NotFound: no such robot, or no right on it
        """
        stay = self._here.get(key_of(principal, robot))
        if stay is not None:
            yield stay.guest.session.permit
            return
        admission = await self._front.admit(principal, robot, address)
        try:
            yield admission.permit
        finally:
            self._front.turn_away(admission)

    @asynccontextmanager
    async def visit(
        self, principal: Principal, robot: str, address: str
    ) -> AsyncIterator[tuple[Session, LoopbackClient]]:
        """A connection of its own, which ends with the block.

        :raises NotFound: no such robot, or no right on it
        :raises Unavailable: as :meth:`at`
        """
        admission = await self._front.admit(principal, robot, address)
        self._see_room(admission)
        self._counted[principal.user_id] += 1
        try:
            session, client = self._open(admission)
            try:
                yield session, client
            finally:
                session.end(orderly=True)
        finally:
            self._uncount(principal.user_id)

    def _see_room(self, admission: AuthorizedSession) -> None:
        """Turn away who was admitted, where there is no room for him."""
        if self._front.accepting and self._counted[admission.permit.principal.user_id] < GUESTS:
            return
        self._front.turn_away(admission)
        if not self._front.accepting:
            raise ShuttingDown("the relay is going down; come again in a moment")
        raise Unavailable(
            f"{GUESTS} connections by HTTP are kept for you, the most one user may have; end some, or wait "
            f"{LINGER_SECONDS:g} s"
        )

    def _open(self, admission: AuthorizedSession) -> tuple[Session, LoopbackClient]:
        # Nothing is known of when a request was sent, unless it says so.
        client = LoopbackClient(undated=0)
        session = self._front.open(admission, client, self._clock_ns())
        client.begin(session)
        return session, client

    def _uncount(self, user: int) -> None:
        self._counted[user] -= 1
        self._counted += Counter()

    async def _arrive(self, key: Key, principal: Principal, robot: str, address: str) -> _Lease:
        admission = await self._front.admit(principal, robot, address)
        there = self._here.get(key)
        if there is not None:
            self._front.turn_away(admission)
            return there
        self._see_room(admission)
        session, client = self._open(admission)
        stay = self._here[key] = _Lease(
            self._clock, PooledSession(self._clock, session, client), self._left(key)
        )
        self._counted[principal.user_id] += 1
        return stay

    def _left(self, key: Key) -> Callable[[], None]:
        def left() -> None:
            stay = self._here.pop(key, None)
            if stay is not None:
                self._uncount(stay.guest.session.user)

        return left


class _Lease:
    """How long a guest is kept.

    :param left: called once, when he is no more
    """

    def __init__(self, clock: Clock, guest: PooledSession, left: Callable[[], None]) -> None:
        self.guest = guest
        self._clock = clock
        self._left = left
        self._inside = 0
        self._timer: Timer | None = None
        guest.client.on_close = self._over

    def enter(self) -> Callable[[], None]:
        """One more request of his; what is to be called when it is answered."""
        self._inside += 1
        cancel(self._timer)
        self._timer = None
        inside = True

        def leave() -> None:
            nonlocal inside
            if inside:
                inside = False
                self._leave()

        return leave

    def _leave(self) -> None:
        self._inside -= 1
        if self.guest.client.closed is not None:
            return
        self.guest.tidy()
        if self._inside == 0:
            self._timer = self._clock.callLater(LINGER_SECONDS, self._end)

    def _end(self) -> None:
        self._timer = None
        self._left()
        # A request that is followed by none is no connection that was lost.
        self.guest.session.end(orderly=True)
        # What it still waits for does not come any more.
        self.guest.client.close(close_codes.GOING_AWAY, OVER)

    def _over(self) -> None:
        cancel(self._timer)
        self._timer = None
        self._left()
        self.guest.closed()
