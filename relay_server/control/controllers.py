"""The controllers of all robots of a relay, and their stops stored in the database."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from relay_db.queries import StopRecord
from relay_protocol.clocks import now_ns
from relay_server.common.clock import Clock
from relay_server.control.controller import RobotController
from relay_server.control.lease import FREE
from relay_server.control.records import AuditSink
from relay_server.control.stopping import StopState
from relay_server.control.stored_stops import PendingStops
from relay_server.control.types import ControlRules, ControlSnapshot
from relay_server.robots.registry import RobotState


class _StoredStop(NamedTuple):
    """A stop stored in the database.

    :param seen: when it was first read from there, the relay's monotonic nanoseconds
    """

    stop: StopRecord
    seen: int


class Controllers:
    """One controller for each robot, made when it is first needed.

    :param changed: called when an entry of the list of robots has changed
    :param wall: Unix time in seconds
    :param clock_ns: the relay's monotonic nanoseconds
    """

    def __init__(
        self,
        clock: Clock,
        record: AuditSink,
        stop_store: PendingStops,
        rules: ControlRules,
        changed: Callable[[], None],
        wall: Callable[[], float],
        clock_ns: Callable[[], int] = now_ns,
    ) -> None:
        self._clock = clock
        self._record = record
        self._stop_store = stop_store
        self._rules = rules
        self._changed = changed
        self._wall = wall
        self._clock_ns = clock_ns
        self._controllers: dict[int, RobotController] = {}
        self._stored_stops: dict[int, _StoredStop] = {}

    def __iter__(self) -> Iterator[RobotController]:
        return iter(list(self._controllers.values()))

    def of(self, robot: RobotState) -> RobotController:
        """The robot's controller."""
        controller = self._controllers.get(robot.robot_id)
        if controller is None:
            controller = self._controllers[robot.robot_id] = RobotController(
                clock=self._clock,
                robot=robot,
                record=self._record,
                stop_store=self._stop_store,
                rules=self._rules,
                changed=self._changed,
                wall=self._wall,
                clock_ns=self._clock_ns,
            )
            stored = self._stored_stops.pop(robot.robot_id, None)
            if stored is not None:
                controller.stopping.add_stored(stored.stop, stored.seen, stored.seen)
        return controller

    def snapshot(self, robot_id: int) -> ControlSnapshot:
        """The control snapshot of a robot, also where it has no controller yet."""
        controller = self._controllers.get(robot_id)
        if controller is not None:
            return controller.snapshot
        stored = self._stored_stops.get(robot_id)
        if stored is None:
            return ControlSnapshot(FREE, {}, None)
        stop = stored.stop
        return ControlSnapshot(FREE, {}, StopState(stop.by, stop.why, stop.at, confirmed=False))

    def holder(self, robot: RobotState) -> int:
        """The number of the connection that has control of a robot, 0 for none."""
        holder = self.snapshot(robot.robot_id).lease.holder
        return 0 if holder is None else holder.client.number

    async def robot_connecting(self, robot: RobotState) -> None:
        """Read the stop that a robot must be sent first, when it has proved its identity and is about to register.

        :raises SwitchboardError: the database does not answer
        """
        read_at = self._clock_ns()
        stop = await self._stop_store.pending_stop(robot)
        self.of(robot).stopping.add_stored(stop, self._clock_ns(), read_at)

    async def read_stored_stops(self) -> None:
        """Read the stops stored in the database, and send new ones to robots that are online.

        :raises SwitchboardError: the database does not answer
        """
        read_at = self._clock_ns()
        self._take_stored(await self._stop_store.pending_stops(), read_at)

    @property
    def waits_in_database(self) -> bool:
        """Whether the database has stops for robots that are not connected to this relay, as far as is known."""
        return bool(self._stored_stops) or any(each.stopping.waits_in_database for each in self)

    def _take_stored(self, stops: Iterable[StopRecord], read_at: int) -> None:
        now, before = self._clock_ns(), self._stored_stops
        self._stored_stops = {stop.robot_id: _StoredStop(stop, now) for stop in stops}
        for robot_id, known in before.items():
            if robot_id in self._stored_stops and self._stored_stops[robot_id].stop == known.stop:
                self._stored_stops[robot_id] = known
        for controller in self:
            stop, seen = self._stored_stops.pop(controller.robot.robot_id, (None, now))
            if (
                controller.stopping.add_stored(stop, seen, read_at)
                and controller.robot.control_link is not None
            ):
                controller.stopping.send_pending()

    def forget(self, robot_id: int) -> None:
        """Drop the state of a removed robot."""
        self._controllers.pop(robot_id, None)
        self._stored_stops.pop(robot_id, None)
