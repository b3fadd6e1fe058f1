"""Control of a robot for who comes by HTTP: his kept connection takes it, or asks who has it for it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from twisted.internet.defer import CancelledError, Deferred

from relay_server.access import Principal
from relay_server.common.clock import Clock, cancel
from relay_server.control.commands import NotDone
from relay_server.control.controller import RobotController
from relay_server.control.types import ControlReply
from relay_server.http_sessions.pool import Key, PooledSession, key_of

OVER = "your request for control is over: it was refused, withdrawn, not answered in time, or others came before you"

GIVEN_BACK = "control was given back meanwhile, or the request for it withdrawn"


@dataclass(eq=False)
class _ControlWaiter:
    """What one connection wants by requests that are not answered yet.

    :ivar open: these requests
    :ivar told: whether the caller knows by an earlier answer that control is his, or asked for; ``None`` before the
        connection is there
    """

    open: set[PendingControlRequest] = field(default_factory=set)
    told: bool | None = None


@dataclass(eq=False)
class PendingControlRequest:
    """A request for control that is not answered yet."""

    wanting: _ControlWaiter
    _withdrawn: bool = False

    def withdraw(self) -> None:
        """The caller does not want it any more."""
        self._withdrawn = True

    def stands(self) -> bool:
        """Whether the caller still wants it."""
        return not self._withdrawn

    def there(self, has_or_asks: bool) -> None:
        """The connection is there.

        :param has_or_asks: whether control is its, or asked for by it
        """
        if self.wanting.told is None:
            self.wanting.told = has_or_asks

    def answered(self) -> None:
        """The caller is told what he has."""
        self.wanting.told = True

    def alone(self) -> bool:
        """Whether no other request wants what this one does."""
        return not any(each.stands() for each in self.wanting.open if each is not self)


class PendingControlRequests:
    """Requests for control from when they come until they are answered, also before their connections are there."""

    def __init__(self) -> None:
        self._wanted: dict[Key, _ControlWaiter] = {}

    @contextmanager
    def made(self, principal: Principal, robot: str) -> Iterator[PendingControlRequest]:
        """One, while it is not answered."""
        key = key_of(principal, robot)
        wanting = self._wanted.setdefault(key, _ControlWaiter())
        wish = PendingControlRequest(wanting)
        wanting.open.add(wish)
        try:
            yield wish
        finally:
            wanting.open.discard(wish)
            if not wanting.open:
                del self._wanted[key]

    def withdraw(self, principal: Principal, robot: str) -> None:
        """The caller wants control no more: what he asked for before gives him nothing."""
        wanting = self._wanted.get(key_of(principal, robot))
        for wish in () if wanting is None else wanting.open:
            wish.withdraw()


async def take_control(
    clock: Clock, guest: PooledSession, wish: PendingControlRequest, why: str, seconds: float
) -> ControlReply:
    """Take control of a free robot, or ask who has it for it; who has it keeps it.

    Who leaves while he waits is given nothing, and asks nobody any more.

    :param seconds: an answer to a request is waited for so long
    :returns: without success when a request has no answer yet
    :raises Refused: he may not control the robot, has taken it too often, or was refused a moment ago
    :raises Unavailable: the robot is offline, or does not agree
    :raises NotDone: somebody else asks for it already, or his request is over; or the robot can't do it
    """
    return await guest.while_here(_wanted(clock, guest, wish, why, seconds))


async def _wanted(
    clock: Clock, guest: PooledSession, wish: PendingControlRequest, why: str, seconds: float
) -> ControlReply:
    session = guest.session
    lease = session.desk.lease
    wish.there(lease.held_by(session) or lease.coming_to(session) or lease.requested_by(session))
    try:
        answer = await _taken(clock, guest, wish, why, seconds)
    except CancelledError:
        if wish.alone() and not wish.wanting.told:
            session.desk.release(session, "")
        raise
    wish.answered()
    return answer


async def _taken(
    clock: Clock, guest: PooledSession, wish: PendingControlRequest, why: str, seconds: float
) -> ControlReply:
    session, until = guest.session, clock.seconds() + seconds
    desk = session.desk
    while wish.stands():
        answer = await desk.take(session, why)
        if not wish.stands():
            # Said while the robot was being told of it.
            if wish.alone():
                desk.release(session, "")
            break
        if answer.success:
            return answer
        if not desk.lease.requested_by(session):
            raise NotDone(answer.message)
        while desk.lease.requested_by(session):
            left = until - clock.seconds()
            if left <= 0:
                return answer
            await _change(clock, desk, left)
        moving = (desk.lease.holder, desk.lease.coming)
        if wish.stands() and any(each is not None and each.client is not session for each in moving):
            raise NotDone(OVER)
        # It is his, or nobody's any more, and he still waits for it.
    raise NotDone(GIVEN_BACK)


async def _change(clock: Clock, desk: RobotController, seconds: float) -> None:
    """Wait until who moves the robot has changed, for so long."""
    changed: Deferred[None] = Deferred()

    def tell() -> None:
        if not changed.called:
            changed.callback(None)

    timer = clock.callLater(seconds, tell)
    desk.pushing.follow(changed, tell)
    try:
        await changed
    finally:
        desk.pushing.forget(changed)
        cancel(timer)
