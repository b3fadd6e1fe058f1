"""Stops that a client sends by a websocket whose robot is at another relay.

The robot's home carries them out. If it does not confirm within a second that it has read one, this relay stores the
stop in the database, where the home finds it, and answers the client.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any, NamedTuple

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import MalformedMessage, SwitchboardError
from relay_protocol.limits import KIB
from relay_server.cluster.websockets import ForwardedWebSocket
from relay_server.common import websocket_frames
from relay_server.control.service import StopResult
from relay_server.foxglove import messages
from relay_server.foxglove.services import STOP_NUMBER
from relay_server.relay_node import interfaces
from relay_server.relay_node.arguments import stop_arguments
from relay_server.sessions.service_calls import STOP, STOPPING_CALLS, own_arguments

CONFIRM_SECONDS = 1.0
"""Seconds in which the home must have read a stop."""
MOST_BYTES = 16 * KIB
"""Most bytes of a message that is looked at."""
_REQUEST = f"{interfaces.SERVICES[STOP].type}_Request"

StopHere = Callable[[str, str], Coroutine[Any, Any, StopResult]]
"""Stops the robot by way of this relay, with a reason and an id."""


class _Stop(NamedTuple):
    """A client's call of ``/relay/stop``.

    :param args: decodes its arguments
    :param answer: makes the frame of the answer from its values
    """

    args: Callable[[], Any]
    answer: Callable[[Any], bytes]


class ForwardedStops:
    """The stops of one client.

    :param foxglove: whether it speaks the Foxglove protocol
    """

    log = Logger()

    def __init__(self, forwarded: ForwardedWebSocket, robot: str, foxglove: bool, stop: StopHere) -> None:
        self._forwarded = forwarded
        self._robot = robot
        self._foxglove = foxglove
        self._stop = stop
        self._waiting = 0

    def message(self, payload: bytes, binary: bool) -> None:
        """Take note of a message that was passed on to the home."""
        if len(payload) > MOST_BYTES or self._waiting >= STOPPING_CALLS:
            return
        found = None
        if self._foxglove:
            if binary and payload.startswith(messages.call_head(STOP_NUMBER)):
                found = _foxglove_stop(payload)
        elif b"stop" in payload:
            found = _rosbridge_stop(payload)
        if found is not None:
            self._waiting += 1
            Deferred.fromCoroutine(self._ensure(found)).addErrback(
                lambda failure: self.log.failure("a stop of {robot} failed", failure, robot=self._robot)
            )

    async def _ensure(self, stop: _Stop) -> None:
        try:
            if await self._forwarded.confirm(CONFIRM_SECONDS):
                return
            result = await self._stop(*stop_arguments(stop.args()))
        except SwitchboardError as error:
            self.log.warn(
                "a stop of {robot}, whose relay is silent, failed: {reason}",
                robot=self._robot,
                reason=str(error),
            )
            values: Any = {"success": False, "message": str(error), "done": False, "stopped": None}
        else:
            values = result.values(self._robot)
        finally:
            self._waiting -= 1
        self._forwarded.answer(stop.answer(values))


def _rosbridge_stop(payload: bytes) -> _Stop | None:
    try:
        call = rosbridge.decode(payload)
    except SwitchboardError:
        # The home says what is wrong with it.
        return None
    if not isinstance(call, rosbridge.CallService) or call.service.lstrip("/") != STOP.lstrip("/"):
        return None
    service, id = call.service, call.id

    def answer(values: Any) -> bytes:
        return websocket_frames.text(rosbridge.service_response(service, id, True, jsontext.encode(values)))

    return _Stop(lambda: own_arguments(STOP, bytes(call.args or b"")), answer)


def _foxglove_stop(payload: bytes) -> _Stop | None:
    try:
        call = messages.decode_binary(payload)
    except MalformedMessage:
        return None
    if not isinstance(call, messages.ServiceCallMessage):
        return None
    number, encoding, payload = call.call, call.encoding, call.payload

    def args() -> Any:
        if encoding == "json":
            return own_arguments(STOP, payload)
        if encoding == "cdr":
            with suppress(SwitchboardError):
                return jsontext.decode_any(interfaces.TYPES.to_json(_REQUEST, payload))
        return {}

    def answer(values: Any) -> bytes:
        reason = values["message"]
        return messages.text("serviceCallFailure", serviceId=STOP_NUMBER, callId=number, message=reason)

    return _Stop(args, answer)
