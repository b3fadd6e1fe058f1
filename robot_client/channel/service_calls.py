"""Calls of the robot's services for the relay, on one channel."""

from __future__ import annotations

import math

from twisted.internet.defer import CancelledError, Deferred
from twisted.python.failure import Failure

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import CALL_SECONDS
from robot_client.channel.handler import (
    ChannelHandler,
    ChannelWriter,
    RequestRejected,
    check_room,
    decode_cdr,
)
from robot_client.link.clock_offset import ClockOffset
from robot_client.motion.request_gate import MotionRequestGate
from robot_client.platforms.base import Platform


class ChannelServiceCalls(ChannelHandler):
    """Open calls; each is answered with exactly one ``service_response``.

    :param gate: judges calls that move the robot
    :param offset: clock offset of this link
    """

    def __init__(
        self,
        writer: ChannelWriter,
        platform: Platform,
        frame_limit: int,
        gate: MotionRequestGate,
        offset: ClockOffset,
    ) -> None:
        super().__init__(writer, platform, frame_limit)
        self._gate = gate
        self._offset = offset
        self._calls: dict[str, Deferred[None]] = {}

    @property
    def is_busy(self) -> bool:
        """Whether calls are open."""
        return bool(self._calls)

    def call(self, message: link.CallService) -> None:
        """Call a service.

        :raises SwitchboardError: the call can't be made
        """
        id = message.id
        if id in self._calls:
            raise RequestRejected(f"a call with the id '{id}' is already open")
        check_room(self._calls, "calls")
        check = self._gate.check_call(message.service, message.source, message.stamp, self._offset)
        request = decode_cdr(message.cdr, message.service)
        timeout = message.timeout if 0 < message.timeout < math.inf else CALL_SECONDS
        response = self._platform.call(message.service, message.type, request, timeout, check)
        done = response.addCallback(lambda body: self._respond(message, body))
        done.addErrback(lambda failure: self._fail(message, failure))
        self._calls[id] = done
        done.addBoth(lambda _: self._calls.pop(id, None) and None)

    def close(self) -> None:
        """Give up all calls."""
        for call in list(self._calls.values()):
            call.cancel()

    def _respond(self, message: link.CallService, body: bytes) -> None:
        cdr = self._encode_cdr(body, f"the response of {message.service}")
        self._writer.send(link.ServiceResponse(id=message.id, result=True, cdr=cdr))

    def _fail(self, message: link.CallService, failure: Failure) -> None:
        if isinstance(failure.value, CancelledError):
            return
        if isinstance(failure.value, SwitchboardError):
            reason = failure.getErrorMessage()
        else:
            self._log.failure("a call of {service} failed", failure, service=message.service)
            reason = "the call failed on the robot; the robot's log says why"
        self._writer.send(link.ServiceResponse(id=message.id, result=False, reason=reason))
