"""Control of a robot for clients that come by HTTP: their pooled session takes it, or requests it from the holder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from twisted.internet.defer import CancelledError, Deferred

from relay_server.access import Principal
from relay_server.common.clock import Clock, cancel
from relay_server.common.errors import NotDone
from relay_server.control.controller import RobotController
from relay_server.control.service import ControlService
from relay_server.control.types import ControlReply
from relay_server.in_process_sessions.pool import Key, PooledSession, key_of
from relay_server.sessions.context import ClientContext

OVER = "your request for control has ended: it was refused, withdrawn, not answered in time, or another was granted"

RELEASED = "control was released meanwhile, or the request for it withdrawn"


@dataclass(eq=False)
class _SessionRequests:
    """The requests of one session that are not answered yet.

    :ivar known: whether the client knows by an earlier answer that it has control or has requested it; ``None`` before
        the session is open
    """

    open: set[PendingControlRequest] = field(default_factory=set)
    known: bool | None = None


@dataclass(eq=False)
class PendingControlRequest:
    """A request for control that is not answered yet."""

    session: _SessionRequests
    _withdrawn: bool = False

    def withdraw(self) -> None:
        """The client does not want control any more."""
        self._withdrawn = True

    def stands(self) -> bool:
        """Whether the client still wants control."""
        return not self._withdrawn

    def opened(self, has_or_requests: bool) -> None:
        """The session is open.

        :param has_or_requests: whether it has control, or has requested it
        """
        if self.session.known is None:
            self.session.known = has_or_requests

    def answered(self) -> None:
        """The client gets the answer."""
        self.session.known = True

    def alone(self) -> bool:
        """Whether no other request of the session is for the same."""
        return not any(each.stands() for each in self.session.open if each is not self)


class PendingControlRequests:
    """Requests for control until they are answered, also before their sessions are open."""

    def __init__(self) -> None:
        self._sessions: dict[Key, _SessionRequests] = {}

    @contextmanager
    def add(self, principal: Principal, robot: str) -> Iterator[PendingControlRequest]:
        """A request, until it is answered."""
        key = key_of(principal, robot)
        session = self._sessions.setdefault(key, _SessionRequests())
        request = PendingControlRequest(session)
        session.open.add(request)
        try:
            yield request
        finally:
            session.open.discard(request)
            if not session.open:
                del self._sessions[key]

    def withdraw(self, principal: Principal, robot: str) -> None:
        """The client does not want control any more; its earlier requests get nothing."""
        session = self._sessions.get(key_of(principal, robot))
        for request in () if session is None else session.open:
            request.withdraw()


async def take_control(
    clock: Clock,
    control: ControlService,
    pooled: PooledSession,
    request: PendingControlRequest,
    why: str,
    seconds: float,
) -> ControlReply:
    """Take control of a free robot, or request it from the holder, who keeps it until they grant it.

    A client that leaves while it waits gets nothing, and its request is withdrawn.

    :param seconds: how long to wait for the answer to a request
    :returns: without success when a request has no answer yet
    :raises Refused: the client may not control the robot, has taken it too often, or was refused a moment ago
    :raises Unavailable: the robot is offline, or does not agree
    :raises NotDone: another client requests it already, or the request is over; or the robot can't do it
    """
    return await pooled.run(_ControlTake(clock, control, pooled.client, request, why, seconds).run())


class _ControlTake:
    """Takes control, or requests it, for one request over HTTP; see :func:`take_control`."""

    def __init__(
        self,
        clock: Clock,
        control: ControlService,
        client: ClientContext,
        request: PendingControlRequest,
        why: str,
        seconds: float,
    ) -> None:
        self._clock = clock
        self._control = control
        self._client = client
        self._request = request
        self._why = why
        self._until = clock.seconds() + seconds

    async def run(self) -> ControlReply:
        client, lease = self._client, self._client.controller.lease
        self._request.opened(lease.held_by(client) or lease.pending_for(client) or lease.requested_by(client))
        try:
            answer = await self._take()
        except CancelledError:
            if self._request.alone() and not self._request.session.known:
                self._control.release(client, "")
            raise
        self._request.answered()
        return answer

    async def _take(self) -> ControlReply:
        client, request = self._client, self._request
        while request.stands():
            answer = await self._control.take(client, self._why)
            if not request.stands():
                # Withdrawn while the robot was being notified.
                if request.alone():
                    self._control.release(client, "")
                break
            if answer.success:
                return answer
            lease = client.controller.lease
            if not lease.requested_by(client):
                raise NotDone(answer.message)
            if not await self._answered():
                return answer
            holders = (client.controller.lease.holder, client.controller.lease.pending_holder)
            if request.stands() and any(each is not None and each.client is not client for each in holders):
                raise NotDone(OVER)
            # Control is the client's, or free, and the client still waits for it.
        raise NotDone(RELEASED)

    async def _answered(self) -> bool:
        """Wait while the request is open; whether it was answered in time."""
        controller = self._client.controller
        while controller.lease.requested_by(self._client):
            left = self._until - self._clock.seconds()
            if left <= 0:
                return False
            await _change(self._clock, controller, left)
        return True


async def _change(clock: Clock, controller: RobotController, seconds: float) -> None:
    """Wait until another client controls the robot, or none; no longer than so many seconds."""
    changed: Deferred[None] = Deferred()

    def notify() -> None:
        if not changed.called:
            changed.callback(None)

    timer = clock.callLater(seconds, notify)
    controller.changes.follow(changed, notify)
    try:
        await changed
    finally:
        controller.changes.forget(changed)
        cancel(timer)
