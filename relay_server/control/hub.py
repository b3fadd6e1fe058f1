"""Control of all robots of a relay."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from relay_db.queries import StopRecord
from relay_server.clock import Clock
from relay_server.control.desk import Desk
from relay_server.control.lease import FREE
from relay_server.control.record import Record
from relay_server.control.stopping import Stopped
from relay_server.control.terms import ControlRules, Standing
from relay_server.registry import Presence


class Desks:
    """One desk for each robot, made when somebody first asks for it.

    :param changed: called when what the list of robots shows is another
    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        clock: Clock,
        record: Record,
        rules: ControlRules,
        changed: Callable[[], None],
        wall: Callable[[], float],
    ) -> None:
        self._clock = clock
        self._record = record
        self._rules = rules
        self._changed = changed
        self._wall = wall
        self._desks: dict[int, Desk] = {}
        self._expected: dict[int, StopRecord] = {}

    def __iter__(self) -> Iterator[Desk]:
        return iter(list(self._desks.values()))

    def of(self, robot: Presence) -> Desk:
        """The robot's desk."""
        desk = self._desks.get(robot.robot_id)
        if desk is None:
            desk = Desk(self._clock, robot, self._record, self._rules, self._changed, self._wall)
            self._desks[robot.robot_id] = desk
            desk.stopping.expect(self._expected.pop(robot.robot_id, None))
        return desk

    def standing(self, robot_id: int) -> Standing:
        """Who commands a robot, and whether it is stopped, also of one that nobody has asked for yet."""
        desk = self._desks.get(robot_id)
        if desk is not None:
            return desk.standing
        order = self._expected.get(robot_id)
        return Standing(FREE, {}, None if order is None else Stopped(order.by, order.why, order.at, False))

    def holder(self, robot: Presence) -> int:
        """The number of the connection that has control of a robot, 0 for none."""
        tenure = self.standing(robot.robot_id).lease.holder
        return 0 if tenure is None else tenure.client.number

    async def coming(self, robot: Presence) -> None:
        """A robot has proved itself and is about to register: what it is to be told first is looked up.

        :raises SwitchboardError: nobody can say
        """
        self.of(robot).stopping.expect(await self._record.pending(robot))

    def expect(self, orders: Iterable[StopRecord]) -> None:
        """Orders to stop, as the database has them. Robots that are there are told now."""
        self._expected = {order.robot_id: order for order in orders}
        for desk in self:
            order = self._expected.pop(desk.robot.robot_id, None)
            if desk.stopping.expect(order) and desk.robot.control is not None:
                desk.stopping.came()

    def forget(self, robot_id: int) -> None:
        """The robot was removed."""
        self._desks.pop(robot_id, None)
        self._expected.pop(robot_id, None)
