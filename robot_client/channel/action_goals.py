"""Goals that the relay asks the robot's actions to pursue, on one channel."""

from __future__ import annotations

from twisted.python.failure import Failure

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from robot_client.channel.parts import ChannelPart, ChannelWriter, arguments, check_room
from robot_client.link.clock_offset import ClockOffset
from robot_client.motion.active_goals import ActiveGoals
from robot_client.motion.gate import MotionGate
from robot_client.platforms.base import ABORTED, NEVER_BEGAN, GoalHandle, GoalOutcome, Platform
from robot_client.twisted_types import ReactorClock

ASK_EVERY = 1.0
"""Seconds in which the relay can have one goal cancelled once. A change of control, a stop or a lost link wait for
nothing.
"""


class ChannelGoals(ChannelPart):
    """The goals under way; each ends in exactly one ``action_result``.

    While the link takes nothing, only the newest feedback of each goal is kept: it is the one kind of JSON message
    that comes as often as somebody else likes.

    :param gate: judges goals that move the robot
    :param offset: clock offset of the link they come on
    :param clock: for the time alone
    :param pursuits: sees that those that move the robot end with the daemon
    """

    def __init__(
        self,
        wire: ChannelWriter,
        platform: Platform,
        frame_limit: int,
        gate: MotionGate,
        offset: ClockOffset,
        clock: ReactorClock,
        pursuits: ActiveGoals | None = None,
    ) -> None:
        super().__init__(wire, platform, frame_limit)
        self._pursuits = pursuits
        self._gate = gate
        self._offset = offset
        self._clock = clock
        self._goals: dict[str, GoalHandle] = {}
        self._moving: set[str] = set()
        """Those whose actions move the robot."""
        self._again: dict[str, float] = {}
        """When the relay may have one cancelled once more, seconds."""
        self._paused = False
        self._held: dict[str, link.ActionFeedback] = {}
        self._closed = False

    def begin(self, message: link.SendActionGoal) -> None:
        """Pursue one.

        :raises SwitchboardError: it can't be begun
        """
        id = message.id
        if id in self._goals:
            # An action_result of this id would end the goal that is under way.
            reason = f"a goal with the id '{id}' is under way"
            self._wire.say(link.Failed(what="send_action_goal", ref=id, reason=reason))
            return
        check_room(self._goals, "goals")
        moves = self._gate.goal(message.action, message.source, message.stamp, self._offset)
        pursuits = self._pursuits if moves else None
        full = self._platform.full_name(message.action, "action") if pursuits is not None else ""
        if pursuits is not None:
            pursuits.check(full)
        goal = self._platform.pursue(
            message.action,
            message.type,
            arguments(message.cdr, message.action),
            (lambda body: self._feedback(id, message.action, body)) if message.feedback else None,
        )
        self._goals[id] = goal
        if moves:
            self._moving.add(id)
        if pursuits is not None:
            pursuits.add(full, goal)
        goal.result.addCallbacks(
            lambda outcome: self._ended(message, outcome), lambda failure: self._failed(message, failure)
        )

    def cancel(self, message: link.CancelActionGoal) -> None:
        """The relay wants it no more; one that has ended already is passed over, and what follows within a second."""
        goal = self._goals.get(message.id)
        now = self._clock.seconds()
        if goal is not None and now >= self._again.get(message.id, now):
            self._again[message.id] = now + ASK_EVERY
            goal.cancel()

    def cancel_all(self, only_moving: bool) -> None:
        """The robot is to stop; the results still come.

        :param only_moving: goals of actions that don't move it go on
        """
        for id, goal in list(self._goals.items()):
            if not only_moving or id in self._moving:
                self._end(goal)

    def pause(self) -> None:
        """The link takes nothing."""
        self._paused = True

    def resume(self) -> None:
        """The link takes messages again."""
        self._paused = False
        held, self._held = self._held, {}
        for message in held.values():
            self._wire.say(message)

    def close(self) -> None:
        """Nobody wants any of them now."""
        self._closed = True
        self._held.clear()
        for goal in list(self._goals.values()):
            self._end(goal)
        self._goals.clear()
        self._moving.clear()
        self._again.clear()

    def _end(self, goal: GoalHandle) -> None:
        try:
            goal.cancel()
        except Exception:  # one that fails must not keep the next from its end
            self._log.failure("a goal could not be cancelled")
        if self._pursuits is not None:
            self._pursuits.end(goal)

    def _feedback(self, id: str, action: str, body: bytes) -> None:
        if id not in self._goals:
            return
        try:
            message = link.ActionFeedback(id=id, cdr=self._to_cdr(body, f"feedback of {action}"))
        except SwitchboardError as error:
            self._log.warn("feedback is left out: {reason}", reason=str(error))
            return
        if self._paused:
            self._held[id] = message
        else:
            self._wire.say(message)

    def _ended(self, message: link.SendActionGoal, outcome: GoalOutcome) -> None:
        if outcome.body is None:
            self._say_end(message.id, outcome.status, None, outcome.reason)
            return
        try:
            cdr = self._to_cdr(outcome.body, f"the result of {message.action}")
        except SwitchboardError as error:
            self._say_end(message.id, outcome.status, None, str(error))
            return
        self._say_end(message.id, outcome.status, cdr, "")

    def _failed(self, message: link.SendActionGoal, failure: Failure) -> None:
        self._log.failure("a goal of {action} failed", failure, action=message.action)
        self._say_end(message.id, ABORTED, None, "the robot lost this goal; its log says why")

    def _say_end(self, id: str, status: int, cdr: str | None, reason: str) -> None:
        self._goals.pop(id, None)
        self._moving.discard(id)
        self._again.pop(id, None)
        feedback = self._held.pop(id, None)
        if self._closed:
            return
        if feedback is not None:
            self._wire.say(feedback)
        self._wire.say(
            link.ActionResult(id=id, status=status, result=cdr is not None, cdr=cdr, reason=reason)
        )


def refusal(message: link.SendActionGoal, reason: str) -> link.ActionResult:
    """The answer to a goal that could not be begun."""
    return link.ActionResult(id=message.id, status=NEVER_BEGAN, result=False, reason=reason)
