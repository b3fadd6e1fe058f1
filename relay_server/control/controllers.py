"""Control of all robots of a relay."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from relay_db.queries import StopRecord
from relay_protocol.clocks import now_ns
from relay_server.common.clock import Clock
from relay_server.control.audit import AuditSink
from relay_server.control.controller import RobotController
from relay_server.control.lease import FREE
from relay_server.control.stopping import StopState
from relay_server.control.types import ControlRules, ControlSnapshot
from relay_server.robots.registry import RobotState


class _Expected(NamedTuple):
    """An order to stop that the database has.

    :param seen: when it was first read there, the relay's monotonic nanoseconds
    """

    order: StopRecord
    seen: int


class Controllers:
    """One desk for each robot, made when somebody first asks for it.

    :param changed: called when what the list of robots shows is another
    :param wall: Unix time in seconds
    :param clock_ns: the relay's monotonic nanoseconds
    """

    def __init__(
        self,
        clock: Clock,
        record: AuditSink,
        rules: ControlRules,
        changed: Callable[[], None],
        wall: Callable[[], float],
        clock_ns: Callable[[], int] = now_ns,
    ) -> None:
        self._clock = clock
        self._record = record
        self._rules = rules
        self._changed = changed
        self._wall = wall
        self._clock_ns = clock_ns
        self._desks: dict[int, RobotController] = {}
        self._expected: dict[int, _Expected] = {}

    def __iter__(self) -> Iterator[RobotController]:
        return iter(list(self._desks.values()))

    def of(self, robot: RobotState) -> RobotController:
        """The robot's desk."""
        desk = self._desks.get(robot.robot_id)
        if desk is None:
            rooms = self._clock, robot, self._record, self._rules, self._changed, self._wall, self._clock_ns
            desk = self._desks[robot.robot_id] = RobotController(*rooms)
            expected = self._expected.pop(robot.robot_id, None)
            if expected is not None:
                desk.stopping.expect(*expected)
        return desk

    def standing(self, robot_id: int) -> ControlSnapshot:
        """Who commands a robot, and whether it is stopped, also of one that nobody has asked for yet."""
        desk = self._desks.get(robot_id)
        if desk is not None:
            return desk.standing
        expected = self._expected.get(robot_id)
        order = None if expected is None else expected.order
        return ControlSnapshot(
            FREE, {}, None if order is None else StopState(order.by, order.why, order.at, False)
        )

    def holder(self, robot: RobotState) -> int:
        """The number of the connection that has control of a robot, 0 for none."""
        tenure = self.standing(robot.robot_id).lease.holder
        return 0 if tenure is None else tenure.client.number

    async def coming(self, robot: RobotState) -> None:
        """A robot has proved itself and is about to register: what it is to be told first is looked up.

        :raises SwitchboardError: nobody can say
        """
        order = await self._record.pending(robot)
        self.of(robot).stopping.expect(order, self._clock_ns())

    def expect(self, orders: Iterable[StopRecord]) -> None:
        """Orders to stop, as the database has them. Robots that are there are told now."""
        now, before = self._clock_ns(), self._expected
        self._expected = {order.robot_id: _Expected(order, now) for order in orders}
        for robot_id, known in before.items():
            if robot_id in self._expected and self._expected[robot_id].order == known.order:
                self._expected[robot_id] = known
        for desk in self:
            order, seen = self._expected.pop(desk.robot.robot_id, (None, now))
            if desk.stopping.expect(order, seen) and desk.robot.control is not None:
                desk.stopping.came()

    def forget(self, robot_id: int) -> None:
        """The robot was removed."""
        self._desks.pop(robot_id, None)
        self._expected.pop(robot_id, None)
