"""Service calls on their way to a robot and back."""

from __future__ import annotations

import itertools

import msgspec
from twisted.internet.defer import Deferred

from relay_protocol import jsontext, limits, link
from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_server.channel.definitions import Definitions
from relay_server.channel.wire import Wire
from relay_server.clock import Clock, cancel

PENDING = 1024
"""Calls under way on one robot."""

LONGEST_CALL = 3600.0
"""Most seconds a client may give a service."""

GRACE = 1.0
"""The robot gives up by itself at the timeout; this much later the relay does, seconds."""


LARGEST_REQUEST = limits.COMMAND_FRAME // 4 * 3 - 4096
"""Bytes of CDR that still fit a frame to a robot in base64, beside the names."""


def call_seconds(timeout: float | None) -> float:
    """How long a call may take, by what the client asked for."""
    return min(timeout, LONGEST_CALL) if timeout and timeout > 0 else limits.CALL_SECONDS


class Calls:
    """Calls under way, each answered exactly once: by the robot, by time, or by the loss of the link."""

    def __init__(self, clock: Clock, wire: Wire, definitions: Definitions) -> None:
        self._clock = clock
        self._wire = wire
        self._definitions = definitions
        self._ids = itertools.count(1)
        self._pending: dict[str, Deferred[link.ServiceResponse]] = {}

    async def call(self, service: str, type_name: str, args: bytes, seconds: float, now_ns: int) -> bytes:
        """Call a service of the robot.

        :param type_name: as the client gave it; the graph's type wins
        :param args: JSON, an object or a list of the fields in order; may be empty
        :param seconds: the robot has for its answer
        :returns: the response as JSON
        :raises NotFound: no such service
        :raises Invalid: arguments that do not fit its type
        :raises Unavailable: no answer in time, the service said no, or the robot was lost
        """
        type_name = self._wire.robot.graph.service_type(service) or type_name
        if not type_name:
            raise NotFound(f"service {service} does not exist on robot {self._wire.robot.name}")
        await self._definitions.ready(type_name)
        message = self._message(service, type_name, args, seconds, now_ns)
        response = await self._exchange(message, seconds)
        if not response.result:
            raise Unavailable(response.reason or f"service {service} failed")
        return self._values(type_name, response)

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
        self, service: str, type_name: str, args: bytes, seconds: float, now_ns: int
    ) -> link.CallService:
        value = jsontext.decode_any(args) if args else {}
        call_id = str(next(self._ids))
        if self._wire.cdr:
            cdr = self._wire.robot.types.args_from_json(f"{type_name}_Request", value, now_ns)
            if len(cdr) > LARGEST_REQUEST:
                raise Invalid(f"the request has {len(cdr)} bytes; a robot takes at most {LARGEST_REQUEST}")
            return link.CallService(
                id=call_id, service=service, type=type_name, timeout=seconds, cdr=link.to_base64(cdr)
            )
        body = msgspec.Raw(jsontext.encode(value))
        return link.CallService(id=call_id, service=service, type=type_name, timeout=seconds, args=body)

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
            if response.cdr is not None:
                body = link.from_base64(response.cdr, "the response")
                return self._wire.robot.types.to_json(f"{type_name}_Response", body)
            return jsontext.encode(jsontext.decode_any(bytes(response.values or b"{}")))
        except SwitchboardError as error:
            raise Invalid(f"the robot's answer can't be read: {error}") from None
