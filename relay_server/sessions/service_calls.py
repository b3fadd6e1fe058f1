"""Services a client calls, of the robot, of other clients and of the relay: each call is answered exactly once."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from twisted.internet.defer import CancelledError, Deferred

from relay_protocol import jsontext, nonfinite, rosbridge
from relay_protocol.errors import Refused, SwitchboardError
from relay_protocol.limits import KIB, MIB
from relay_protocol.link import MotionPolicy
from relay_protocol.nonfinite import NotFinite
from relay_protocol.rights import Operation
from relay_server.channels.encodings import asked
from relay_server.channels.robot_link import RequestContext, resolve
from relay_server.sessions.motion import MotionRequest
from relay_server.sessions.type_names import normal_type

if TYPE_CHECKING:
    from relay_server.sessions.ports import LocalNode
    from relay_server.sessions.session import Session

CALLS = 256
CALL_BYTES = 2 * MIB
"""Arguments of calls that wait, over all of them."""
STOP = "/relay/stop"
RESUME = "/relay/resume"
URGENT = (STOP, "/relay/release_control")
"""Who has used up what he may ask for may still stop a robot, and let go of it."""

URGENT_CALLS = 16
"""So many calls of these may wait beyond :data:`CALLS`."""

SEND_GOAL = "/_action/send_goal"
"""How the name of the service ends that takes an action's goals (design.ros2.org, actions)."""

LOCAL_BYTES = 64 * KIB
"""Arguments of one call to the relay itself: lists in lists take 30 ms to read, in which it does nothing else."""


class ServiceCallHandler:
    """The calls of one session that wait for their answers."""

    def __init__(self, session: Session, local: LocalNode) -> None:
        self._session = session
        self._local = local
        self._calls: dict[Deferred[bool], rosbridge.CallService] = {}
        self._bytes = 0
        self._ended = False

    def end(self) -> None:
        """Nobody is left to hear the answers, and their places are wanted by others."""
        self._ended = True
        for call in list(self._calls):
            call.cancel()

    def rights_changed(self) -> None:
        """Who may not call a service any more does not hear its answer either. The relay's own are open to all."""
        for call, ask in list(self._calls.items()):
            service = resolve(ask.service)
            may = self._session.permit.judge(Operation.CALL, service).allowed
            if not may and self._local.service(service) is None:
                call.cancel()

    def call(self, ask: rosbridge.CallService) -> None:
        """Call a service of the robot, or one of the relay's own."""
        service = resolve(ask.service)
        if len(self._calls) >= CALLS + (URGENT_CALLS if is_urgent(ask) else 0):
            raise Refused(f"{CALLS} calls of this connection are waiting already")
        asked(ask, self._session.tell)
        raw = bytes(ask.args or b"")
        size = len(raw)
        if self._bytes + size > CALL_BYTES and not is_urgent(ask):
            raise Refused(
                "the arguments of the calls that wait already are too large together; wait for answers"
            )
        local = self._local.service(service)
        if local is None:
            self._session.judge(Operation.CALL, service)
            self._session.share.asks_robot()
            answer: Awaitable[bytes] = self._session.channel.asking.call(
                service,
                normal_type(ask.type, "srv"),
                raw,
                ask.timeout,
                self.sent(service, self._session.not_before),
            )
        else:
            answer = self._call_local(local, _arguments(service, raw), is_urgent(ask))
        running = Deferred.fromCoroutine(self._finish(ask, answer))
        self._calls[running] = ask
        self._bytes += size
        if local is None:
            self._session.notice("call.begun", service=service)
        running.addErrback(self._unexpected, ask)
        running.addBoth(self._call_ended, running, size, service if local is None else "")

    def sent(self, service: str, stamp: int) -> RequestContext:
        """What a call of a service is sent with; where calls of it move the robot it takes control.

        :param stamp: the relay's monotonic nanoseconds before which the call can't have been sent
        :raises Refused: it may be too old, somebody else has control, or it must be taken first
        """
        session = self._session
        moves = moves_by(session.robot.description.motion, service)
        movement = MotionRequest(session, f"a call of {service}", stamp) if moves else None
        return RequestContext(session.number, stamp, movement)

    def answer(self, call: rosbridge.CallService, result: bool, values: bytes) -> None:
        """Answer one call in the form it asked for; ``values`` is JSON, a string when ``result`` is false."""
        message = rosbridge.service_response(call.service, call.id, result, values)
        self._session.say(message, asked(call, untold))

    def _call_ended(self, done: bool | None, running: Deferred[bool], size: int, service: str) -> None:
        """:param service: of the robot; empty for one of the relay's own"""
        self._calls.pop(running, None)
        self._bytes -= size
        if service:
            self._session.notice("call.ended", service=service, ok=bool(done))

    async def _call_local(
        self, local: Callable[[Session, Any], Awaitable[Any]], args: Any, urgent: bool
    ) -> bytes:
        answer = await local(self._session, args)
        share = self._session.share
        with share.timed() if urgent else share.counted():
            return jsontext.encode(answer)

    async def _finish(self, ask: rosbridge.CallService, answer: Awaitable[bytes]) -> bool:
        try:
            self.answer(ask, True, await answer)
        except SwitchboardError as error:
            self._session.refuse(ask, error)
            return False
        return True

    def _unexpected(self, failure: Any, ask: rosbridge.CallService) -> None:
        if failure.check(CancelledError):
            if not self._ended:
                verdict = self._session.permit.judge(Operation.CALL, resolve(ask.service))
                self._session.refuse(ask, Refused(verdict.reason))
            return
        self._session.log.failure("a call of {service} failed", failure, service=ask.service)
        self.answer(ask, False, jsontext.encode("the relay failed on this call; its log tells more"))


def moves_by(motion: MotionPolicy, service: str) -> bool:
    """Whether calls of a service move a robot, be it by giving an action a goal."""
    action, goal, _ = service.partition(SEND_GOAL)
    return motion.moves_by_service(service) or bool(goal and motion.moves_by_action(action))


def is_urgent(ask: rosbridge.ClientOp) -> bool:
    """Whether this is done whatever else its client asks for."""
    return isinstance(ask, rosbridge.CallService) and ask.service.lstrip("/") in _URGENT


_URGENT = {name.lstrip("/") for name in URGENT}


def untold(level: str, text: str, id: rosbridge.Id) -> None:
    """What is wrong with a form was told when it was asked for."""


def _arguments(service: str, raw: bytes) -> Any:
    """What a service of the relay's own is called with.

    :raises SwitchboardError: too much, or no JSON; a stop is none the less one
    """
    try:
        if len(raw) > LOCAL_BYTES:
            raise Refused(f"arguments for the relay's own services may have {LOCAL_BYTES} bytes")
        if nonfinite.is_marked(raw):
            raise NotFinite(f"NaN and infinity are no arguments of {service}; send numbers")
        return jsontext.decode_any(raw) if raw else {}
    except SwitchboardError:
        if service != STOP:
            raise
        return {}
