"""Cancels all goals of the actions that move the robot during a stop, also those of other nodes.

The relay's own goals are cancelled before, by :meth:`robot_client.motion.robot_port.RobotPort.cancel_goals`, also those
that do not move the robot; here goals of other nodes and of an earlier daemon are reached too.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable
from typing import Any

from twisted.internet.defer import CancelledError, Deferred, maybeDeferred, succeed
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol.errors import SwitchboardError
from relay_protocol.link import MotionPolicy
from robot_client.motion.goal_status_reader import GoalStatusReader
from robot_client.motion.guard_protocol import CANCEL, CANCEL_TYPE
from robot_client.platforms.base import Platform

ANSWER_SECONDS = 1.0
"""Seconds an action may take to answer a cancel request."""

STOP_SECONDS = 2.0
"""Seconds a stop waits for the actions; enough for two requests each, as the first has to discover the service."""

MAX_REQUESTS = 64
"""Most cancel requests under way at a time."""

MAX_ANSWERED = 1024
"""Most actions remembered as answered, before those that are gone are dropped."""

MAX_NAMES = 8
"""Most actions named in one sentence."""

_HEADER = b"\0\1\0\0"
_ANY_TIME = bytes(4 + 4)
"""A stamp of zero: goals of any age (action_msgs/srv/CancelGoal)."""

_ALL_GOALS = bytes(16)

_CODE_OFFSET = 4
_COUNT_OFFSET = 8
"""Byte offsets in a response: of its return code, and of the number of goals being cancelled."""

_NOTHING_TO_CANCEL = frozenset((2, 3))
"""Return codes for an unknown goal and for a goal that has ended (action_msgs/srv/CancelGoal)."""


class _StopRequest:
    """A stop that waits for actions.

    :param number: counts the stops of a round
    :param pending: the actions that have not answered since
    """

    def __init__(self, number: int, pending: set[str]) -> None:
        self.number = number
        self.pending = pending
        self.done: Deferred[None] = Deferred()


class _CancelRound:
    """The answers of actions while the robot is stopped; lasts until a resume."""

    def __init__(self) -> None:
        self.number = 0
        """Of the latest stop."""
        self.stops: list[_StopRequest] = []
        """Stops that still wait."""
        self.actions: list[str] = []
        """Actions to ask, as last seen in the graph."""
        self.answered: set[str] = set()
        """Actions that have answered a request sent after the latest stop."""
        self.requests: dict[str, Deferred[str | None]] = {}
        self.attempts: Counter[str] = Counter()
        self.failures_in_row: Counter[str] = Counter()
        """Requests in a row without an answer."""
        self.unanswered: set[str] = set()
        """Actions whose answer is overdue."""
        self.refusing: set[str] = set()
        """Actions that refused to cancel in their latest answer."""
        self.status_reads: dict[str, Deferred[frozenset[bytes]]] = {}
        """Actions that have answered, and whose status is read to see whether goals continue."""

    def begin_stop(self, moving: list[str]) -> _StopRequest:
        """Begin a stop with these actions; their earlier answers count until they answer again."""
        self.number += 1
        self.answered.clear()
        self.end_status_reads()
        self.unanswered.intersection_update(moving)
        self.refusing.intersection_update(moving)
        stop = _StopRequest(self.number, set(moving))
        self.stops.append(stop)
        return stop

    def note_answer(self, action: str, number: int) -> None:
        """Note that an action has answered a request sent after stop ``number``."""
        for stop in [each for each in self.stops if each.number <= number]:
            stop.pending.discard(action)
            self.complete_if_answered(stop)

    def complete_if_answered(self, stop: _StopRequest) -> None:
        """Complete a stop if no action is pending."""
        if not stop.pending and stop in self.stops:
            self.stops.remove(stop)
            stop.done.callback(None)

    def give_up(self, stop: _StopRequest) -> None:
        """End the wait of a stop; its pending actions count as unanswered."""
        self.stops.remove(stop)
        self.unanswered |= stop.pending - self.refusing

    def end_status_reads(self) -> None:
        """Stop reading the status of actions."""
        reads, self.status_reads = self.status_reads, {}
        for each in reads.values():
            each.cancel()


class GoalCanceller:
    """Cancels goals of the robot's actions, whichever client sent them; during a stop those of all that move it.

    :param policy: what counts as motion
    :param clock: for timeouts
    """

    def __init__(self, policy: MotionPolicy, platform: Platform, clock: Any) -> None:
        self._policy = policy
        self._platform = platform
        self._clock = clock
        self._cancel_round: _CancelRound | None = None
        self._logged_silent: set[str] = set()
        """Actions already logged as not answering."""
        self._checking: set[str] = set()
        """Actions for which :meth:`cancel_all_checked` is under way."""
        self._goals_before: dict[str, frozenset[bytes]] = {}
        """By action, ids of goals that were active after the first request of :meth:`cancel_all_checked` and still
        are."""
        self._statuses = GoalStatusReader(platform, clock)
        self._logged_refusing: set[str] = set()
        """Actions already logged as refusing."""
        self._moving_actions: list[str] = []
        """The actions that move the robot, as last seen in the graph."""
        self._log = Logger("goals")

    def begin_stopped(self) -> None:
        """Begin with a robot stopped before the daemon started: :meth:`retry` cancels what it finds."""
        self._cancel_round = _CancelRound()

    def stop(self) -> Deferred[list[str]]:
        """Cancel all goals of the actions that move the robot, of any client; :meth:`retry` continues it.

        An action with a request under way is asked once more after it has answered.

        :return: fires when all actions have answered, or after :data:`STOP_SECONDS`, with sentences about what went
            wrong; :meth:`problems` describes actions that have not answered or refuse
        """
        round = self._cancel_round = self._cancel_round or _CancelRound()
        actions = self._read_actions()
        stop = round.begin_stop(self._moving_actions)
        stop.done.addTimeout(STOP_SECONDS, self._clock)
        stop.done.addErrback(lambda _: round.give_up(stop))
        self._send_due(round, self._moving_actions)
        round.complete_if_answered(stop)
        problems = ["the robot's actions could not be read from the graph"] if actions is None else []
        return stop.done.addCallback(lambda _: problems)

    def retry(self) -> None:
        """Ask actions that have not answered since the stop, refuse, or are new. Does nothing without a stop.

        To be called every second.
        """
        if self._cancel_round is not None:
            self._read_actions()
            self._send_due(self._cancel_round, self._moving_actions)

    def end(self) -> None:
        """End with a resume. Requests not yet sent are dropped, as they would cancel goals sent after it."""
        round, self._cancel_round = self._cancel_round, None
        if round is not None:
            round.end_status_reads()
            for each in list(round.requests.values()):
                each.cancel()

    def problems(self, active_actions: Iterable[str] = ()) -> list[str]:
        """Sentences about goals that the stop has not ended yet.

        :param active_actions: actions whose goals, sent by the relay, have not ended
        """
        round = self._cancel_round or _CancelRound()
        unanswered, refusing = round.unanswered, round.refusing
        problems = []
        if unanswered:
            problems.append(
                f"{list_names(unanswered)} did not answer the request to cancel goals; it is repeated every second"
            )
        if refusing:
            problems.append(
                f"{list_names(refusing)} refuses to cancel goals; the request is repeated every second"
            )
        unfinished = set(active_actions) - unanswered - refusing
        if unfinished:
            problems.append(f"goals of {list_names(unfinished)} are not known to have ended")
        return problems

    def actions(self) -> list[str]:
        """The actions in the graph now; empty where it can't be read."""
        return self._read_actions() or []

    @property
    def moving_actions(self) -> list[str]:
        """Those that move the robot, of the actions that were last read from the graph."""
        return self._moving_actions

    def cancel(self, action: str, goal: bytes = _ALL_GOALS) -> Deferred[str | None]:
        """Cancel one goal of an action, or all, of any client.

        :param goal: its id, 16 bytes; default: all goals
        :return: fires within :data:`ANSWER_SECONDS` with a sentence about a refusal; empty: the action is cancelling,
            or has nothing to cancel; ``None``: no answer came
        """
        request = _HEADER + goal + _ANY_TIME
        answer = maybeDeferred(self._platform.call, action + CANCEL, CANCEL_TYPE, request, ANSWER_SECONDS)
        answer.addTimeout(ANSWER_SECONDS, self._clock)
        return answer.addCallbacks(
            lambda body: self._on_response(action, body, goal != _ALL_GOALS),
            lambda failure: self._on_failure(action, failure),
        )

    def cancel_all_checked(self, action: str) -> Deferred[str | None]:
        """Cancel all goals of an action, and check its status afterwards; results as of :meth:`cancel`.

        The action counts as refusing while goals continue that were active after its first answer. Later goals belong
        to other clients.

        :return: fires with ``None`` at once while a call for this action is under way, as a second request could
            cancel a goal that began since
        """
        if action in self._checking:
            return succeed(None)
        self._checking.add(action)

        def checked(result: Any) -> Any:
            self._checking.discard(action)
            return result

        return self.cancel(action).addCallback(self._check_left_goals, action).addBoth(checked)

    def forget(self, action: str) -> None:
        """Forget the goals that :meth:`cancel_all_checked` has seen of an action."""
        self._goals_before.pop(action, None)

    def _check_left_goals(self, refusal: str | None, action: str) -> Deferred[str | None]:
        if refusal != "":
            return succeed(refusal)
        return self._statuses.active_goals(action).addCallback(self._refusal_by_left_goals, action)

    def _refusal_by_left_goals(self, active_goals: frozenset[bytes], action: str) -> str:
        """Why an action refuses, by the goals that continue, though its answer did not say so; empty if it does not."""
        active_goals &= self._goals_before.get(action, active_goals)
        if not active_goals:
            self.forget(action)
            return ""
        self._goals_before[action] = active_goals
        return _refusal_text(action, one=False)

    def _send_due(self, round: _CancelRound, moving: list[str]) -> None:
        round.actions = moving
        for gone in round.attempts.keys() - set(moving):
            del round.attempts[gone]
            round.failures_in_row.pop(gone, None)
        if len(round.answered) > MAX_ANSWERED:
            round.answered.intersection_update(moving)
        left = set(moving) - round.answered - round.requests.keys()
        # Fewest tries first: actions that never answer must not block the others.
        in_order = sorted(left, key=lambda action: (round.attempts[action], action))
        for action in in_order[: MAX_REQUESTS - len(round.requests)]:
            self._send_request(round, action)

    def _send_request(self, round: _CancelRound, action: str) -> None:
        round.attempts[action] += 1
        round.requests[action] = answer = self.cancel(action)
        answer.addCallback(self._on_result, action, round, round.number)

    def _on_result(self, refusal: str | None, action: str, round: _CancelRound, number: int) -> None:
        """Handle the result of a request sent after stop ``number``; ``None``: no answer came."""
        round.requests.pop(action, None)
        late = number < round.number
        if refusal is None:
            round.failures_in_row[action] += 1
            if round.failures_in_row[action] > 1 and action not in round.refusing:
                round.unanswered.add(action)
            if late and round is self._cancel_round:
                self._send_due(round, round.actions)  # in order with other actions that never answer
            return
        round.failures_in_row.pop(action, None)
        round.unanswered.discard(action)
        if refusal:
            round.refusing.add(action)
        elif not late and round is self._cancel_round:
            # It may have refused some goals and accepted others since; only its status topic shows that.
            round.answered.add(action)
            round.status_reads[action] = checked = self._statuses.active_goals(action)
            checked.addCallback(self._on_status, action, round)
            checked.addErrback(lambda failure: failure.trap(CancelledError) and None)
        round.note_answer(action, number)
        if late and round is self._cancel_round:
            self._send_request(round, action)

    def _on_status(self, active_goals: frozenset[bytes], action: str, round: _CancelRound) -> None:
        """Handle the goals that continue after an answer without a refusal."""
        del round.status_reads[action]
        if not active_goals:
            round.refusing.discard(action)
            return
        round.answered.discard(action)
        if action not in round.refusing:
            round.refusing.add(action)
            if len(round.requests) < MAX_REQUESTS:
                self._send_request(round, action)  # cancels goals accepted a moment ago

    def _on_response(self, action: str, body: bytes, one: bool) -> str:
        self._logged_silent.discard(action)
        problem = _problem_of(action, body, one)
        if not problem:
            self._logged_refusing.discard(action)
        elif action not in self._logged_refusing:
            self._logged_refusing.add(action)
            self._log.warn("{problem}", problem=problem)
        return problem

    def _on_failure(self, action: str, failure: Failure) -> None:
        if action in self._logged_silent or failure.check(CancelledError):
            return
        self._logged_silent.add(action)
        self._log.warn(
            "the goals of {action} could not be cancelled: {why}", action=action, why=_describe(failure)
        )

    def _read_actions(self) -> list[str] | None:
        """The actions in the graph; ``None``: it can't be read, and those seen last count."""
        try:
            actions = list(self._platform.graph().actions)
        except Exception:  # the other parts of a stop must not depend on it
            self._log.failure("the graph could not be read")
            return None
        self._moving_actions = [each for each in actions if self._policy.moves_by_action(each)]
        return actions


def list_names(actions: Iterable[str]) -> str:
    """List actions for a sentence, at most :data:`MAX_NAMES` by name."""
    named = sorted(actions)
    more = len(named) - MAX_NAMES
    return " and ".join([", ".join(named[:MAX_NAMES]), *([f"{more} more"] if more > 0 else [])])


def _describe(failure: Failure) -> str:
    if isinstance(failure.value, SwitchboardError):
        return failure.getErrorMessage()
    return failure.type.__name__ if failure.type is not None else "unknown"


def _problem_of(action: str, body: bytes, one: bool) -> str:
    """Describe what went wrong by a response; empty: nothing.

    A refusing rclpy server answers with no error and an empty list of goals. To a request to cancel all goals, a server
    without goals answers the same; its status topic then decides (:mod:`robot_client.motion.goal_status_reader`).

    :param body: the response in CDR
    :param one: whether one goal was to be cancelled, else all
    """
    code = body[_CODE_OFFSET] if len(body) > _CODE_OFFSET else 0
    if code in _NOTHING_TO_CANCEL or (code == 0 and (not one or _count_cancelling(body))):
        return ""
    return _refusal_text(action, one)


def _refusal_text(action: str, one: bool) -> str:
    return f"{action} refuses to cancel {'a goal' if one else 'its goals'}"


def _count_cancelling(body: bytes) -> int:
    """How many goals are being cancelled by a response."""
    if len(body) < _COUNT_OFFSET + 4:
        return 0
    byte_order = "<" if body[1] & 1 else ">"
    return int(struct.unpack_from(byte_order + "I", body, _COUNT_OFFSET)[0])
