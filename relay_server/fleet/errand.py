"""An order on one robot: done by a session of the asker's, and told in words."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from twisted.internet.defer import Deferred

from relay_protocol.errors import NotFound, Refused, SwitchboardError, Unavailable
from relay_server.channel import resolve
from relay_server.clock import Clock, cancel
from relay_server.fleet.client import OrderClient
from relay_server.fleet.order import Order
from relay_server.fleet.result import Outcome
from relay_server.session import Session
from relay_server.session.names import normal_type

LOOK_SECONDS = 0.02
"""How often it is looked whether the robot is ready for a message."""

SUBSCRIBER_SECONDS = 2.0
"""So long somebody who subscribes is waited for."""

MATCHING_SECONDS = 0.5
"""What ROS 2 has to bring a new publisher and its subscribers together, and to send what was published."""


class Errand:
    """What is to be done on one robot."""

    def __init__(self, clock: Clock, session: Session, client: OrderClient, order: Order) -> None:
        self._clock = clock
        self._session = session
        self._client = client
        self._order = order

    async def run(self) -> Outcome:
        """Do it. What goes wrong is told in the outcome."""
        try:
            return await _WAYS[self._order.do](self)
        except SwitchboardError as error:
            return Outcome(False, str(error))

    async def call(self) -> Outcome:
        """Call a service; one that moves the robot with control of it."""
        order, motion = self._order, self._session.robot.description.motion
        if not motion.moves_by_service(resolve(order.service)):
            return await self._call()
        await self._take_control()
        try:
            return await self._call()
        finally:
            self._session.desk.release(self._session, "the order is done")

    async def _call(self) -> Outcome:
        order = self._order
        answer = await self._client.call(order.service, order.args, order.type, order.timeout)
        return Outcome.of_service(answer.values) if answer.result else Outcome(False, str(answer.values))

    async def publish(self) -> Outcome:
        """Publish one message, once the robot can and somebody listens.

        :raises Refused: the topic counts as motion
        :raises NotFound: nobody knows the topic's type
        :raises Unavailable: the robot is offline
        """
        order, robot = self._order, self._session.robot
        if robot.control is None:
            raise Unavailable(f"robot {robot.name} is offline")
        topic = resolve(order.topic)
        known = robot.graph.topics.get(topic)
        types = [normal_type(order.type), *(known.types if known is not None else ())]
        if any(robot.is_motion(topic, each) for each in types):
            raise Refused(
                f"{topic} counts as motion on {robot.name}: one message moves no robot; call a service, or drive it"
            )
        type_name = next(filter(None, types), "")
        if not type_name:
            raise NotFound(f"there is no topic {topic} on {robot.name}; say its type")
        self._say("advertise", topic=topic, type=type_name)
        await self._until(
            lambda: any(each == topic for each, _ in self._session.channel.publications.active())
        )
        await self._until(lambda: self._subscribed(topic), SUBSCRIBER_SECONDS)
        await self._matching()
        self._say("publish", topic=topic, msg=order.msg)
        await self._matching()
        self._client.check()
        return Outcome(True)

    async def set(self) -> Outcome:
        """Set a parameter of a node."""
        args = {"name": self._order.name, "value": bytes(self._order.value).decode()}
        answer = await self._client.call("/rosapi/set_param", args)
        if not answer.result:
            return Outcome(False, str(answer.values))
        return Outcome(bool(answer.values["successful"]), str(answer.values["reason"]))

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

    # --- waiting ------------------------------------------------------------------------------------------

    def _say(self, op: str, **fields: object) -> None:
        self._client.say(op, **fields)
        self._client.check()

    def _subscribed(self, topic: str) -> bool:
        known = self._session.robot.graph.topics.get(topic)
        return known is not None and bool(known.subscribers)

    async def _matching(self) -> None:
        if "cdr" in self._session.robot.encodings:
            await self._sleep(MATCHING_SECONDS)

    async def _until(self, true: Callable[[], bool], seconds: float | None = None) -> None:
        """Wait until something holds, or for so long."""
        until = None if seconds is None else self._clock.seconds() + seconds
        while not true() and (until is None or self._clock.seconds() < until):
            await self._sleep(LOOK_SECONDS)
            self._client.check()
            if self._session.robot.control is None:
                raise Unavailable(f"robot {self._session.robot.name} went offline")

    async def _sleep(self, seconds: float) -> None:
        done: Deferred[None] = Deferred()
        timer = self._clock.callLater(seconds, done.callback, None)
        try:
            await done
        finally:
            cancel(timer)


_WAYS: dict[str, Callable[[Errand], Awaitable[Outcome]]] = {
    "call": Errand.call,
    "publish": Errand.publish,
    "set": Errand.set,
}
