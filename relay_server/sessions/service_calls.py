"""Calls by a client to services, and services and actions that it offers: each call is answered exactly once."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from twisted.internet.defer import CancelledError, Deferred

from relay_protocol import jsontext, nonfinite, rosbridge
from relay_protocol.errors import Refused, SwitchboardError
from relay_protocol.limits import KIB, MIB
from relay_protocol.nonfinite import NotFinite
from relay_protocol.rights import Operation
from relay_server.channels.encodings import requested_encoding
from relay_server.channels.names import normal_type, resolve
from relay_server.sessions.context import ClientContext, LocalNode
from relay_server.sessions.motion_requests import call_context

CALLS = 256
CALL_BYTES = 2 * MIB
"""Most bytes of the arguments of all calls of one connection that wait."""
STOP = "/relay/stop"
RESUME = "/relay/resume"
STOPPING_SERVICES = (STOP, "/relay/release_control")
"""The relay's services that stop a robot. No limit of a user's calls or requests holds them back."""

STOPPING_CALLS = 16
"""Number of calls of :data:`STOPPING_SERVICES` that may wait beyond :data:`CALLS`."""

OWN_BYTES = 64 * KIB
"""Most bytes of arguments of the relay's own services. Parsing so many in nested lists takes 30 ms of the reactor."""
OWN_TOO_LARGE = f"arguments for the relay's own services may have {OWN_BYTES} bytes"


class ServiceCallHandler:
    """The calls of one session that wait for their answers."""

    def __init__(self, client: ClientContext, local: LocalNode) -> None:
        self._client = client
        self._local = local
        self._calls: dict[Deferred[Any], rosbridge.CallService] = {}
        self._bytes = 0
        self._ended = False

    def end(self) -> None:
        """The client is gone: cancel its calls, which makes room for others."""
        self._ended = True
        for call in list(self._calls):
            call.cancel()

    def rights_changed(self) -> None:
        """Cancel calls for which the client has no right any more. The relay's own services need none."""
        for call, operation in list(self._calls.items()):
            service = resolve(operation.service)
            may = self._client.permit.decide(Operation.CALL, service).allowed
            if not may and self._local.service(service) is None:
                call.cancel()

    def call(self, operation: rosbridge.CallService) -> None:
        """Call a service of the robot, or one of the relay's own."""
        service = resolve(operation.service)
        self._check_room(operation)
        requested_encoding(operation, self._client.notify)
        raw = bytes(operation.args or b"")
        size = len(raw)
        if self._bytes + size > CALL_BYTES and not is_stopping_call(operation):
            raise Refused(
                "the arguments of the calls that wait already are too large together; wait for answers"
            )
        local = self._local.service(service)
        if local is None:
            self._client.require(Operation.CALL, service)
            self._client.quota.count_robot_request()
            answer: Awaitable[bytes] = self._client.channel.requests.call(
                service,
                normal_type(operation.type, "srv"),
                raw,
                operation.timeout,
                call_context(self._client, service, self._client.earliest_sent, raw),
            )
        else:
            answer = self._call_local(local, own_arguments(service, raw), is_stopping_call(operation))
        running = Deferred.fromCoroutine(self._finish(operation, answer))
        self._calls[running] = operation
        self._bytes += size
        if local is None:
            self._client.activity("call.begun", service=service)
        running.addErrback(self._unexpected, operation)
        running.addBoth(self._call_ended, running, size, service if local is None else "")

    def call_own(self, service: str, args: dict[str, str]) -> Deferred[Any]:
        """Call one of the relay's own services with values, for a client in this process.

        :returns: its answer as a JSON value; fails with the service's error
        :raises Refused: the arguments are too large, or too many calls wait
        """
        if sum(map(len, args.values())) > OWN_BYTES:
            raise Refused(OWN_TOO_LARGE)
        call = rosbridge.CallService(service=service)
        handler = self._local.service(service)
        assert handler is not None, service
        self._check_room(call)
        running = Deferred.fromCoroutine(handler(self._client, args))
        self._calls[running] = call
        running.addBoth(self._own_ended, running)
        return running

    def _own_ended(self, answer: Any, running: Deferred[Any]) -> Any:
        self._calls.pop(running, None)
        return answer

    def _check_room(self, call: rosbridge.CallService) -> None:
        if len(self._calls) >= CALLS + (STOPPING_CALLS if is_stopping_call(call) else 0):
            raise Refused(f"{CALLS} calls of this connection are waiting already")

    def _call_ended(self, done: bool | None, running: Deferred[bool], size: int, service: str) -> None:
        """:param service: of the robot; empty for one of the relay's own"""
        self._calls.pop(running, None)
        self._bytes -= size
        if service:
            self._client.activity("call.ended", service=service, ok=bool(done))

    async def _call_local(
        self, local: Callable[[ClientContext, Any], Awaitable[Any]], args: Any, unlimited: bool
    ) -> bytes:
        answer = await local(self._client, args)
        quota = self._client.quota
        with quota.timed() if unlimited else quota.counted():
            return jsontext.encode(answer)

    async def _finish(self, operation: rosbridge.CallService, answer: Awaitable[bytes]) -> bool:
        try:
            self._client.port.service_response(operation, True, await answer)
        except SwitchboardError as error:
            self._client.refuse(operation, error)
            return False
        return True

    def _unexpected(self, failure: Any, operation: rosbridge.CallService) -> None:
        if failure.check(CancelledError):
            if not self._ended:
                decision = self._client.permit.decide(Operation.CALL, resolve(operation.service))
                self._client.refuse(operation, Refused(decision.reason))
            return
        self._client.log.failure("a call of {service} failed", failure, service=operation.service)
        words = "the relay failed on this call; see its log"
        self._client.port.service_response(operation, False, jsontext.encode(words))


def is_stopping_call(operation: rosbridge.ClientOp) -> bool:
    """Whether an operation is carried out even if the user's quota is used up: :data:`STOPPING_SERVICES`."""
    return isinstance(operation, rosbridge.CallService) and operation.service.lstrip("/") in _STOPPING_NAMES


_STOPPING_NAMES = {name.lstrip("/") for name in STOPPING_SERVICES}


def own_arguments(service: str, raw: bytes) -> Any:
    """The arguments of a call to one of the relay's own services.

    :raises SwitchboardError: too many bytes, or no JSON; for a stop the arguments are empty instead
    """
    try:
        if len(raw) > OWN_BYTES:
            raise Refused(OWN_TOO_LARGE)
        if nonfinite.is_marked(raw):
            raise NotFinite(f"NaN and infinity are no arguments of {service}; send numbers")
        return jsontext.decode_any(raw) if raw else {}
    except SwitchboardError:
        if service != STOP:
            raise
        return {}


class OfferedServiceHandler:
    """The services and actions that one session offers. Calls are judged where they come in."""

    def __init__(self, client: ClientContext) -> None:
        self._client = client

    def advertise_service(self, operation: rosbridge.AdvertiseService) -> None:
        """Offer a service."""
        client, name = self._client, resolve(operation.service)
        client.require(Operation.PROVIDE, name)
        client.channel.services.advertise(
            client, name, operation.service, normal_type(operation.type, "srv"), operation.type, operation.id
        )

    def unadvertise_service(self, operation: rosbridge.UnadvertiseService) -> None:
        """Withdraw a service."""
        self._client.channel.services.unadvertise(self._client, resolve(operation.service))

    def service_response(self, answer: rosbridge.ServiceResponse) -> None:
        """The client answers a call."""
        self._client.channel.client_calls.answered(self._client, answer)

    def advertise_action(self, operation: rosbridge.AdvertiseAction) -> None:
        """Offer an action."""
        client, name = self._client, resolve(operation.action)
        client.require(Operation.PROVIDE, name)
        client.channel.actions.advertise(
            client,
            name,
            operation.action,
            normal_type(operation.type, "action"),
            operation.type,
            operation.id,
        )

    def unadvertise_action(self, operation: rosbridge.UnadvertiseAction) -> None:
        """Withdraw an action."""
        self._client.channel.actions.unadvertise(self._client, resolve(operation.action))

    def action_feedback(self, message: rosbridge.ActionFeedback) -> None:
        """The client sends feedback of a goal."""
        self._client.channel.goals.client_feedback(self._client, message)

    def action_result(self, message: rosbridge.ActionResult) -> None:
        """The client ends a goal."""
        self._client.channel.goals.client_result(self._client, message)
