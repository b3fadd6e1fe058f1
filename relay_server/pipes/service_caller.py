"""Calls the service, action or program at an end of a pipe: one call at a time, and only the newest waits for it."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any, NamedTuple

import msgspec
from twisted.internet.defer import Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.channels.goals import GoalStatusCode
from relay_server.in_process_sessions.in_process_port import GoalListener, InProcessPort, ServiceReply

CALL_SECONDS = 10.0
"""Time limit of the answer of a service or program. A goal has none."""


class PipeCall(NamedTuple):
    """A call for one message.

    :param args: JSON
    :param arrived: when the message came, monotonic nanoseconds
    :param earliest_sent: see :class:`relay_server.sessions.message_age.MessageAge`
    """

    args: bytes
    arrived: int
    earliest_sent: int


class ServiceCaller:
    """
    :param port: of which it looks whether it is open, and whether a call was too old a command
    :param name: of what is called, for errors
    :param request: makes one call
    :param answered: called with each call and the JSON of its reply
    :param failed: called with the reason why a call was not made, or failed, and whether it was too old a command
    :param dropped: called for each call that a newer one has replaced
    """

    log = Logger()

    def __init__(
        self,
        port: InProcessPort,
        name: str,
        request: Callable[[PipeCall], Coroutine[Any, Any, ServiceReply]],
        *,
        answered: Callable[[PipeCall, bytes], None],
        failed: Callable[[SwitchboardError, bool], None],
        dropped: Callable[[], None],
    ) -> None:
        self._port = port
        self._name = name
        self._request = request
        self._answered = answered
        self._failed = failed
        self._dropped = dropped
        self._waiting: PipeCall | None = None
        self._stale = 0
        """Commands of the session that were too old, when the call began."""
        self.busy = False

    def call(self, call: PipeCall) -> None:
        """Make a call now, or after the call that is in progress. A call that waited for it is dropped."""
        if not self.busy:
            self._begin(call)
            return
        if self._waiting is not None:
            self._dropped()
        self._waiting = call

    def _begin(self, call: PipeCall) -> None:
        self.busy = True
        self._stale = self._port.client.motion.stale_commands
        work = Deferred.fromCoroutine(self._request(call))
        work.addCallbacks(self._replied, self._refused, callbackArgs=(call,))
        work.addErrback(lambda failure: self.log.failure("a call of a pipe failed", failure))
        work.addBoth(self._ended)

    def _replied(self, reply: ServiceReply, call: PipeCall) -> None:
        if reply.result:
            self._answered(call, reply.values)
        else:
            self._failed(Unavailable(f"{self._name}: {reply.read}"), self._is_stale)

    def _refused(self, failure: Failure) -> None:
        failure.trap(SwitchboardError)
        error = failure.value
        assert isinstance(error, SwitchboardError)
        self._failed(error, self._is_stale)

    @property
    def _is_stale(self) -> bool:
        return self._port.client.motion.stale_commands > self._stale

    def _ended(self, _: object) -> None:
        self.busy = False
        waiting, self._waiting = self._waiting, None
        if waiting is not None and self._port.closed is None and not self._port.session.closed:
            self._begin(waiting)


def service_request(
    port: InProcessPort, service: str
) -> Callable[[PipeCall], Coroutine[Any, Any, ServiceReply]]:
    """Calls a service of a robot.

    :param service: resolved
    """

    def request(call: PipeCall) -> Coroutine[Any, Any, ServiceReply]:
        return port.call(service, call.args, timeout=CALL_SECONDS, earliest_sent=call.earliest_sent)

    return request


def goal_request(port: InProcessPort, action: str) -> Callable[[PipeCall], Coroutine[Any, Any, ServiceReply]]:
    """Has an action of a robot execute a goal, until its result. It is cancelled with the session.

    :param action: resolved
    """

    async def request(call: PipeCall) -> ServiceReply:
        listener = _ResultListener()
        goal = rosbridge.SendActionGoal(id=port.new_id(), action=action, args=msgspec.Raw(call.args))
        port.send_goal(goal, listener, call.earliest_sent)
        return await listener.result

    return request


class _ResultListener(GoalListener):
    """Waits for the result of a goal."""

    def __init__(self) -> None:
        self.result: Deferred[ServiceReply] = Deferred()

    def ended(self, status: int, result: bool, values: bytes) -> None:
        """The goal has ended."""
        if result and status != GoalStatusCode.SUCCEEDED:
            words = {
                GoalStatusCode.CANCELED: "the goal was cancelled",
                GoalStatusCode.ABORTED: "the goal was aborted",
            }
            result, values = False, jsontext.encode(words.get(GoalStatusCode(status), "the goal has failed"))
        self.result.callback(ServiceReply(result, values))
