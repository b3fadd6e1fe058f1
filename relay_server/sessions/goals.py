"""Goals a client sends to actions on the robot: each ends in exactly one ``action_result``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from twisted.internet.defer import Deferred

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import Invalid, Refused
from relay_protocol.limits import MIB
from relay_protocol.rights import Operation
from relay_server.channels.encodings import MessageEncoding, asked
from relay_server.channels.goals import ClientGoal, GoalStatusCode
from relay_server.channels.robot_link import RequestContext, resolve
from relay_server.sessions.motion import MotionRequest
from relay_server.sessions.service_calls import untold
from relay_server.sessions.type_names import normal_type

if TYPE_CHECKING:
    from relay_server.sessions.session import Session

GOALS = 64
"""Goals of one connection that may be under way."""

GOAL_BYTES = 2 * MIB
"""Arguments of goals under way, over all of them."""


class _Goal:
    """One goal of the client, as the channel tells of it.

    :param moves: whether the robot counts it as motion
    """

    def __init__(
        self, desk: ActionGoalHandler, ask: rosbridge.SendActionGoal, form: MessageEncoding, moves: bool
    ) -> None:
        self.ask = ask
        self.moves = moves
        self.form = form
        self.size = len(bytes(ask.args or b""))
        self.pursued: ClientGoal | None = None
        self._desk = desk

    def feedback(self, values: bytes) -> None:
        """How far it has come."""
        self._desk.tell_feedback(self, values)

    def unreadable(self, words: str) -> None:
        """Something of it can't be told."""
        self._desk.tell_trouble(self, words)

    def ended(self, status: int, result: bool, values: bytes) -> None:
        """It is over."""
        self._desk.goal_ended(self, status, result, values)


class ActionGoalHandler:
    """The goals of one session."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._goals: list[_Goal] = []

    @property
    def moving(self) -> bool:
        """Whether a goal that moves the robot is under way."""
        return any(goal.moves for goal in self._goals)

    def send_goal(self, ask: rosbridge.SendActionGoal) -> None:
        """Have a goal pursued."""
        session, action = self._session, resolve(ask.action)
        session.judge(Operation.CALL, action)
        moves = session.robot.description.motion.moves_by_action(action)
        stamp = session.not_before
        movement = MotionRequest(session, f"a goal for {action}", stamp) if moves else None
        type_name = normal_type(ask.action_type, "action")
        self._check_room(ask)
        goal = _Goal(self, ask, asked(ask, session.tell), moves)
        self._goals.append(goal)
        session.notice("goal.begun", action=action, goal=ask.id)
        pursued = session.channel.asking.pursue(
            session,
            goal,
            action,
            type_name,
            bytes(ask.args or b""),
            RequestContext(session.number, stamp, movement),
            feedback=ask.feedback,
        )
        goal.pursued = pursued

    def beginning(self, id: rosbridge.Id) -> Deferred[None]:
        """Fires when a goal has been handed on to who is to pursue it, or is over."""
        waiting: Deferred[None] = Deferred()

        def done(result: object) -> object:
            if not waiting.called:
                waiting.callback(None)
            return result

        for goal in self._goals:
            if goal.ask.id == id and goal.pursued is not None and goal.pursued.beginning is not None:
                goal.pursued.beginning.addBoth(done)
                return waiting
        done(None)
        return waiting

    def cancel(self, ask: rosbridge.CancelActionGoal) -> None:
        """The client wants a goal no more; its result still comes."""
        if ask.id is None:
            raise Invalid("'cancel_action_goal' needs the 'id' of the goal")
        for goal in self._goals:
            if goal.ask.id == ask.id and goal.pursued is not None:
                goal.pursued.cancel()
                return
        raise Invalid(f"no goal of yours with the id '{str(ask.id)[:80]}' is under way")

    def rights_changed(self) -> None:
        """What the client may not pursue any more is cancelled, and it is told so at once."""
        for goal in list(self._goals):
            verdict = self._session.permit.judge(Operation.CALL, resolve(goal.ask.action))
            if not verdict.allowed and goal.pursued is not None:
                goal.pursued.abandon()
                self.goal_ended(goal, GoalStatusCode.CANCELED, False, jsontext.encode(verdict.reason))

    def answer(
        self,
        ask: rosbridge.SendActionGoal,
        status: int,
        result: bool,
        values: bytes,
        form: MessageEncoding | None = None,
    ) -> None:
        """Tell the client that one of its goals is over, in the form it asked for."""
        message = rosbridge.action_result(ask.action, ask.id, status, result, values)
        self._session.say(message, asked(ask, untold) if form is None else form)

    def tell_trouble(self, goal: _Goal, words: str) -> None:
        """Something of a goal can't be told to the client."""
        self._session.tell("warning", words, goal.ask.id)

    def tell_feedback(self, goal: _Goal, values: bytes) -> None:
        """Tell how far a goal has come. To a client that reads slowly, the newest counts."""
        message = rosbridge.action_feedback(goal.ask.action, goal.ask.id, values)
        self._session.outbox.data(goal, self._session.framed(message, goal.form), 1)

    def goal_ended(self, goal: _Goal, status: int, result: bool, values: bytes) -> None:
        """Take a goal off the list. Feedback that still waits would come behind the result; it is let go."""
        self._goals.remove(goal)
        self._notice_end(goal, status)
        self._session.outbox.forget(goal)
        if status == GoalStatusCode.NEVER_BEGAN:
            self._session.tell("error", str(jsontext.decode_any(values)), goal.ask.id)
        self.answer(goal.ask, status, result, values, goal.form)

    def end(self) -> None:
        """Nobody is left to hear of goals; the channel has them cancelled."""
        for goal in self._goals:
            self._notice_end(goal, GoalStatusCode.CANCELED)

    def _notice_end(self, goal: _Goal, status: int) -> None:
        self._session.notice("goal.ended", action=resolve(goal.ask.action), goal=goal.ask.id, status=status)

    def _check_room(self, ask: rosbridge.SendActionGoal) -> None:
        if ask.id is not None and any(goal.ask.id == ask.id for goal in self._goals):
            raise Refused(f"a goal of yours with the id '{str(ask.id)[:80]}' is under way already")
        if len(self._goals) >= GOALS:
            raise Refused(f"{GOALS} goals of this connection are under way already")
        if sum(goal.size for goal in self._goals) + len(bytes(ask.args or b"")) > GOAL_BYTES:
            raise Refused("the arguments of the goals under way are too large together; wait for results")
