"""What a stop does beyond the daemon's own clients: goals and topics of others, and of a daemon before this."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

from twisted.internet.defer import CancelledError, Deferred, maybeDeferred, succeed
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol.errors import SwitchboardError
from relay_protocol.link import MotionPolicy
from robot_client.motion.goal_status_reader import GoalStatusReader
from robot_client.motion.guard_protocol import CANCEL, CANCEL_TYPE
from robot_client.motion.zero_publisher import ZeroPublisher
from robot_client.platforms.base import Platform

PATIENCE = 1.0
"""Seconds an action may take to cancel its goals."""

HEARD_WITHIN = 2.0
"""Seconds an order to stop waits for the actions: each is asked twice in this, for a first call has to find it."""

MAX_ACTIONS = 64
"""Actions that are being asked at a time."""

MAX_HEARD = 1024
"""Actions that are remembered to have answered, also when they are gone."""

MAX_NAMES = 8
"""Actions that are named in one sentence."""

_HEADER = b"\0\1\0\0"
_TIME = bytes(4 + 4)
"""No time: of what was given at any."""

_ALL_GOALS = bytes(16)

_CODE = 4
_COUNT = 8
"""Where in the bytes of an answer there are its code and how many goals it says are being cancelled."""

_NOTHING_TO_CANCEL = frozenset((2, 3))
"""What an action answers whose goals are unknown, or at their end already."""


class _Order:
    """An order to stop that waits for actions.

    :param number: orders are counted
    :param pending: the actions that have not answered since
    """

    def __init__(self, number: int, pending: set[str]) -> None:
        self.number = number
        self.pending = pending
        self.done: Deferred[None] = Deferred()


class _CancelRound:
    """What has been heard while the robot is stopped."""

    def __init__(self) -> None:
        self.number = 0
        """Of the latest order."""
        self.orders: list[_Order] = []
        """Those that wait."""
        self.moving: list[str] = []
        """Actions to ask, as they were seen last."""
        self.heard: set[str] = set()
        """Actions that have answered what they were asked after the latest order."""
        self.asking: dict[str, Deferred[str | None]] = {}
        self.tries: Counter[str] = Counter()
        self.missed: Counter[str] = Counter()
        """How often in a row no answer came."""
        self.silent: set[str] = set()
        """Actions that ought to have answered."""
        self.refusing: set[str] = set()
        """Those whose latest answer was that they don't cancel."""
        self.checking: dict[str, Deferred[frozenset[bytes]]] = {}
        """Those that have answered, and may go on with goals all the same."""

    def order(self, moving: list[str]) -> _Order:
        """Begin anew with these actions; what is known of them counts until they answer again."""
        self.number += 1
        self.heard.clear()
        self.end_checks()
        self.silent.intersection_update(moving)
        self.refusing.intersection_update(moving)
        order = _Order(self.number, set(moving))
        self.orders.append(order)
        return order

    def answered(self, action: str, number: int) -> None:
        """An action has answered what it was asked after so many orders."""
        for order in [each for each in self.orders if each.number <= number]:
            order.pending.discard(action)
            self.settle(order)

    def settle(self, order: _Order) -> None:
        """Tell who gave an order, if nothing is pending."""
        if not order.pending and order in self.orders:
            self.orders.remove(order)
            order.done.callback(None)

    def give_up(self, order: _Order) -> None:
        """An order has waited long enough."""
        self.orders.remove(order)
        self.silent |= order.pending - self.refusing

    def end_checks(self) -> None:
        """What actions publish is of no interest any more."""
        checking, self.checking = self.checking, {}
        for each in checking.values():
            each.cancel()


class GoalCanceller:
    """Stops what others have the robot do.

    :param policy: what counts as motion
    :param clock: for timeouts
    :param commanded: whether clients may command a topic, which is stopped elsewhere
    """

    def __init__(
        self, policy: MotionPolicy, platform: Platform, clock: Any, commanded: Callable[[str], bool]
    ) -> None:
        self.zeros = ZeroPublisher(policy, platform, clock, commanded)
        """For the topics of others."""
        self._policy = policy
        self._platform = platform
        self._clock = clock
        self._round: _CancelRound | None = None
        self._unheard: set[str] = set()
        """Actions of which the log says already that they don't answer."""
        self._finding: set[str] = set()
        """Actions of which :meth:`cancel_surely` is under way."""
        self._former: dict[str, frozenset[bytes]] = {}
        """The ids of the goals that went on when an action was first asked by it, and go on still."""
        self._statuses = GoalStatusReader(platform, clock)
        self._refusing: set[str] = set()
        """Actions of which it says already that they refuse."""
        self._last: list[str] = []
        """The actions that move the robot, as they were seen last."""
        self._log = Logger("sweep")

    def begin(self) -> None:
        """The robot is stopped: :meth:`again` cancels what it finds."""
        self._round = _CancelRound()

    def stop(self) -> Deferred[list[str]]:
        """Cancel all goals of the actions that move the robot, whoever gave them; :meth:`again` goes on with it.

        While others wait too, each action is asked once more when it has answered what it is being asked now.

        :return: fires when all there are have answered, or after :data:`HEARD_WITHIN`, with what went wrong, in
            words; which have not answered, or refuse, :meth:`late` says
        """
        round = self._round = self._round or _CancelRound()
        seen = self._actions()
        order = round.order(self._last)
        order.done.addTimeout(HEARD_WITHIN, self._clock)
        order.done.addErrback(lambda _: round.give_up(order))
        self._ask(round, self._last)
        round.settle(order)
        blind = ["which actions there are could not be found out"] if seen is None else []
        return order.done.addCallback(lambda _: blind)

    def again(self) -> None:
        """Ask those that have not answered since the stop, refuse, or are new; to be called every second."""
        if self._round is not None:
            self._actions()
            self._ask(self._round, self._last)

    def end(self) -> None:
        """The robot is resumed: what has not been asked yet must not be, for goals may come that are to go on."""
        round, self._round = self._round, None
        if round is not None:
            round.end_checks()
            for each in list(round.asking.values()):
                each.cancel()
        self.zeros.end()

    def late(self, pursued: Iterable[str] = ()) -> list[str]:
        """What the stop has not achieved yet, in words.

        :param pursued: actions whose goals, given by the relay, have not ended
        """
        round = self._round or _CancelRound()
        silent, refusing = round.silent, round.refusing
        words = []
        if silent:
            words.append(
                f"no word came from {names(silent)} that goals are cancelled; it is asked again every second"
            )
        if refusing:
            words.append(f"{names(refusing)} refuses to cancel goals; it is asked again every second")
        going = set(pursued) - silent - refusing
        if going:
            words.append(f"goals of {names(going)} are not known to have ended")
        return words

    def actions(self) -> list[str]:
        """The actions there are now."""
        return self._actions() or []

    def cancel(self, action: str, goal: bytes = _ALL_GOALS) -> Deferred[str | None]:
        """Cancel one goal of an action, or all, whoever gave them.

        :param goal: its id, 16 bytes
        :return: fires within :data:`PATIENCE` with what it refused, in words, empty where it is cancelling, or there is
            nothing to cancel; ``None``: it was not reached
        """
        request = _HEADER + goal + _TIME
        answer = maybeDeferred(self._platform.call, action + CANCEL, CANCEL_TYPE, request, PATIENCE)
        answer.addTimeout(PATIENCE, self._clock)
        return answer.addCallbacks(
            lambda body: self._answered(action, body, goal != _ALL_GOALS),
            lambda failure: self._missed(action, failure),
        )

    def cancel_surely(self, action: str) -> Deferred[str | None]:
        """Cancel all goals of an action; as :meth:`cancel`, with what has come of it a moment later.

        It refuses as long as goals go on that did after its first answer. Those that came since are of others.

        :return: fires with ``None`` at once while that is found out already: who then may begin must not be cancelled
        """
        if action in self._finding:
            return succeed(None)
        self._finding.add(action)

        def found(result: Any) -> Any:
            self._finding.discard(action)
            return result

        return self.cancel(action).addCallback(self._surely, action).addBoth(found)

    def forget(self, action: str) -> None:
        """An action is not asked by :meth:`cancel_surely` any more."""
        self._former.pop(action, None)

    def _surely(self, words: str | None, action: str) -> Deferred[str | None]:
        if words != "":
            return succeed(words)
        return self._statuses.going(action).addCallback(self._left, action)

    def _left(self, going: frozenset[bytes], action: str) -> str:
        """Of an action that has not said it refuses these goals go on."""
        going &= self._former.get(action, going)
        if not going:
            self.forget(action)
            return ""
        self._former[action] = going
        return _refuses(action, one=False)

    def _ask(self, round: _CancelRound, moving: list[str]) -> None:
        round.moving = moving
        for gone in round.tries.keys() - set(moving):
            del round.tries[gone]
            round.missed.pop(gone, None)
        if len(round.heard) > MAX_HEARD:
            round.heard.intersection_update(moving)
        left = set(moving) - round.heard - round.asking.keys()
        # Those that never answer must not keep the others from being asked.
        turn = sorted(left, key=lambda action: (round.tries[action], action))
        for action in turn[: MAX_ACTIONS - len(round.asking)]:
            self._ask_one(round, action)

    def _ask_one(self, round: _CancelRound, action: str) -> None:
        round.tries[action] += 1
        round.asking[action] = asked = self.cancel(action)
        asked.addCallback(self._heard, action, round, round.number)

    def _heard(self, words: str | None, action: str, round: _CancelRound, number: int) -> None:
        """An action has answered what it was asked after so many orders, or has not (``None``)."""
        round.asking.pop(action, None)
        late = number < round.number
        if words is None:
            round.missed[action] += 1
            if round.missed[action] > 1 and action not in round.refusing:
                round.silent.add(action)
            if late and round is self._round:
                self._ask(round, round.moving)  # in turn with others that never answer
            return
        round.missed.pop(action, None)
        round.silent.discard(action)
        if words:
            round.refusing.add(action)
        elif not late and round is self._round:
            # It may have refused some of its goals, and accepted others since: only what it publishes tells.
            round.heard.add(action)
            round.checking[action] = checked = self._statuses.going(action)
            checked.addCallback(self._checked, action, round)
            checked.addErrback(lambda failure: failure.trap(CancelledError) and None)
        round.answered(action, number)
        if late and round is self._round:
            self._ask_one(round, action)

    def _checked(self, going: frozenset[bytes], action: str, round: _CancelRound) -> None:
        """An action that has not said it refuses has goals that go on, or not."""
        del round.checking[action]
        if not going:
            round.refusing.discard(action)
            return
        round.heard.discard(action)
        if action not in round.refusing:
            round.refusing.add(action)
            if len(round.asking) < MAX_ACTIONS:
                self._ask_one(round, action)  # what it has only just accepted ends by that

    def _answered(self, action: str, body: bytes, one: bool) -> str:
        self._unheard.discard(action)
        words = _refusal(action, body, one)
        if not words:
            self._refusing.discard(action)
        elif action not in self._refusing:
            self._refusing.add(action)
            self._log.warn("{words}", words=words)
        return words

    def _missed(self, action: str, failure: Failure) -> None:
        if action in self._unheard or failure.check(CancelledError):
            return
        self._unheard.add(action)
        self._log.warn(
            "the goals of {action} could not be cancelled: {why}", action=action, why=_words(failure)
        )

    def _actions(self) -> list[str] | None:
        """The actions there are; ``None``: nobody can tell, and those that were seen last count."""
        try:
            actions = list(self._platform.graph().actions)
        except Exception:  # the rest of the stop must not hang on it
            self._log.failure("the graph could not be read")
            return None
        self._last = [each for each in actions if self._policy.moves_by_action(each)]
        return actions


def names(actions: Iterable[str]) -> str:
    """Actions in a sentence; of many only some by name."""
    named = sorted(actions)
    more = len(named) - MAX_NAMES
    return " and ".join([", ".join(named[:MAX_NAMES]), *([f"{more} more"] if more > 0 else [])])


def _words(failure: Failure) -> str:
    if isinstance(failure.value, SwitchboardError):
        return failure.getErrorMessage()
    return failure.type.__name__ if failure.type is not None else "unknown"


def _refusal(action: str, body: bytes, one: bool) -> str:
    """What an answer says went wrong; empty for nothing.

    A server of rclpy that refuses answers with no error and an empty list of what it cancels. To the wish that all be
    cancelled a server without goals answers the same, so what it publishes has to tell
    (:mod:`robot_client.motion.goal_status_reader`).

    :param one: whether one goal was meant, else all
    """
    code = body[_CODE] if len(body) > _CODE else 0
    if code in _NOTHING_TO_CANCEL or (code == 0 and (not one or _cancelling(body))):
        return ""
    return _refuses(action, one)


def _refuses(action: str, one: bool) -> str:
    return f"{action} refuses to cancel {'a goal' if one else 'its goals'}"


def _cancelling(body: bytes) -> int:
    """How many goals an answer says are being cancelled."""
    if len(body) < _COUNT + 4:
        return 0
    order = "<" if body[1] & 1 else ">"
    return int(struct.unpack_from(order + "I", body, _COUNT)[0])
