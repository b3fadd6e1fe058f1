"""Goals that the relay sends to the robot's actions, on one channel."""

from __future__ import annotations

from twisted.python.failure import Failure

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from robot_client.channel.handler import ChannelHandler, ChannelWriter, check_room, decode_cdr
from robot_client.link.clock_offset import ClockOffset
from robot_client.motion.active_goals import ActiveGoals
from robot_client.motion.request_gate import MotionRequestGate
from robot_client.platforms.base import ABORTED, NOT_STARTED, GoalHandle, GoalOutcome, Platform
from robot_client.twisted_types import ReactorClock

CANCEL_INTERVAL = 1.0
"""Seconds between two cancel requests of the relay for one goal that are passed on. A change of control, a
stop or a lost link cancel without this limit."""


class ChannelGoals(ChannelHandler):
    """Open goals; each ends in exactly one ``action_result``.

    While the link is full, only the newest feedback of each goal is kept. Only for feedback does a node of the robot
    choose the rate of JSON messages.

    :param gate: judges goals that move the robot
    :param offset: clock offset of this link
    :param active_goals: ends goals that move the robot when the daemon ends
    """

    def __init__(
        self,
        writer: ChannelWriter,
        platform: Platform,
        frame_limit: int,
        gate: MotionRequestGate,
        offset: ClockOffset,
        clock: ReactorClock,
        active_goals: ActiveGoals | None = None,
    ) -> None:
        super().__init__(writer, platform, frame_limit)
        self._active_goals = active_goals
        self._gate = gate
        self._offset = offset
        self._clock = clock
        self._goals: dict[str, GoalHandle] = {}
        self._moving: set[str] = set()
        """Ids of goals that move the robot."""
        self._next_cancel: dict[str, float] = {}
        """When the relay may cancel a goal again, by id, seconds."""
        self._paused = False
        self._held_feedback: dict[str, link.ActionFeedback] = {}
        self._closed = False

    @property
    def is_busy(self) -> bool:
        """Whether goals are open."""
        return bool(self._goals)

    def send_goal(self, message: link.SendActionGoal) -> None:
        """Send a goal to its action.

        :raises SwitchboardError: it can't be sent
        """
        id = message.id
        if id in self._goals:
            # An action_result with this id would end the goal that is open.
            reason = f"a goal with the id '{id}' is already open"
            self._writer.send(link.Failed(request="send_action_goal", reference=id, reason=reason))
            return
        check_room(self._goals, "goals")
        moves = self._gate.check_goal(message.action, message.source, message.stamp, self._offset)
        active_goals = self._active_goals if moves else None
        full_name = ""
        if active_goals is not None:
            full_name = self._platform.full_name(message.action, "action")
            active_goals.check(full_name)
        goal = self._platform.send_goal(
            message.action,
            message.type,
            decode_cdr(message.cdr, message.action),
            (lambda body: self._send_feedback(id, message.action, body)) if message.feedback else None,
        )
        self._goals[id] = goal
        if moves:
            self._moving.add(id)
        if active_goals is not None:
            active_goals.add(full_name, goal)
        goal.result.addCallbacks(
            lambda outcome: self._ended(message, outcome), lambda failure: self._failed(message, failure)
        )

    def cancel(self, message: link.CancelActionGoal) -> None:
        """Request cancellation; ignored for goals that have ended, and within :data:`CANCEL_INTERVAL`."""
        goal = self._goals.get(message.id)
        now = self._clock.seconds()
        if goal is not None and now >= self._next_cancel.get(message.id, now):
            self._next_cancel[message.id] = now + CANCEL_INTERVAL
            goal.cancel()

    def cancel_all(self, only_moving: bool) -> None:
        """Cancel all goals; their results still arrive.

        :param only_moving: whether goals that don't move the robot continue
        """
        for id, goal in list(self._goals.items()):
            if not only_moving or id in self._moving:
                self._cancel_safely(goal)

    def pause(self) -> None:
        """Hold feedback, as the link is full."""
        self._paused = True

    def resume(self) -> None:
        """Send held feedback, as the link has room."""
        self._paused = False
        held, self._held_feedback = self._held_feedback, {}
        for message in held.values():
            self._writer.send(message)

    def close(self) -> None:
        """Cancel all goals; nothing is sent any more."""
        self._closed = True
        self._held_feedback.clear()
        for goal in list(self._goals.values()):
            self._cancel_safely(goal)
        self._goals.clear()
        self._moving.clear()
        self._next_cancel.clear()

    def _cancel_safely(self, goal: GoalHandle) -> None:
        try:
            goal.cancel()
        except Exception:  # must not prevent the cancellation of the others
            self._log.failure("a goal could not be cancelled")
        if self._active_goals is not None:
            self._active_goals.note_cancelled(goal)

    def _send_feedback(self, id: str, action: str, body: bytes) -> None:
        if id not in self._goals:
            return
        try:
            message = link.ActionFeedback(id=id, cdr=self._encode_cdr(body, f"feedback of {action}"))
        except SwitchboardError as error:
            self._log.warn("feedback is dropped: {reason}", reason=str(error), limited="feedback")
            return
        if self._paused:
            self._held_feedback[id] = message
        else:
            self._writer.send(message)

    def _ended(self, message: link.SendActionGoal, outcome: GoalOutcome) -> None:
        if outcome.body is None:
            self._send_result(message.id, outcome.status, None, outcome.reason)
            return
        try:
            cdr = self._encode_cdr(outcome.body, f"the result of {message.action}")
        except SwitchboardError as error:
            self._send_result(message.id, outcome.status, None, str(error))
            return
        self._send_result(message.id, outcome.status, cdr, "")

    def _failed(self, message: link.SendActionGoal, failure: Failure) -> None:
        self._log.failure("a goal of {action} failed", failure, action=message.action)
        reason = "the robot could not follow this goal to its end; the robot's log says why"
        self._send_result(message.id, ABORTED, None, reason)

    def _send_result(self, id: str, status: int, cdr: str | None, reason: str) -> None:
        self._goals.pop(id, None)
        self._moving.discard(id)
        self._next_cancel.pop(id, None)
        feedback = self._held_feedback.pop(id, None)
        if self._closed:
            return
        if feedback is not None:
            self._writer.send(feedback)
        self._writer.send(
            link.ActionResult(id=id, status=status, result=cdr is not None, cdr=cdr, reason=reason)
        )


def refusal(message: link.SendActionGoal, reason: str) -> link.ActionResult:
    """The result of a goal that could not be sent."""
    return link.ActionResult(id=message.id, status=NOT_STARTED, result=False, reason=reason)
