"""Services: what a client may call is advertised with its definition; calls are those of every client."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import msgspec

from relay_protocol import json_cost, jsontext, nonfinite, rosbridge
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError
from relay_protocol.rights import Operation
from relay_protocol.ros_types import TypeRegistry
from relay_server.foxglove import messages
from relay_server.foxglove.advertisements import Advertisement, Advertisements
from relay_server.foxglove.context import FoxgloveContext
from relay_server.foxglove.publications import ENCODINGS
from relay_server.relay_node import interfaces
from relay_server.relay_node.visible_graph import visible_graph
from relay_server.sessions.service_calls import OWN_BYTES, OWN_TOO_LARGE, STOP, is_stopping_call

STOP_NUMBER = 1
"""Number of the service that stops the robot, on every connection. No other service or channel has it."""

CALLS = 32
"""Most calls of one client that wait for their answers, beside those that stop the robot."""

_LEFT_OUT = f"{interfaces.ROSAPI}/"
"""The relay's services of this prefix are not advertised, as this protocol has operations of its own for them."""


class _PendingCall(NamedTuple):
    """:param call: the client's number of the call"""

    service: Advertisement
    call: int
    encoding: str


class FoxgloveServices(Advertisements):
    """The services that one client may call, and its calls."""

    own_names = interfaces.OWN_SERVICES
    parts = ("_Request", "_Response")

    def __init__(self, context: FoxgloveContext) -> None:
        super().__init__(
            context,
            "service-types",
            encode=lambda entries: messages.text("advertiseServices", services=entries),
            encode_withdrawal=lambda numbers: messages.text("unadvertiseServices", serviceIds=numbers),
        )
        self._calls: dict[str, _PendingCall] = {}
        self._call_ids = itertools.count(1)

    # --- services -----------------------------------------------------------------------------------------

    def _wanted(self) -> dict[str, list[str]]:
        client = self._context.client
        graph, decide = client.robot.graph, client.permit.rules.decide
        found: dict[str, list[str]] = {}
        if not graph.known:
            # The robot is offline, or has just registered: its services stay until its graph is known.
            found = {
                each.name: [each.type]
                for each in self._by_name.values()
                if decide(Operation.CALL, each.name).allowed
            }
        for name, service in visible_graph(client).services.items():
            if service.types and not name.startswith(_LEFT_OUT):
                found[name] = service.types
        return found

    def _number_of(self, name: str) -> int:
        return STOP_NUMBER if name == STOP else super()._number_of(name)

    def _encoding_of(self, name: str) -> str:
        return "cdr" if name in interfaces.OWN_SERVICES else super()._encoding_of(name)

    def _types_of(self, name: str) -> TypeRegistry:
        return interfaces.TYPES if name in interfaces.OWN_SERVICES else super()._types_of(name)

    def _withdrawn(self, advertised: Advertisement) -> None:
        pass

    def _entry(self, advertised: Advertisement, *texts: str) -> dict[str, Any]:
        request, response = texts
        return {
            "id": advertised.number,
            "name": advertised.name,
            "type": advertised.type,
            "request": _half(advertised, "Request", request),
            "response": _half(advertised, "Response", response),
        }

    # --- calls --------------------------------------------------------------------------------------------

    def call(self, message: messages.ServiceCallMessage) -> None:
        """Call a service; the answer is a response or a failure, exactly one."""
        service = self._by_number.get(message.service)
        try:
            if service is None:
                raise NotFound(f"there is no service {message.service}")
            if not is_stopping_call(rosbridge.CallService(service=service.name)):
                self._check_room()
            args = self._arguments(message, service)
        except SwitchboardError as error:
            self._fail(message.service, message.call, str(error), service.name if service else "")
            self._context.client.count_refusal()
            return
        id = f"call-{next(self._call_ids)}"
        # A stop may have an encoding that is not taken; its answer has the one that is advertised.
        encoding = message.encoding if message.encoding in ENCODINGS else service.encoding
        self._calls[id] = _PendingCall(service, message.call, encoding)
        self._context.perform(
            rosbridge.CallService(id=id, service=service.name, type=service.type, args=msgspec.Raw(args))
        )

    def _check_room(self) -> None:
        """:raises Refused: too many calls wait, or the user's CPU quota is used up"""
        self._context.client.quota.check()
        if len(self._calls) >= CALLS:
            raise Refused(f"{CALLS} calls of this connection are waiting already; wait for answers")

    def _arguments(self, message: messages.ServiceCallMessage, service: Advertisement) -> bytes:
        """The arguments of a call as JSON.

        :raises SwitchboardError: the payload is no request of the service; for a stop the arguments are empty instead
        """
        try:
            return self._read_arguments(message, service)
        except SwitchboardError:
            if service.name != STOP:
                raise
            return b"{}"

    def _read_arguments(self, message: messages.ServiceCallMessage, service: Advertisement) -> bytes:
        taken = ENCODINGS if service.encoding == "cdr" else ("json",)
        if message.encoding not in taken:
            raise Invalid(f"the encoding '{message.encoding[:20]}' is none of {', '.join(taken)}")
        body = message.payload
        if service.name in interfaces.OWN_SERVICES and len(body) > OWN_BYTES:
            raise Refused(OWN_TOO_LARGE)
        if message.encoding == "json":
            json_cost.check(body)
            return bytes(jsontext.decode(_raw, nonfinite.mark_body(body)))
        with self._context.client.quota.timed():
            return self._types_of(service.name).to_json(f"{service.type}_Request", body)

    def is_pending(self, id: str) -> bool:
        """Whether this is the id of a call that waits for its answer."""
        return id in self._calls

    def status_id(self, id: str) -> str:
        """The id of a status about an operation: one for all calls of a service, so that the newest replaces others."""
        pending = self._calls.get(id)
        return id if pending is None else f"call:{pending.service.name}"

    def answer(self, id: str, result: bool, values: bytes) -> None:
        """Answer a call.

        :param values: JSON; a string with the reason when ``result`` is false
        """
        pending = self._calls.pop(id, None)
        if pending is None:
            return
        service = pending.service
        reason = ""
        if result:
            try:
                with self._context.client.quota.timed():
                    body = self._encode(pending, values)
                frame = messages.service_response(service.number, pending.call, pending.encoding, body)
                self._context.send(frame)
                self._context.statuses.remove(f"call:{service.name}")
                return
            except SwitchboardError as error:
                reason = f"the answer can't be encoded: {error}"
        else:
            reason = str(jsontext.decode_any(values))
        self._fail(service.number, pending.call, reason, service.name)

    def _encode(self, pending: _PendingCall, values: bytes) -> bytes:
        if pending.encoding == "json":
            return values
        if pending.service.name in interfaces.OWN_SERVICES:
            values = jsontext.encode(_without_null(jsontext.decode_any(values)))
        part = f"{pending.service.type}_Response"
        now_ns = self._context.client.channel.now_ns()
        return self._types_of(pending.service.name).from_json(part, values, now_ns)

    def _fail(self, number: int, call: int, reason: str, name: str) -> None:
        """Answer a call with a failure; also by a status, as some clients do not show failures."""
        self._context.send(messages.text("serviceCallFailure", serviceId=number, callId=call, message=reason))
        self._context.show("error", f"call {name}: {reason}" if name else reason, f"call:{name}")


_raw = msgspec.json.Decoder(msgspec.Raw)
"""Checks that a text is JSON, without objects for what is in it."""


def _without_null(value: Any) -> Any:
    """JSON without the fields that are null, which no message of ROS can have: they get their defaults."""
    if isinstance(value, dict):
        return {name: _without_null(each) for name, each in value.items() if each is not None}
    return [_without_null(each) for each in value] if isinstance(value, list) else value


def _half(service: Advertisement, part: str, schema: str) -> dict[str, str]:
    return {
        "encoding": service.encoding,
        "schemaName": f"{service.type}_{part}",
        "schemaEncoding": service.schema_encoding,
        "schema": schema,
    }
