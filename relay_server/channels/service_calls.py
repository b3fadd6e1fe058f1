"""Calls of services that clients offer, from the robot's graph and from other clients."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, TypeVar

from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol import jsontext, limits, link, rosbridge
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable
from relay_server.channels.advertisements import ClientAdvertisement, ClientAdvertisements, Provider
from relay_server.channels.payloads import PayloadCodec
from relay_server.channels.robot_link import ChannelPort, RequestContext, RobotLinkState
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.send_queue import CONTROL_BYTES

WAITING = 256
"""Calls and goals that may wait for one client."""

WAITING_BYTES = CONTROL_BYTES // 4 * 3
"""Their arguments together. A client that reads slowly is not cut for what others ask of it."""

PLACE_SECONDS = 30.0
"""What nobody waits for any more keeps its place for so long, or until it is answered: it may not be read yet."""


class PendingRequest(ABC):
    """One call or goal on its way to the client that offers the service or action.

    :param id: unguessable; only the client that was asked knows it
    :param args: JSON
    """

    def __init__(self, id: str, offer: ClientAdvertisement, args: bytes) -> None:
        self.id = id
        self.offer = offer
        self.size = len(args)
        self.fading: Timer | None = None

    @abstractmethod
    def withdrawn(self, reason: str) -> None:
        """The client will never answer."""


E = TypeVar("E", bound=PendingRequest)


class PendingRequests:
    """All of one channel.

    :param new_id: makes an unguessable text
    """

    def __init__(self, clock: Clock, new_id: Callable[[], str]) -> None:
        self._clock = clock
        self.new_id = new_id
        self._of: dict[Provider, dict[str, PendingRequest]] = {}

    def add(self, errand: PendingRequest) -> None:
        """One more.

        :raises Unavailable: the client has too much to do
        """
        offer = errand.offer
        waiting = self._of.get(offer.member, {})
        if len(waiting) >= WAITING:
            raise Unavailable(f"{WAITING} calls and goals wait for the client that offers {offer.name}")
        if errand.size + sum(each.size for each in waiting.values()) > WAITING_BYTES:
            raise Unavailable(
                f"this is too large for the client that offers {offer.name}, with what waits for it already"
            )
        self._of.setdefault(offer.member, {})[errand.id] = errand

    def find(self, member: Provider, id: rosbridge.Id, kind: type[E]) -> E:
        """What this client was asked under this id.

        :raises Refused: nothing; others' ids are not told from unknown ones
        """
        errand = self._of.get(member, {}).get(str(id))
        if not isinstance(errand, kind):
            raise Refused(f"you were asked nothing under the id '{str(id)[:80]}', or it is over")
        return errand

    def remove(self, errand: PendingRequest) -> None:
        """It is answered, or its time is over."""
        cancel(errand.fading)
        waiting = self._of.get(errand.offer.member, {})
        waiting.pop(errand.id, None)
        if not waiting:
            self._of.pop(errand.offer.member, None)

    def fade(self, errand: PendingRequest) -> None:
        """Nobody waits for the answer any more."""
        if errand.fading is None and errand.id in self._of.get(errand.offer.member, {}):
            errand.fading = self._clock.callLater(PLACE_SECONDS, self.remove, errand)

    def offer_ended(self, offer: ClientAdvertisement, reason: str) -> None:
        """What the offering client was asked will not be answered."""
        for errand in list(self._of.get(offer.member, {}).values()):
            if errand.offer is offer:
                self.remove(errand)
                errand.withdrawn(reason)


PENDING = 1024
"""Calls under way on one robot."""

CANCEL_GOALS = "/_action/cancel_goal"
"""How the name of the service ends by which an action takes cancellations (design.ros2.org, actions)."""

GRACE = 1.0
"""The robot gives up by itself at the timeout; this much later the relay does, seconds."""


class ServiceCalls:
    """Calls under way, each answered exactly once: by the robot, by time, or by the loss of the link."""

    def __init__(
        self,
        clock: Clock,
        wire: RobotLinkState,
        bodies: PayloadCodec,
        offers: ClientAdvertisements,
        served: ClientServiceCalls,
    ) -> None:
        self._clock = clock
        self._wire = wire
        self._bodies = bodies
        self._offers = offers
        self._served = served
        self._ids = itertools.count(1)
        self._pending: dict[str, Deferred[link.ServiceResponse]] = {}

    async def call(
        self, service: str, type_name: str, args: bytes, seconds: float, sent: RequestContext
    ) -> bytes:
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

    async def _ask_client(
        self, offer: ClientAdvertisement, args: bytes, seconds: float, sent: RequestContext
    ) -> bytes:
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
        self, service: str, type_name: str, args: bytes, seconds: float, sent: RequestContext
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
        timer = self._clock.callLater(seconds + GRACE, self._late, message, seconds)
        try:
            self._wire.send(message)
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


GRAPH_CALLS = 1024
"""Calls from one robot's graph that may be under way."""

LONGEST_CALL = 3600.0
"""Most seconds a caller may give a service."""


def call_seconds(timeout: float | None) -> float:
    """How long a call may take, by what the caller asked for."""
    return min(timeout, LONGEST_CALL) if timeout and timeout > 0 else limits.CALL_SECONDS


class _ClientCall(PendingRequest):
    """A call on its way to the client that offers the service."""

    waiting: Deferred[bytes] | None = None
    late: Timer | None = None

    def withdrawn(self, reason: str) -> None:
        """The client will never answer."""
        self.settle(Unavailable(reason))

    def settle(self, answer: bytes | SwitchboardError) -> None:
        """Give the caller its answer, if it still waits."""
        cancel(self.late)
        waiting, self.waiting = self.waiting, None
        if waiting is None:
            return
        if isinstance(answer, bytes):
            waiting.callback(answer)
        else:
            waiting.errback(answer)


class ClientServiceCalls:
    """Each call is answered exactly once: by the client, by time, or because the client has gone."""

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        wire: RobotLinkState,
        bodies: PayloadCodec,
        offers: ClientAdvertisements,
        errands: PendingRequests,
    ) -> None:
        self._clock = clock
        self._wire = wire
        self._bodies = bodies
        self._offers = offers
        self._errands = errands
        self._graph_calls: set[Deferred[None]] = set()

    def ask(self, offer: ClientAdvertisement, request: bytes, seconds: float) -> Deferred[bytes]:
        """Have the client that offers the service answer a request; cancel it when nobody wants the answer any more.

        :param request: a body, see :class:`PayloadCodec`; the answer is one too
        :param seconds: the client has for its answer
        :raises Invalid: the request is no such body
        :raises Unavailable: the client has too much to do; the answer fails so when there is none or it says no
        """
        args = self._bodies.to_client(f"{offer.type}_Request", request)
        call = _ClientCall(self._errands.new_id(), offer, args)
        self._errands.add(call)
        waiting = call.waiting = Deferred(lambda _: self._give_up(call))
        call.late = self._clock.callLater(seconds, self._too_late, call, seconds)
        offer.member.say(rosbridge.call_service(offer.written, call.id, args))
        return waiting

    def answered(self, member: Provider, answer: rosbridge.ServiceResponse) -> None:
        """A client answers a call.

        :raises Refused: it was not asked that
        :raises Invalid: the answer does not fit the type; the caller is told too
        """
        call = self._errands.find(member, answer.id, _ClientCall)
        self._errands.remove(call)
        name, text = call.offer.name, bytes(answer.values or b"")
        try:
            if not answer.result:
                reason = reason_in(text) or f"the client that offers {name} could not do it"
                call.settle(Unavailable(reason))
                return
            body = self._bodies.from_client(f"{call.offer.type}_Response", text)
        except SwitchboardError as error:
            call.settle(Unavailable(f"the client that offers {name} gave an unfit answer: {error}"))
            raise
        call.settle(body)

    def called(self, message: link.CallService) -> None:
        """The graph calls a service that a client offers."""
        origin = self._wire.link
        if origin is None:
            return
        if len(self._graph_calls) >= GRAPH_CALLS:
            origin.send(_no(message, f"{GRAPH_CALLS} calls from the graph are under way already"))
            return
        running = Deferred.fromCoroutine(self._serve(message, origin))
        self._graph_calls.add(running)
        running.addErrback(self._unexpected, message, origin)
        running.addBoth(self._over, running)

    def lost(self) -> None:
        """The link is gone, and with it those who called over it."""
        for running in list(self._graph_calls):
            running.cancel()

    async def _serve(self, message: link.CallService, origin: ChannelPort) -> None:
        try:
            body = await self._answer(message)
        except SwitchboardError as error:
            response = _no(message, str(error))
        else:
            response = link.ServiceResponse(id=message.id, result=True, **self._bodies.values(body))
        try:
            origin.send(response)
        except Unavailable as error:
            origin.send(_no(message, str(error)))

    async def _answer(self, message: link.CallService) -> bytes:
        offer = self._offers.standing(message.service)
        if offer is None:
            raise NotFound(f"no client offers the service {message.service}")
        await self._bodies.ready(offer.type)
        self._offers.check(offer)
        request = self._bodies.from_robot(f"{offer.type}_Request", message.cdr, message.args)
        return await self.ask(offer, request, call_seconds(message.timeout))

    def _give_up(self, call: _ClientCall) -> None:
        call.waiting = None
        cancel(call.late)
        self._errands.fade(call)

    def _too_late(self, call: _ClientCall, seconds: float) -> None:
        self._errands.fade(call)
        call.settle(
            Unavailable(f"the client that offers {call.offer.name} did not answer within {seconds:g} s")
        )

    def _unexpected(self, failure: Failure, message: link.CallService, origin: ChannelPort) -> None:
        if failure.check(CancelledError):
            return
        self.log.failure("a call of {service} from the graph failed", failure, service=message.service)
        origin.send(_no(message, "the relay failed on this call; its log tells more"))

    def _over(self, _: Any, running: Deferred[None]) -> None:
        self._graph_calls.discard(running)


def reason_in(text: bytes) -> str:
    """Why a client says no, out of the ``values`` of its answer: a string, or whatever else it sent."""
    value = jsontext.decode_any(text) if text else ""
    words = value if isinstance(value, str) else jsontext.encode(value).decode()
    return words[: limits.WORDS]


def _no(message: link.CallService, reason: str) -> link.ServiceResponse:
    return link.ServiceResponse(id=message.id, result=False, reason=reason)
