"""Service calls: to the robot, and to clients that offer services, from its graph and from other clients."""

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
from relay_server.channels.encodings import PayloadCodec
from relay_server.channels.link_state import ChannelLinkPort, RobotLinkState
from relay_server.channels.members import RequestContext
from relay_server.channels.offered_services import OfferedService, OfferedServices, Provider
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.send_queue import CONTROL_BYTES

MAX_WAITING = 256
"""Most calls and goals that wait for one client."""

MAX_WAITING_BYTES = CONTROL_BYTES // 4 * 3
"""Most bytes of their arguments: a client that reads slowly must not be disconnected because of calls of others."""

ABANDONED_SECONDS = 30.0
"""Seconds that an unanswered request still counts after its requester has given up, as it may not be read yet."""


class PendingRequest(ABC):
    """A call or goal that was sent to the client that offers the service or action.

    :param id: unguessable; only this client knows it
    :param args: JSON
    """

    def __init__(self, id: str, offered: OfferedService, args: bytes) -> None:
        self.id = id
        self.offered = offered
        self.size = len(args)
        self.abandoned: Timer | None = None

    @abstractmethod
    def withdrawn(self, reason: str) -> None:
        """The client will never answer."""


R = TypeVar("R", bound=PendingRequest)


class PendingRequests:
    """All pending requests of one channel.

    :param new_id: returns an unguessable text
    """

    def __init__(self, clock: Clock, new_id: Callable[[], str]) -> None:
        self._clock = clock
        self.new_id = new_id
        self._by_client: dict[Provider, dict[str, PendingRequest]] = {}

    def add(self, request: PendingRequest) -> None:
        """Add a request.

        :raises Unavailable: too many requests, or too many bytes, wait for the client
        """
        offered = request.offered
        waiting = self._by_client.get(offered.member, {})
        if len(waiting) >= MAX_WAITING:
            raise Unavailable(f"{MAX_WAITING} calls and goals wait for the client that offers {offered.name}")
        if request.size + sum(each.size for each in waiting.values()) > MAX_WAITING_BYTES:
            raise Unavailable(
                f"this is too large for the client that offers {offered.name}, with what waits for it already"
            )
        self._by_client.setdefault(offered.member, {})[request.id] = request

    def find(self, member: Provider, id: rosbridge.Id, kind: type[R]) -> R:
        """The request that was sent to a client with an id.

        :raises Refused: there is none; ids of other clients give the same answer
        """
        request = self._by_client.get(member, {}).get(str(id))
        if not isinstance(request, kind):
            raise Refused(f"no call or goal with the id '{str(id)[:80]}' waits for you")
        return request

    def remove(self, request: PendingRequest) -> None:
        """Remove a request that was answered or has timed out."""
        cancel(request.abandoned)
        waiting = self._by_client.get(request.offered.member, {})
        waiting.pop(request.id, None)
        if not waiting:
            self._by_client.pop(request.offered.member, None)

    def abandon(self, request: PendingRequest) -> None:
        """The requester does not wait any more; the request counts for :data:`ABANDONED_SECONDS`."""
        if request.abandoned is None and request.id in self._by_client.get(request.offered.member, {}):
            request.abandoned = self._clock.callLater(ABANDONED_SECONDS, self.remove, request)

    def offer_ended(self, offered: OfferedService, reason: str) -> None:
        """End the requests for a service or action that is not offered any more."""
        for request in list(self._by_client.get(offered.member, {}).values()):
            if request.offered is offered:
                self.remove(request)
                request.withdrawn(reason)


MAX_CALLS = 1024
"""Most calls of clients that wait for one robot."""

CANCEL_GOALS = "/_action/cancel_goal"
"""Suffix of the name of the service by which an action's goals are cancelled (design.ros2.org, actions)."""

GRACE = 1.0
"""Seconds after its timeout at which the relay ends a call; the robot ends it at the timeout."""


class ServiceCalls:
    """Calls of clients. Each is answered exactly once: by the robot, at its timeout, or when the link is lost."""

    def __init__(
        self,
        clock: Clock,
        link_state: RobotLinkState,
        codec: PayloadCodec,
        offered_services: OfferedServices,
        client_calls: ClientServiceCalls,
    ) -> None:
        self._clock = clock
        self._link_state = link_state
        self._codec = codec
        self._offered_services = offered_services
        self._client_calls = client_calls
        self._ids = itertools.count(1)
        self._pending: dict[str, Deferred[link.ServiceResponse]] = {}

    async def call(
        self, service: str, type_name: str, args: bytes, seconds: float, context: RequestContext
    ) -> bytes:
        """Call a service of the client that offers it, else of the robot.

        :param type_name: as the client gave it; the type in the graph has precedence
        :param args: JSON, an object or a list of the fields in order; may be empty
        :param seconds: most seconds until the answer
        :returns: the response as JSON
        :raises Refused: it moves the robot, and may be too old by the time it can be sent
        :raises NotFound: no such service
        :raises Invalid: the arguments do not fit its type
        :raises Unavailable: there was no answer in time, the service failed, or the link to the robot was lost
        """
        offered = self._offered_services.find_usable(service)
        if offered is not None:
            return await self._call_client(offered, args, seconds, context)
        type_name = self._known_type(service) or type_name
        if not type_name:
            raise NotFound(f"service {service} does not exist on robot {self._link_state.robot.name}")
        await self._codec.ready(type_name)
        context.check_age()
        message = self._message(service, type_name, args, seconds, context)
        response = await self._exchange(message, seconds)
        if not response.result:
            raise Unavailable(response.reason or f"service {service} failed")
        return self._values(type_name, response)

    def _known_type(self, service: str) -> str:
        """The type in the graph. Actions' hidden services are not in it; roslibjs cancels all goals by one of them."""
        graph = self._link_state.robot.graph
        action = service.removesuffix(CANCEL_GOALS)
        if action != service and graph.action_type(action):
            return "action_msgs/srv/CancelGoal"
        return graph.service_type(service) or ""

    async def _call_client(
        self, offered: OfferedService, args: bytes, seconds: float, context: RequestContext
    ) -> bytes:
        """Call a client directly. Through the robot, a refusal could only come back as a call without an answer."""
        await self._codec.ready(offered.type)
        context.check_age()
        self._offered_services.check(offered)
        request = self._codec.from_client(f"{offered.type}_Request", args)
        response = await self._client_calls.call(offered, request, seconds)
        return self._codec.to_client(f"{offered.type}_Response", response)

    def answered(self, response: link.ServiceResponse) -> None:
        """The robot has answered a call; an answer to no call is dropped."""
        waiting = self._pending.pop(response.id, None)
        if waiting is not None:
            waiting.callback(response)

    def lost(self) -> None:
        """The link is lost: all calls fail."""
        pending, self._pending = self._pending, {}
        for waiting in pending.values():
            waiting.errback(
                Unavailable(f"robot {self._link_state.robot.name} lost its connection during the call")
            )

    def _message(
        self, service: str, type_name: str, args: bytes, seconds: float, context: RequestContext
    ) -> link.CallService:
        body = self._codec.from_client(f"{type_name}_Request", args)
        return link.CallService(
            id=str(next(self._ids)),
            service=service,
            type=type_name,
            timeout=seconds,
            source=context.source,
            stamp=context.earliest_sent,
            **self._codec.args(body),
        )

    async def _exchange(self, message: link.CallService, seconds: float) -> link.ServiceResponse:
        if len(self._pending) >= MAX_CALLS:
            raise Unavailable(f"{MAX_CALLS} calls are waiting on this robot already")
        if self._link_state.link is None:
            raise Unavailable(f"robot {self._link_state.robot.name} is not connected")
        waiting: Deferred[link.ServiceResponse] = Deferred()
        self._pending[message.id] = waiting
        timer = self._clock.callLater(seconds + GRACE, self._timed_out, message, seconds)
        try:
            self._link_state.send(message)
            return await waiting
        finally:
            self._pending.pop(message.id, None)
            cancel(timer)

    def _timed_out(self, message: link.CallService, seconds: float) -> None:
        waiting = self._pending.pop(message.id, None)
        if waiting is not None:
            waiting.errback(Unavailable(f"service {message.service} did not answer within {seconds:g} s"))

    def _values(self, type_name: str, response: link.ServiceResponse) -> bytes:
        try:
            part = f"{type_name}_Response"
            return self._codec.to_client(part, self._codec.from_robot(part, response.cdr, response.values))
        except SwitchboardError as error:
            raise Invalid(f"the robot's answer can't be read: {error}") from None


MAX_GRAPH_CALLS = 1024
"""Most calls from one robot's graph that wait for clients."""

LONGEST_CALL = 3600.0
"""Longest timeout of a call, seconds."""


def call_seconds(timeout: float | None) -> float:
    """Seconds that a call may take.

    :param timeout: that the caller requested; none, 0 or less: the usual one
    """
    return min(timeout, LONGEST_CALL) if timeout and timeout > 0 else limits.CALL_SECONDS


class _ClientCall(PendingRequest):
    """A call that was sent to the client that offers the service."""

    waiting: Deferred[bytes] | None = None
    timer: Timer | None = None

    def withdrawn(self, reason: str) -> None:
        """The client will never answer."""
        self.answer(Unavailable(reason))

    def answer(self, answer: bytes | SwitchboardError) -> None:
        """Give the caller its answer, if it still waits."""
        cancel(self.timer)
        waiting, self.waiting = self.waiting, None
        if waiting is None:
            return
        if isinstance(answer, bytes):
            waiting.callback(answer)
        else:
            waiting.errback(answer)


class ClientServiceCalls:
    """Calls to clients that offer services.

    Each is answered exactly once: by the client, at its timeout, or when the client has left.
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        link_state: RobotLinkState,
        codec: PayloadCodec,
        offered_services: OfferedServices,
        pending: PendingRequests,
    ) -> None:
        self._clock = clock
        self._link_state = link_state
        self._codec = codec
        self._offered_services = offered_services
        self._pending = pending
        self._graph_calls: set[Deferred[None]] = set()

    def call(self, offered: OfferedService, request: bytes, seconds: float) -> Deferred[bytes]:
        """Call the client that offers the service; cancel the result when the answer is not needed any more.

        :param request: a body, see :class:`PayloadCodec`
        :param seconds: most seconds until the answer
        :returns: fires with a body; fails with :class:`Unavailable` when the client does not answer or refuses
        :raises Invalid: the request is no body of this type
        :raises Unavailable: too much waits for the client
        """
        args = self._codec.to_client(f"{offered.type}_Request", request)
        call = _ClientCall(self._pending.new_id(), offered, args)
        self._pending.add(call)
        waiting = call.waiting = Deferred(lambda _: self._cancelled(call))
        call.timer = self._clock.callLater(seconds, self._timed_out, call, seconds)
        offered.member.port.call_service(offered.written, call.id, args)
        return waiting

    def answered(self, member: Provider, answer: rosbridge.ServiceResponse) -> None:
        """A client answers a call.

        :raises Refused: the client has no call of this id
        :raises Invalid: the answer does not fit the type; the caller gets the reason too
        """
        call = self._pending.find(member, answer.id, _ClientCall)
        self._pending.remove(call)
        name, text = call.offered.name, bytes(answer.values or b"")
        try:
            if not answer.result:
                reason = refusal_reason(text) or f"the client that offers {name} could not do it"
                call.answer(Unavailable(reason))
                return
            body = self._codec.from_client(f"{call.offered.type}_Response", text)
        except SwitchboardError as error:
            call.answer(Unavailable(f"the client that offers {name} gave a wrong answer: {error}"))
            raise
        call.answer(body)

    def call_from_graph(self, message: link.CallService) -> None:
        """The graph calls a service that a client offers."""
        origin = self._link_state.link
        if origin is None:
            return
        if len(self._graph_calls) >= MAX_GRAPH_CALLS:
            origin.send(_refusal(message, f"{MAX_GRAPH_CALLS} calls from the graph are under way already"))
            return
        running = Deferred.fromCoroutine(self._serve(message, origin))
        self._graph_calls.add(running)
        running.addErrback(self._unexpected, message, origin)
        running.addBoth(self._graph_call_ended, running)

    def lost(self) -> None:
        """The link is lost, and with it the callers in the graph."""
        for running in list(self._graph_calls):
            running.cancel()

    async def _serve(self, message: link.CallService, origin: ChannelLinkPort) -> None:
        try:
            body = await self._answer(message)
        except SwitchboardError as error:
            response = _refusal(message, str(error))
        else:
            response = link.ServiceResponse(id=message.id, result=True, **self._codec.values(body))
        try:
            origin.send(response)
        except Unavailable as error:
            origin.send(_refusal(message, str(error)))

    async def _answer(self, message: link.CallService) -> bytes:
        offered = self._offered_services.find_usable(message.service)
        if offered is None:
            raise NotFound(f"no client offers the service {message.service}")
        await self._codec.ready(offered.type)
        self._offered_services.check(offered)
        request = self._codec.from_robot(f"{offered.type}_Request", message.cdr, message.args)
        return await self.call(offered, request, call_seconds(message.timeout))

    def _cancelled(self, call: _ClientCall) -> None:
        call.waiting = None
        cancel(call.timer)
        self._pending.abandon(call)

    def _timed_out(self, call: _ClientCall, seconds: float) -> None:
        self._pending.abandon(call)
        call.answer(
            Unavailable(f"the client that offers {call.offered.name} did not answer within {seconds:g} s")
        )

    def _unexpected(self, failure: Failure, message: link.CallService, origin: ChannelLinkPort) -> None:
        if failure.check(CancelledError):
            return
        self.log.failure("a call of {service} from the graph failed", failure, service=message.service)
        origin.send(_refusal(message, "the relay failed on this call; see its log"))

    def _graph_call_ended(self, _: Any, running: Deferred[None]) -> None:
        self._graph_calls.discard(running)


def refusal_reason(text: bytes) -> str:
    """The reason of a client's refusal.

    :param text: JSON, the ``values`` of its answer: usually a string
    """
    value = jsontext.decode_any(text) if text else ""
    reason = value if isinstance(value, str) else jsontext.encode(value).decode()
    return reason[: limits.TEXT_LENGTH]


def _refusal(message: link.CallService, reason: str) -> link.ServiceResponse:
    return link.ServiceResponse(id=message.id, result=False, reason=reason)
