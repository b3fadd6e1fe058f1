"""Service calls of clients: on their way to the robot and back, or to another client that offers the service."""

from __future__ import annotations

import itertools

from twisted.internet.defer import Deferred

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_server.channel.bodies import Bodies
from relay_server.channel.offers import Offer, Offers
from relay_server.channel.serving import ServedCalls
from relay_server.channel.wire import Sent, Wire
from relay_server.clock import Clock, cancel

PENDING = 1024
"""Calls under way on one robot."""

CANCEL_GOALS = "/_action/cancel_goal"
"""How the name of the service ends by which an action takes cancellations (design.ros2.org, actions)."""

GRACE = 1.0
"""The robot gives up by itself at the timeout; this much later the relay does, seconds."""


class Calls:
    """Calls under way, each answered exactly once: by the robot, by time, or by the loss of the link."""

    def __init__(self, clock: Clock, wire: Wire, bodies: Bodies, offers: Offers, served: ServedCalls) -> None:
        self._clock = clock
        self._wire = wire
        self._bodies = bodies
        self._offers = offers
        self._served = served
        self._ids = itertools.count(1)
        self._pending: dict[str, Deferred[link.ServiceResponse]] = {}

    async def call(self, service: str, type_name: str, args: bytes, seconds: float, sent: Sent) -> bytes:
        """Call a service of the robot, or of a client that offers it there.

        :param type_name: as the client gave it; the graph's type wins
        :param args: JSON, an object or a list of the fields in order; may be empty
        :param seconds: the robot has for its answer
        :returns: the response as JSON
        :raises Refused: it moves the robot, and may be too old when it could be sent
        :raises NotFound: no such service
        :raises Invalid: arguments that do not fit its type
        :raises Unavailable: no answer in time, the service said no, or the robot was lost
        """
        offer = self._offers.standing(service)
        if offer is not None:
            return await self._ask_client(offer, args, seconds, sent)
        type_name = self._known_type(service) or type_name
        if not type_name:
            raise NotFound(f"service {service} does not exist on robot {self._wire.robot.name}")
        await self._bodies.ready(type_name)
        sent.judge()
        message = self._message(service, type_name, args, seconds, sent)
        response = await self._exchange(message, seconds)
        if not response.result:
            raise Unavailable(response.reason or f"service {service} failed")
        return self._values(type_name, response)

    def _known_type(self, service: str) -> str:
        """By the graph, which does not show the hidden services of actions; roslibjs cancels all goals by one."""
        graph = self._wire.robot.graph
        action = service.removesuffix(CANCEL_GOALS)
        if action != service and graph.action_type(action):
            return "action_msgs/srv/CancelGoal"
        return graph.service_type(service) or ""

    async def _ask_client(self, offer: Offer, args: bytes, seconds: float, sent: Sent) -> bytes:
        """What goes by the robot could come back only as a call without an answer when the client says no."""
        await self._bodies.ready(offer.type)
        sent.judge()
        self._offers.check(offer)
        request = self._bodies.from_client(f"{offer.type}_Request", args)
        response = await self._served.ask(offer, request, seconds)
        return self._bodies.to_client(f"{offer.type}_Response", response)

    def answered(self, response: link.ServiceResponse) -> None:
        """The robot's answer; one nobody waits for is let go."""
        waiting = self._pending.pop(response.id, None)
        if waiting is not None:
            waiting.callback(response)

    def lost(self) -> None:
        """The link is gone: no answer will come."""
        pending, self._pending = self._pending, {}
        for waiting in pending.values():
            waiting.errback(Unavailable(f"robot {self._wire.robot.name} lost its connection during the call"))

    def _message(
        self, service: str, type_name: str, args: bytes, seconds: float, sent: Sent
    ) -> link.CallService:
        body = self._bodies.from_client(f"{type_name}_Request", args)
        return link.CallService(
            id=str(next(self._ids)),
            service=service,
            type=type_name,
            timeout=seconds,
            source=sent.source,
            stamp=sent.stamp,
            **self._bodies.args(body),
        )

    async def _exchange(self, message: link.CallService, seconds: float) -> link.ServiceResponse:
        if len(self._pending) >= PENDING:
            raise Unavailable(f"{PENDING} calls are waiting on this robot already")
        if self._wire.link is None:
            raise Unavailable(f"robot {self._wire.robot.name} is not connected")
        waiting: Deferred[link.ServiceResponse] = Deferred()
        self._pending[message.id] = waiting
        self._wire.send(message)
        timer = self._clock.callLater(seconds + GRACE, self._late, message, seconds)
        try:
            return await waiting
        finally:
            self._pending.pop(message.id, None)
            cancel(timer)

    def _late(self, message: link.CallService, seconds: float) -> None:
        waiting = self._pending.pop(message.id, None)
        if waiting is not None:
            waiting.errback(Unavailable(f"service {message.service} did not answer within {seconds:g} s"))

    def _values(self, type_name: str, response: link.ServiceResponse) -> bytes:
        try:
            part = f"{type_name}_Response"
            return self._bodies.to_client(part, self._bodies.from_robot(part, response.cdr, response.values))
        except SwitchboardError as error:
            raise Invalid(f"the robot's answer can't be read: {error}") from None
