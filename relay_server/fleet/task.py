"""An order on one robot: done by a session of the asker's, and told in words."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import msgspec

from relay_protocol import jsontext
from relay_protocol.errors import Refused, SwitchboardError
from relay_server.channels.robot_link import resolve
from relay_server.common.clock import Clock
from relay_server.fleet.order import Order, moves
from relay_server.fleet.result import TaskOutcome
from relay_server.http_sessions.loopback_client import LoopbackClient
from relay_server.http_sessions.one_shot_publisher import OneShotPublisher, may_move, type_of
from relay_server.sessions.session import Session


class FleetTask:
    """What is to be done on one robot.

    :param young: sees that it moves the robot in time, and raises else
    """

    def __init__(
        self, clock: Clock, session: Session, client: LoopbackClient, order: Order, young: Callable[[], None]
    ) -> None:
        self._clock = clock
        self._young = young
        self._session = session
        self._client = client
        self._order = order

    async def run(self) -> TaskOutcome:
        """Do it. What goes wrong is told in the outcome."""
        try:
            if moves(self._session.robot, self._order):
                self._young()
            return await _WAYS[self._order.do](self)
        except SwitchboardError as error:
            return TaskOutcome(False, str(error))

    async def call(self) -> TaskOutcome:
        """Call a service; one that moves the robot with control of it."""
        order, motion = self._order, self._session.robot.description.motion
        if not motion.moves_by_service(resolve(order.service)):
            return await self._call()
        await self._take_control()
        try:
            self._young()
            return await self._call()
        finally:
            self._session.desk.release(self._session, "the order is done")

    async def _call(self) -> TaskOutcome:
        order = self._order
        answer = await self._client.call(order.service, order.args, order.type, order.timeout)
        said = answer.read
        return TaskOutcome.of_service(said) if answer.result else TaskOutcome(False, str(said))

    async def publish(self) -> TaskOutcome:
        """Publish one message, once the robot can and somebody listens.

        :raises Refused: the topic counts as motion
        :raises NotFound: nobody knows the topic's type
        :raises Unavailable: the robot is offline
        """
        order, session = self._order, self._session
        topic = resolve(order.topic)
        type_name = type_of(session, topic, order.type)
        if may_move(session, topic, type_name):
            name = session.robot.name
            raise Refused(
                f"{topic} counts as motion on {name}: one message moves no robot; call a service, or drive it"
            )
        await OneShotPublisher(self._clock, self._client, session, topic).say(order.msg, type_name)
        return TaskOutcome(True)

    async def set(self) -> TaskOutcome:
        """Set a parameter of a node."""
        args = {"name": self._order.name, "value": bytes(self._order.value).decode()}
        answer = await self._client.call("/rosapi/set_param", msgspec.Raw(jsontext.encode(args)))
        said = answer.read
        if not answer.result:
            return TaskOutcome(False, str(said))
        return TaskOutcome(bool(said["successful"]), str(said["reason"]))

    async def _take_control(self) -> None:
        """:raises Refused: somebody else has it, or the asker may not
        :raises Unavailable: the robot is offline, or does not agree
        """
        session = self._session
        desk, lease = session.desk, session.desk.lease
        has_it = lease.holder or lease.coming
        if has_it is not None and has_it.client is not session:
            if has_it.client.user == session.user:
                name = session.robot.name
                raise Refused(
                    f"you have control of {name} yourself, by another connection: give it back there first"
                )
            # Only asked for, it would be taken from who has it some time later, when nobody expects that any more.
            raise Refused(f"{has_it.client.name} has control of {session.robot.name}")
        answer = await desk.take(session, self._order.why or "an order to many robots")
        if not answer.success:
            desk.release(session, "the order does not wait")
            raise Refused(answer.message)


_WAYS: dict[str, Callable[[FleetTask], Awaitable[TaskOutcome]]] = {
    "call": FleetTask.call,
    "publish": FleetTask.publish,
    "set": FleetTask.set,
}
