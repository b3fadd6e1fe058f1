"""Control of a robot for who comes by HTTP: his kept connection takes it, or asks who has it for it."""

from __future__ import annotations

from twisted.internet.defer import Deferred

from relay_server.clock import Clock, cancel
from relay_server.control import Answer, Desk, NotDone
from relay_server.inside.guests import Guest

OVER = "your request for control is over: it was refused, withdrawn, not answered in time, or others came before you"

GIVEN_BACK = "control was given back meanwhile, or the request for it withdrawn"


async def take_control(clock: Clock, guest: Guest, why: str, seconds: float) -> Answer:
    """Take control of a free robot, or ask who has it for it; who has it keeps it.

    :param seconds: an answer to a request is waited for so long
    :returns: without success when a request has no answer yet
    :raises Refused: he may not control the robot, has taken it too often, or was refused a moment ago
    :raises Unavailable: the robot is offline, or does not agree
    :raises NotDone: somebody else asks for it already, or his request is over; or the robot can't do it
    """
    return await guest.while_here(_taken(clock, guest, why, seconds))


async def _taken(clock: Clock, guest: Guest, why: str, seconds: float) -> Answer:
    session, until = guest.session, clock.seconds() + seconds
    desk, gave_back = session.desk, guest.gave_back
    while True:
        answer = await desk.take(session, why)
        if guest.gave_back != gave_back:
            # Said while the robot was being told of it.
            desk.release(session, "")
            raise NotDone(GIVEN_BACK)
        if answer.success:
            return answer
        if not desk.lease.requested_by(session):
            raise NotDone(answer.message)
        while desk.lease.requested_by(session):
            left = until - clock.seconds()
            if left <= 0:
                return answer
            await _change(clock, desk, left)
        if guest.gave_back != gave_back:
            raise NotDone(GIVEN_BACK)
        moving = (desk.lease.holder, desk.lease.coming)
        if any(each is not None and each.client is not session for each in moving):
            raise NotDone(OVER)
        # It is his, or nobody's any more, and he still waits for it.


async def _change(clock: Clock, desk: Desk, seconds: float) -> None:
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
