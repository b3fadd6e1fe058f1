"""Sessions of HTTP clients, which outlast requests: each is kept for 10 s after its last request.

So subscriptions, publications and control outlast a request too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from typing import Any, NamedTuple, TypeVar

from twisted.internet.defer import CancelledError, Deferred

from relay_protocol.errors import Unavailable
from relay_server.access import Permit, Principal
from relay_server.common import close_codes
from relay_server.common.clock import Clock, Timer, cancel, sleep
from relay_server.in_process_sessions.in_process_port import InProcessPort
from relay_server.robots.registry import RobotState
from relay_server.sessions.manager import Admission, SessionManager, ShuttingDown

T = TypeVar("T")

LINGER_SECONDS = 10.0
"""A session without requests is kept for this long."""

OVER = "your session has ended, because it got no request for some time"
"""The reason for requests that still wait when the session expires."""

POLL_PACE = 0.1
"""Least seconds of a request for the next message."""

SESSIONS_PER_USER = 16
"""Sessions by HTTP of one user, over all robots and tokens, including those that follow a topic."""

Key = tuple[int, int, str, str]
"""A session: the numbers of the user and of the token, which may be none, the realm, the robot's name there."""

Release = Callable[[], None]
"""Ends one use of a session; a second call does nothing."""


class RobotCaller(NamedTuple):
    """The caller of a request to one robot, over HTTP or by a Role.

    :param robot: its name in the caller's realm
    :param address: network address of the caller
    """

    principal: Principal
    robot: str
    address: str


def key_of(principal: Principal, robot: str) -> Key:
    """The key of a principal's session with a robot."""
    return principal.user_id, principal.token_id, principal.realm, robot


class TimedMessage(NamedTuple):
    """A message of a topic.

    :param number: how many have come, including this one
    :param body: JSON
    :param at: the clock's seconds when it came
    """

    number: int
    body: bytes
    at: float


class LatestValue:
    """The newest message of one topic, kept from one request to the next."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._used = clock.seconds()
        self._waiting: dict[Deferred[TimedMessage | None], int] = {}
        self.newest: TimedMessage | None = None

    def update(self, body: bytes) -> None:
        """A message has come, JSON."""
        number = 1 if self.newest is None else self.newest.number + 1
        self.newest = newest = TimedMessage(number, body, self._clock.seconds())
        for waiting, after in list(self._waiting.items()):
            if number > after:
                del self._waiting[waiting]
                waiting.callback(newest)

    def end(self) -> None:
        """The subscription has ended: no request waits any longer."""
        waiting, self._waiting = self._waiting, {}
        for each in waiting:
            each.callback(None)

    def touch(self) -> None:
        """A request uses it."""
        self._used = self._clock.seconds()

    def idle(self, seconds: float) -> bool:
        """Whether no request has used it for this time, and none waits."""
        return not self._waiting and self._clock.seconds() - self._used >= seconds

    async def after(self, number: int, seconds: float) -> TimedMessage | None:
        """The first message after that number; ``None`` if none comes within ``seconds``, or the subscription ends."""
        if self.newest is not None and self.newest.number > number:
            return self.newest
        waiting: Deferred[TimedMessage | None] = Deferred(self._given_up)
        self._waiting[waiting] = number
        timer = self._clock.callLater(seconds, self._timed_out, waiting)
        try:
            return await waiting
        finally:
            cancel(timer)
            self.touch()

    async def wait_for_next(self, seconds: float) -> int:
        """Wait for the next message, or for ``seconds``.

        :returns: the number with which :meth:`after` returns the newest message at once

        A client that polls again at once gets the newest of :data:`POLL_PACE`.
        """
        began = self._clock.seconds()
        await self.after(0 if self.newest is None else self.newest.number, seconds)
        await sleep(self._clock, max(0.0, began + POLL_PACE - self._clock.seconds()))
        return 0 if self.newest is None else self.newest.number - 1

    def _given_up(self, waiting: Deferred[TimedMessage | None]) -> None:
        self._waiting.pop(waiting, None)

    def _timed_out(self, waiting: Deferred[TimedMessage | None]) -> None:
        if self._waiting.pop(waiting, None) is not None:
            waiting.callback(None)


class PooledSession:
    """One principal's session with one robot.

    :ivar port: sends operations to the session, and receives its answers
    :ivar session: carries out the operations
    :ivar client: the client, as the robot's channel and control know it
    """

    def __init__(self, clock: Clock, port: InProcessPort) -> None:
        self.port = port
        self.session = port.session
        self.client = port.client
        self._clock = clock
        self._topics: dict[str, LatestValue] = {}
        self._running: set[Deferred[Any]] = set()

    def subscribe(self, topic: str, type_name: str = "") -> LatestValue:
        """The newest message of a topic, which is subscribed to if necessary.

        :raises SwitchboardError: the topic cannot be subscribed to, or the client may not
        """
        latest = self._topics.get(topic)
        if latest is not None and not self.session.subscriptions.is_subscribed(topic):
            # The right was revoked, and may have been granted again.
            self._unsubscribe(topic)
            latest = None
        if latest is None:
            latest = LatestValue(self._clock)
            self.port.subscribe(topic, type_name, latest.update, queue_length=1)
            self._topics[topic] = latest
        latest.touch()
        return latest

    async def run(self, work: Coroutine[Deferred[Any], Any, T]) -> T:
        """Await work that must not outlast the session.

        :raises SwitchboardError: the session ended, with the reason; or what the work raises
        """
        running = Deferred.fromCoroutine(work)
        self._running.add(running)
        try:
            return await running
        except CancelledError:
            self.port.check()
            raise
        finally:
            self._running.discard(running)

    def unsubscribe_idle(self) -> None:
        """End subscriptions that no request has used recently."""
        for topic, latest in list(self._topics.items()):
            if latest.idle(LINGER_SECONDS):
                self._unsubscribe(topic)

    def closed(self) -> None:
        """The session has ended: everything that waits ends too."""
        for latest in self._topics.values():
            latest.end()
        for running in list(self._running):
            running.cancel()

    def _unsubscribe(self, topic: str) -> None:
        self._topics.pop(topic).end()
        self.port.unsubscribe(topic)


class _PoolEntry:
    """Counts the requests that use a pooled session, and ends it some time after the last.

    :param on_end: called once, when the session is over
    """

    def __init__(self, clock: Clock, pooled: PooledSession, on_end: Callable[[], None]) -> None:
        self.pooled = pooled
        self._clock = clock
        self._on_end = on_end
        self._requests = 0
        self._timer: Timer | None = None
        pooled.port.on_close = self._closed

    def enter(self) -> Release:
        """One more request uses the session, until what is returned is called."""
        self._requests += 1
        cancel(self._timer)
        self._timer = None
        used = True

        def release() -> None:
            nonlocal used
            if used:
                used = False
                self._release()

        return release

    def _release(self) -> None:
        self._requests -= 1
        if self.pooled.port.closed is not None:
            return
        self.pooled.unsubscribe_idle()
        if self._requests == 0:
            self._timer = self._clock.callLater(LINGER_SECONDS, self._expire)

    def _expire(self) -> None:
        self._timer = None
        self._on_end()
        # Orderly: the end of requests is not a lost connection.
        self.pooled.session.end(orderly=True)
        # Pending answers fail.
        self.pooled.port.disconnect(close_codes.GOING_AWAY, OVER)

    def _closed(self) -> None:
        cancel(self._timer)
        self._timer = None
        self._on_end()
        self.pooled.closed()


class InProcessSessionPool:
    """All sessions of clients that come by HTTP."""

    def __init__(self, clock: Clock, sessions: SessionManager) -> None:
        self._clock = clock
        self._sessions = sessions
        self._entries: dict[Key, _PoolEntry] = {}
        self._count: Counter[int] = Counter()
        """By user."""

    @asynccontextmanager
    async def at(self, caller: RobotCaller) -> AsyncIterator[PooledSession]:
        """The caller's session with the robot, for one request.

        :raises NotFound: no such robot, or no right on it
        :raises Unavailable: the user has too many sessions, or the relay shuts down
        """
        pooled, release = await self.keep(caller)
        try:
            yield pooled
        finally:
            release()

    async def keep(self, caller: RobotCaller) -> tuple[PooledSession, Release]:
        """As :meth:`at`, until the returned function is called.

        :raises SwitchboardError: as :meth:`at`
        """
        entry = self._entries.get(key_of(caller.principal, caller.robot))
        if entry is None:
            entry = await self._open_pooled(caller)
        return entry.pooled, entry.enter()

    def find(self, principal: Principal, robot: str) -> tuple[PooledSession, Release] | None:
        """The same as :meth:`keep` for a session that exists; otherwise ``None``, without a look-up."""
        entry = self._entries.get(key_of(principal, robot))
        return None if entry is None else (entry.pooled, entry.enter())

    @asynccontextmanager
    async def admitted(self, caller: RobotCaller) -> AsyncIterator[tuple[Permit, RobotState]]:
        """The present rights of the caller on the robot, and the robot, without a session.

        :raises NotFound: no such robot, or no right on it
        """
        entry = self._entries.get(key_of(caller.principal, caller.robot))
        if entry is not None:
            yield entry.pooled.client.permit, entry.pooled.client.robot
            return
        admission = await self._sessions.admit(*caller)
        try:
            yield admission.permit, admission.robot
        finally:
            self._sessions.release(admission)

    @asynccontextmanager
    async def unshared(self, caller: RobotCaller) -> AsyncIterator[InProcessPort]:
        """A session of its own, which ends with the block.

        :raises NotFound: no such robot, or no right on it
        :raises Unavailable: as :meth:`at`
        """
        user = caller.principal.user_id
        admission = await self._sessions.admit(*caller)
        self._check_room(admission)
        self._count[user] += 1
        try:
            port = self._open(admission)
            try:
                yield port
            finally:
                port.session.end(orderly=True)
        finally:
            self._uncount(user)

    def _check_room(self, admission: Admission) -> None:
        """Release the admission if the user has too many sessions, or the relay shuts down.

        :raises Unavailable: as :meth:`at`
        """
        if self._sessions.accepting and self._count[admission.permit.principal.user_id] < SESSIONS_PER_USER:
            return
        self._sessions.release(admission)
        if not self._sessions.accepting:
            raise ShuttingDown("the relay is shutting down; try again in a moment")
        raise Unavailable(
            f"you have {SESSIONS_PER_USER} sessions by HTTP, the most one user may have; end some, or wait "
            f"{LINGER_SECONDS:g} s"
        )

    def _open(self, admission: Admission) -> InProcessPort:
        # Without a freshness token, the time at which a request was sent is unknown.
        port = InProcessPort()
        port.begin(self._sessions.open_in_process(admission, port))
        return port

    async def _open_pooled(self, caller: RobotCaller) -> _PoolEntry:
        admission = await self._sessions.admit(*caller)
        key = key_of(caller.principal, caller.robot)
        other = self._entries.get(key)
        if other is not None:
            # Another request has opened it meanwhile.
            self._sessions.release(admission)
            return other
        self._check_room(admission)
        pooled = PooledSession(self._clock, self._open(admission))
        entry = self._entries[key] = _PoolEntry(self._clock, pooled, lambda: self._ended(key))
        self._count[caller.principal.user_id] += 1
        return entry

    def _ended(self, key: Key) -> None:
        entry = self._entries.pop(key, None)
        if entry is not None:
            self._uncount(entry.pooled.client.user)

    def _uncount(self, user: int) -> None:
        self._count[user] -= 1
        self._count += Counter()
