"""An order on one robot: carried out by a session of the user, except for stops and resumes, which need none."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from relay_db.queries import RobotRecord
from relay_protocol.errors import Refused, SwitchboardError
from relay_server.access import Permit
from relay_server.channels.names import resolve
from relay_server.common.clock import Clock
from relay_server.control.actor import Actor
from relay_server.control.service import ControlService
from relay_server.fleet.order import Order, TaskOutcome, moves
from relay_server.in_process_sessions.in_process_port import InProcessPort
from relay_server.in_process_sessions.one_shot_publisher import OneShotPublisher, may_move, type_of
from relay_server.robots.registry import RobotRegistry, RobotState


class FleetTask:
    """An order on one robot.

    :param check_age: raises when the order is too old to move the robot
    """

    def __init__(
        self,
        clock: Clock,
        control: ControlService,
        port: InProcessPort,
        order: Order,
        check_age: Callable[[], None],
    ) -> None:
        self._clock = clock
        self._control = control
        self._check_age = check_age
        self._client = port.client
        self._port = port
        self._order = order

    async def run(self) -> TaskOutcome:
        """Carry it out. Errors become the outcome."""
        try:
            if moves(self._client.robot, self._order):
                self._check_age()
            return await _METHODS[self._order.do](self)
        except SwitchboardError as error:
            return TaskOutcome(False, str(error))

    async def call(self) -> TaskOutcome:
        """Call a service; if it moves the robot, with control of it."""
        order, motion = self._order, self._client.robot.description.motion
        if not motion.moves_by_service(resolve(order.service)):
            return await self._call()
        await self._take_control()
        try:
            self._check_age()
            return await self._call()
        finally:
            self._control.release(self._client, "the order is done")

    async def _call(self) -> TaskOutcome:
        order = self._order
        answer = await self._port.call(order.service, order.args, order.type, order.timeout)
        said = answer.read
        return TaskOutcome.from_service(said) if answer.result else TaskOutcome(False, str(said))

    async def publish(self) -> TaskOutcome:
        """Publish one message, once the robot can and a subscriber exists.

        :raises Refused: the topic counts as motion
        :raises NotFound: the topic's type is not known
        :raises Unavailable: the robot is offline
        """
        order, client = self._order, self._client
        topic = resolve(order.topic)
        type_name = type_of(client, topic, order.type)
        if may_move(client, topic, type_name):
            name = client.robot.name
            raise Refused(
                f"{topic} counts as motion on {name}, and one message moves no robot; call a service, or drive it"
            )
        await OneShotPublisher(self._clock, self._port, topic).publish(order.msg, type_name)
        return TaskOutcome(True)

    async def set(self) -> TaskOutcome:
        """Set a parameter of a node."""
        args = {"name": self._order.name, "value": bytes(self._order.value).decode()}
        answer = await self._port.call_own("/rosapi/set_param", args)
        return TaskOutcome(bool(answer["successful"]), str(answer["reason"]))

    async def _take_control(self) -> None:
        """:raises Refused: another user has control, or the user may not have it
        :raises Unavailable: the robot is offline, or does not confirm
        """
        client = self._client
        lease = client.controller.lease
        has_it = lease.holder or lease.pending_holder
        if has_it is not None and has_it.client is not client:
            if has_it.client.user == client.user:
                name = client.robot.name
                raise Refused(f"another connection of yours has control of {name}: release it there first")
            # A request would take control some time later, when the user no longer expects it.
            raise Refused(f"{has_it.client.name} has control of {client.robot.name}")
        answer = await self._control.take(client, self._order.why or "an order to many robots")
        if not answer.success:
            self._control.release(client, "the order does not wait")
            raise Refused(answer.message)


_METHODS: dict[str, Callable[[FleetTask], Awaitable[TaskOutcome]]] = {
    "call": FleetTask.call,
    "publish": FleetTask.publish,
    "set": FleetTask.set,
}


class FleetStop:
    """Stops and resumes one robot of an order."""

    def __init__(self, control: ControlService, registry: RobotRegistry) -> None:
        self._control = control
        self._registry = registry

    def online(self, record: RobotRecord) -> bool:
        """Whether the robot can be reached now."""
        robot = self._registry.find(record.id)
        return robot is not None and robot.control_link is not None

    async def stop(self, record: RobotRecord, actor: Actor, why: str, stop_id: str) -> TaskOutcome:
        """Stop a robot: the command is on its way before anything is waited for.

        :raises Unavailable: as of :meth:`ControlService.stop`
        """
        result = await self._control.stop(self._robot(record), actor, why, stop_id)
        if result.done:
            return TaskOutcome(True)
        return TaskOutcome(not result.failed, result.sentence(record.name), pending=not result.failed)

    async def resume(
        self, record: RobotRecord, permit: Permit, actor: Actor, why: str, earliest_sent: int
    ) -> TaskOutcome:
        """See :meth:`ControlService.resume`.

        :param permit: of the caller
        """
        await self._control.resume(self._robot(record), permit, actor, why, earliest_sent)
        return TaskOutcome(True)

    def _robot(self, record: RobotRecord) -> RobotState:
        return self._registry.robot(record.id, record.name, record.realm)
