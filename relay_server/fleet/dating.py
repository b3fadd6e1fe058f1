"""How old an order is: what moves robots, or lets them move again, must not be done long after it was given."""

from __future__ import annotations

from relay_protocol.errors import Refused, SwitchboardError
from relay_server.channel import resolve
from relay_server.fleet.order import Order
from relay_server.moments import NEEDED, MomentNeeded, TooOld
from relay_server.registry import Presence
from relay_server.session.calling import RESUME, moves_by


class Dating:
    """When one order was given.

    :param sent: a moment before which it can't have been, the relay's monotonic nanoseconds; ``None`` where nobody says
    """

    def __init__(self, order: Order, sent: int | None) -> None:
        self._order = order
        self._sent = sent

    @property
    def since(self) -> int:
        """That moment; of an order of which nobody says when it was given, one at which it is too old for anything."""
        return 0 if self._sent is None else self._sent

    def check(self, robots: list[Presence], now: int) -> None:
        """See that the order is young enough for all robots that it moves, before anything is done.

        :param now: the relay's monotonic nanoseconds
        :raises MomentNeeded: it moves one, or lets one move again, and nobody says when it was given
        :raises TooOld: it moves one, and may have been given too long ago
        """
        moved = [robot for robot in robots if moves(robot, self._order)]
        if self._sent is None:
            if resumes(self._order):
                raise MomentNeeded(f"this lets robots move again: {NEEDED}")
            if moved:
                raise MomentNeeded(f"this moves {moved[0].name}: {NEEDED}")
        for robot in moved:
            age_ms, deadline_ms = (now - self.since) / 1e6, robot.description.motion.deadline_ms
            if age_ms > deadline_ms:
                raise TooOld(
                    f"this may have been sent {age_ms:.0f} ms ago; {robot.name} takes nothing older than {deadline_ms} "
                    "ms. Give back the moment of this answer"
                )

    def check_turn(self, robot: Presence, now: int) -> None:
        """See that it is young enough for a robot that it moves, now that this has its turn.

        :raises Refused: it may be too old
        """
        age_ms, deadline_ms = (now - self.since) / 1e6, robot.description.motion.deadline_ms
        if self._sent is None:
            raise Refused(f"this moves {robot.name}, and nobody has said when it was sent")
        if age_ms > deadline_ms:
            raise Refused(
                f"the turn of {robot.name} has come {age_ms:.0f} ms after this was sent, and it takes nothing older "
                f"than {deadline_ms} ms; give it once more for this robot"
            )


def moves(robot: Presence, order: Order) -> bool:
    """Whether what is ordered counts as motion on a robot, as far as it has told."""
    motion = robot.description.motion
    try:
        if order.do == "call":
            return moves_by(motion, resolve(order.service))
        if order.do == "set":
            return moves_by(motion, f"{resolve(order.name.partition(':')[0])}/set_parameters")
    except SwitchboardError:
        # No name: that is told when a robot has its turn.
        return False
    return False


def resumes(order: Order) -> bool:
    """Whether it lets robots move again, in one way or the other."""
    return order.do == "resume" or (order.do == "call" and f"/{order.service.lstrip('/')}" == RESUME)
