"""Calls of the robot's services that the relay asks for on one channel."""

from __future__ import annotations

import math

from twisted.internet.defer import CancelledError, Deferred
from twisted.python.failure import Failure

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import CALL_SECONDS
from robot_client.channel.parts import ChannelPart, ChannelWriter, NotNow, arguments, check_room
from robot_client.link.clock_offset import ClockOffset
from robot_client.motion.gate import MotionGate
from robot_client.platforms.base import Platform


class ChannelServiceCalls(ChannelPart):
    """The calls under way.

    :param gate: judges calls that move the robot
    :param offset: clock offset of the link they come on
    """

    def __init__(
        self, wire: ChannelWriter, platform: Platform, frame_limit: int, gate: MotionGate, offset: ClockOffset
    ) -> None:
        super().__init__(wire, platform, frame_limit)
        self._gate = gate
        self._offset = offset
        self._calls: dict[str, Deferred[None]] = {}

    def call(self, message: link.CallService) -> None:
        """Begin one; it is always answered.

        :raises SwitchboardError: it can't be begun
        """
        id = message.id
        if id in self._calls:
            raise NotNow(f"a call with the id '{id}' is under way")
        check_room(self._calls, "calls")
        check = self._gate.call(message.service, message.source, message.stamp, self._offset)
        request = arguments(message.cdr, message.service)
        timeout = message.timeout if 0 < message.timeout < math.inf else CALL_SECONDS
        answer = self._platform.call(message.service, message.type, request, timeout, check)
        done = answer.addCallback(lambda body: self._answer(message, body))
        done.addErrback(lambda failure: self._failed(message, failure))
        self._calls[id] = done
        done.addBoth(lambda _: self._calls.pop(id, None) and None)

    def close(self) -> None:
        """Give up all."""
        for call in list(self._calls.values()):
            call.cancel()

    def _answer(self, message: link.CallService, body: bytes) -> None:
        cdr = self._to_cdr(body, f"the answer of {message.service}")
        self._wire.say(link.ServiceResponse(id=message.id, result=True, cdr=cdr))

    def _failed(self, message: link.CallService, failure: Failure) -> None:
        if isinstance(failure.value, CancelledError):
            return
        if isinstance(failure.value, SwitchboardError):
            reason = failure.getErrorMessage()
        else:
            self._log.failure("a call of {service} failed", failure, service=message.service)
            reason = "the robot could not make this call; its log says why"
        self._wire.say(link.ServiceResponse(id=message.id, result=False, reason=reason))
