"""Orders about control to one robot: each ends with its result, a timeout or the loss of the control link."""

from __future__ import annotations

import itertools
import secrets
from collections.abc import Callable

from twisted.internet.defer import Deferred

from relay_protocol import link
from relay_protocol.errors import Unavailable
from relay_protocol.link.motion import ControlOrder
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.errors import NotDone
from relay_server.robots.registry import RobotState

ANSWER_SECONDS = 3.0
"""Default time for the result of an order."""

MAX_PENDING = 512
"""Most orders without a result at a time. Orders that stop the robot are not limited."""

FIRST_IDS = 1 << 30
"""The first id is random up to this: ids of different relays rarely match, and stay within 32 bits."""


class OrderFailed(NotDone):
    """The result of an order is a failure.

    :ivar reason: in the robot's words
    """

    def __init__(self, robot: str, reason: str) -> None:
        super().__init__(f"robot {robot} could not do it: {reason}")
        self.reason = reason


class _PendingOrder:
    def __init__(self, result: Deferred[None], timeout: Timer) -> None:
        self.result = result
        self.timeout = timeout


class ControlOrders:
    """Sends orders about control to one robot and matches their results."""

    def __init__(self, clock: Clock, robot: RobotState) -> None:
        self._clock = clock
        self._robot = robot
        # A robot may still answer orders of an earlier relay process; its ids must not match ours (SPEC 2.4).
        self._ids = itertools.count(secrets.randbelow(FIRST_IDS) + 1)
        self._pending: dict[int, _PendingOrder] = {}

    def send(
        self, make: Callable[[int], ControlOrder], *, seconds: float = ANSWER_SECONDS, always: bool = False
    ) -> Deferred[None]:
        """Send an order now.

        :param make: makes the order from its id
        :param seconds: time for its result
        :param always: send it even beyond :data:`MAX_PENDING`
        :returns: fires when the order has taken effect. Fails with :class:`OrderFailed` when the robot could not do
            it, and with :class:`Unavailable` when the robot is offline, times out, or is lost
        """
        control, name = self._robot.control_link, self._robot.name
        result: Deferred[None] = Deferred()
        if control is None:
            result.errback(Unavailable(f"robot {name} is offline"))
        elif len(self._pending) >= MAX_PENDING and not always:
            result.errback(Unavailable(f"robot {name} has {MAX_PENDING} orders to answer already"))
        else:
            id = next(self._ids)
            timeout = self._clock.callLater(seconds, self._timed_out, id, seconds)
            self._pending[id] = _PendingOrder(result, timeout)
            control.send(make(id))
        return result

    def result_received(self, message: link.OrderResult) -> None:
        """Finish the order of a result; results of orders that timed out are ignored."""
        order = self._pending.pop(message.id, None)
        if order is None:
            return
        cancel(order.timeout)
        if message.ok:
            order.result.callback(None)
        else:
            reason = message.reason or "it gave no reason"
            order.result.errback(OrderFailed(self._robot.name, reason))

    def link_lost(self) -> None:
        """Fail all pending orders: no result will come."""
        pending, self._pending = self._pending, {}
        for order in pending.values():
            cancel(order.timeout)
            order.result.errback(
                Unavailable(f"robot {self._robot.name} lost its connection before it answered")
            )

    def _timed_out(self, id: int, seconds: float) -> None:
        order = self._pending.pop(id, None)
        if order is not None:
            order.result.errback(Unavailable(f"robot {self._robot.name} did not answer within {seconds:g} s"))
