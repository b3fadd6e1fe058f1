"""Goals that a client sends to actions: each ends in exactly one ``action_result``."""

from __future__ import annotations

from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import Invalid, Refused, SwitchboardError
from relay_protocol.limits import MIB
from relay_protocol.rights import Operation
from relay_server.channels.encodings import requested_encoding
from relay_server.channels.goals import ActionGoal, GoalStatusCode, OwnGoal, start_error
from relay_server.channels.members import RequestContext
from relay_server.channels.names import normal_type, resolve
from relay_server.sessions.context import ClientContext, LocalNode, StartOwnGoal
from relay_server.sessions.motion_requests import MotionRequest

GOALS = 64
"""Most goals of one connection that have not ended."""

GOAL_BYTES = 2 * MIB
"""Most bytes of the arguments of all goals of one connection that have not ended."""


class _Goal:
    """A goal of the client (:class:`relay_server.channels.goals.GoalRequester`).

    :param moves: whether the robot counts it as motion
    """

    def __init__(self, handler: ActionGoalHandler, operation: rosbridge.SendActionGoal, moves: bool) -> None:
        self.operation = operation
        self.moves = moves
        self.size = len(bytes(operation.args or b""))
        self.record: ActionGoal | None = None
        self._handler = handler

    def feedback(self, values: bytes) -> None:
        """Feedback has come."""
        self._handler.send_feedback(self, values)

    def warn(self, reason: str) -> None:
        """Feedback can't be converted."""
        self._handler.warn(self, reason)

    def ended(self, status: int, result: bool, values: bytes) -> None:
        """The goal has ended."""
        self._handler.end_goal(self, status, result, values)


class ActionGoalHandler:
    """The goals of one session."""

    log = Logger()

    def __init__(self, client: ClientContext, local: LocalNode) -> None:
        self._client = client
        self._local = local
        self._goals: list[_Goal] = []

    def send_goal(self, operation: rosbridge.SendActionGoal) -> None:
        """Send a goal to the robot, or to the client that offers the action, or begin one of the relay's own."""
        client, action = self._client, resolve(operation.action)
        own = self._local.action(action)
        if own is None:
            client.require(Operation.CALL, action)
        moves = client.robot.description.motion.moves_by_action(action)
        earliest_sent = client.earliest_sent
        args = bytes(operation.args or b"")
        motion_request = MotionRequest(client, f"a goal for {action}", earliest_sent, args) if moves else None
        type_name = normal_type(operation.action_type, "action")
        self._check_room(operation)
        requested_encoding(operation, client.notify)
        goal = _Goal(self, operation, moves)
        self._goals.append(goal)
        client.motion.goals += moves
        client.activity("goal.begun", action=action, goal=operation.id)
        if own is not None:
            goal.record = self._begin_own(own, goal, action, args)
            return
        goal.record = client.channel.requests.send_goal(
            client,
            goal,
            action,
            type_name,
            args,
            RequestContext(client.number, earliest_sent, motion_request),
            feedback=operation.feedback,
        )

    def _begin_own(self, own: StartOwnGoal, goal: _Goal, action: str, args: bytes) -> OwnGoal:
        record = OwnGoal(goal, action, goal.operation.feedback)
        record.starting = Deferred.fromCoroutine(own(self._client, args, record))
        record.starting.addErrback(self._own_failed, record)
        return record

    def _own_failed(self, failure: Failure, goal: OwnGoal) -> None:
        goal.end(start_error(failure, goal.action))
        if not failure.check(SwitchboardError, CancelledError):
            self.log.failure("a goal of {action} failed", failure, action=goal.action)

    def begun(self, id: rosbridge.Id) -> Deferred[None]:
        """Fires when a goal was sent to the robot or client that executes it, or has ended."""
        waiting: Deferred[None] = Deferred()

        def done(result: object) -> object:
            if not waiting.called:
                waiting.callback(None)
            return result

        for goal in self._goals:
            if goal.operation.id == id and goal.record is not None and goal.record.starting is not None:
                goal.record.starting.addBoth(done)
                return waiting
        done(None)
        return waiting

    def cancel(self, operation: rosbridge.CancelActionGoal) -> None:
        """Cancel a goal; its result still comes."""
        if operation.id is None:
            raise Invalid("'cancel_action_goal' needs the 'id' of the goal")
        for goal in self._goals:
            if goal.operation.id == operation.id and goal.record is not None:
                goal.record.cancel()
                return
        raise Invalid(f"no goal of yours with the id '{str(operation.id)[:80]}' is under way")

    def rights_changed(self) -> None:
        """Cancel goals for which the client has no right any more; they end at once. The relay's own go on."""
        for goal in list(self._goals):
            if isinstance(goal.record, OwnGoal):
                continue
            decision = self._client.permit.decide(Operation.CALL, resolve(goal.operation.action))
            if not decision.allowed and goal.record is not None:
                goal.record.abandon()
                self.end_goal(goal, GoalStatusCode.CANCELED, False, jsontext.encode(decision.reason))

    def warn(self, goal: _Goal, reason: str) -> None:
        """Notify the client that feedback can't be converted."""
        self._client.notify("warning", reason, goal.operation.id)

    def send_feedback(self, goal: _Goal, values: bytes) -> None:
        """Send feedback."""
        self._client.port.action_feedback(goal, goal.operation, values)

    def end_goal(self, goal: _Goal, status: int, result: bool, values: bytes) -> None:
        """Answer a goal. Queued feedback is dropped, as it would come after the result."""
        self._goals.remove(goal)
        self._client.motion.goals -= goal.moves
        self._notice_end(goal, status)
        self._client.port.forget(goal)
        if status == GoalStatusCode.NEVER_BEGAN:
            self._client.notify("error", str(jsontext.decode_any(values)), goal.operation.id)
        self._client.port.action_result(goal.operation, status, result, values)

    def end(self) -> None:
        """The client is gone; the channel cancels its goals, but for the relay's own."""
        for goal in self._goals:
            self._notice_end(goal, GoalStatusCode.CANCELED)
            if isinstance(goal.record, OwnGoal):
                goal.record.abandon()

    def _notice_end(self, goal: _Goal, status: int) -> None:
        self._client.activity(
            "goal.ended", action=resolve(goal.operation.action), goal=goal.operation.id, status=status
        )

    def _check_room(self, operation: rosbridge.SendActionGoal) -> None:
        if operation.id is not None and any(goal.operation.id == operation.id for goal in self._goals):
            raise Refused(f"a goal of yours with the id '{str(operation.id)[:80]}' is under way already")
        if len(self._goals) >= GOALS:
            raise Refused(f"{GOALS} goals of this connection are under way already")
        if sum(goal.size for goal in self._goals) + len(bytes(operation.args or b"")) > GOAL_BYTES:
            raise Refused("the arguments of the goals under way are too large together; wait for results")
