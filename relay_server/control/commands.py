"""Orders to one robot over its control link: each ends with the robot's word, with time, or with the link."""

from __future__ import annotations

import itertools
import secrets
from collections.abc import Callable

from twisted.internet.defer import Deferred

from relay_protocol import link
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_protocol.link.motion import Order
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.robots.registry import RobotState

DONE_SECONDS = 3.0
"""A robot that has not answered an order by then is not waited for any more."""

WAITING = 512
"""Orders without an answer at a time; what stops the robot is never one too many."""

FIRST_IDS = 1 << 30
"""Orders are counted from a number up to this one: far apart from relay to relay, and within 32 bits all the same."""


class NotDone(SwitchboardError):
    """The robot says that it could not do it, or not all of it."""

    code = "not_done"


class _PendingCommand:
    def __init__(self, waiting: Deferred[None], late: Timer) -> None:
        self.waiting = waiting
        self.late = late


class RobotCommands:
    """Gives orders to one robot and knows which of them it has carried out."""

    def __init__(self, clock: Clock, robot: RobotState) -> None:
        self._clock = clock
        self._robot = robot
        # A robot may still answer a relay that ran before; its numbers must not be taken for ours (SPEC section 2.4).
        self._ids = itertools.count(secrets.randbelow(FIRST_IDS) + 1)
        self._waiting: dict[int, _PendingCommand] = {}

    def give(
        self, make: Callable[[int], Order], *, seconds: float = DONE_SECONDS, always: bool = False
    ) -> Deferred[None]:
        """Send an order now. What comes back fires when the robot says that it has taken effect.

        It fails with :class:`NotDone` when the robot could not, in its own words, and with :class:`Unavailable` when it
        is offline, did not answer in time, or was lost meanwhile.

        :param make: the order with the number it is given
        :param seconds: it has for its answer
        :param always: send it however many wait
        """
        control, name = self._robot.control, self._robot.name
        waiting: Deferred[None] = Deferred()
        if control is None:
            waiting.errback(Unavailable(f"robot {name} is offline"))
        elif len(self._waiting) >= WAITING and not always:
            waiting.errback(Unavailable(f"robot {name} has {WAITING} orders to answer already"))
        else:
            id = next(self._ids)
            late = self._clock.callLater(seconds, self._late, id, seconds)
            self._waiting[id] = _PendingCommand(waiting, late)
            control.send(make(id))
        return waiting

    def done(self, message: link.Done) -> None:
        """The robot's answer; one that nobody waits for any more is let go."""
        order = self._waiting.pop(message.id, None)
        if order is None:
            return
        cancel(order.late)
        if message.ok:
            order.waiting.callback(None)
        else:
            reason = message.reason or "it did not say why"
            order.waiting.errback(NotDone(f"robot {self._robot.name} could not do it: {reason}"))

    def lost(self) -> None:
        """The link is gone: no answer will come."""
        orders, self._waiting = self._waiting, {}
        for order in orders.values():
            cancel(order.late)
            order.waiting.errback(
                Unavailable(f"robot {self._robot.name} lost its connection before it answered")
            )

    def _late(self, id: int, seconds: float) -> None:
        order = self._waiting.pop(id, None)
        if order is not None:
            order.waiting.errback(
                Unavailable(f"robot {self._robot.name} did not answer within {seconds:g} s")
            )
