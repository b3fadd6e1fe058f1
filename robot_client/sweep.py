"""What a stop does beyond the daemon's own clients: goals and topics of others, and of a daemon before this."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

from twisted.internet.defer import CancelledError, Deferred, maybeDeferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol.errors import SwitchboardError
from relay_protocol.link import MotionPolicy
from robot_client.guard_protocol import CANCEL, CANCEL_TYPE
from robot_client.platforms.base import Platform
from robot_client.zeros import Zeros

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

_NOTHING_TO_CANCEL = frozenset((2, 3))
"""What an action answers whose goals are unknown, or at their end already."""


class _Round:
    """What has been heard since one stop."""

    def __init__(self) -> None:
        self.heard: set[str] = set()
        self.asking: dict[str, Deferred[str | None]] = {}
        self.tries: Counter[str] = Counter()
        self.silent: set[str] = set()
        """Actions that ought to have answered."""
        self.refused: list[str] = []
        self.waiting: Deferred[list[str]] | None = None
        """Who gave the order."""


class Sweep:
    """Stops what others have the robot do.

    :param policy: what counts as motion
    :param clock: for timeouts
    :param commanded: whether clients may command a topic, which is stopped elsewhere
    """

    def __init__(
        self, policy: MotionPolicy, platform: Platform, clock: Any, commanded: Callable[[str], bool]
    ) -> None:
        self.zeros = Zeros(policy, platform, clock, commanded)
        """For the topics of others."""
        self.on_refused: Callable[[str], None] = lambda words: None
        """Told what an action refused when nobody waits for it any more."""
        self._policy = policy
        self._platform = platform
        self._clock = clock
        self._round: _Round | None = None
        self._unheard: set[str] = set()
        """Actions of which the log says already that they don't answer."""
        self._log = Logger("sweep")

    def begin(self) -> None:
        """The robot is stopped: :meth:`again` cancels what it finds."""
        self._round = _Round()

    def stop(self) -> Deferred[list[str]]:
        """Cancel all goals of the actions that move the robot, whoever gave them; :meth:`again` goes on with it.

        :return: fires when all there are have answered, or after :data:`HEARD_WITHIN`, with what they refused, in
            words; which have not answered :meth:`late` says
        """
        self._round = round = _Round()
        moving = self._moving()
        if moving is None:
            round.refused.append("which actions there are could not be found out")
        round.silent.update(moving or ())
        waiting: Deferred[list[str]] = Deferred(lambda _: self._told(round))
        round.waiting = waiting
        waiting.addTimeout(HEARD_WITHIN, self._clock)
        waiting.addErrback(lambda _: round.refused)
        self._ask(round, moving or [])
        self._tell(round)
        return waiting

    def again(self) -> None:
        """Ask those that have not answered since the stop, or are new; to be called every second."""
        if self._round is not None:
            self._ask(self._round, self._moving() or [])

    def end(self) -> None:
        """The robot is resumed: what has not been asked yet must not be, for goals may come that are to go on."""
        round, self._round = self._round, None
        for asked in list(round.asking.values()) if round is not None else []:
            asked.cancel()
        self.zeros.end()

    def late(self, pursued: Iterable[str] = ()) -> list[str]:
        """What the stop has not achieved yet, in words.

        :param pursued: actions whose goals, given by the relay, have not ended
        """
        silent = set() if self._round is None else self._round.silent
        words = []
        if silent:
            words.append(
                f"no word came from {_names(silent)} that goals are cancelled; it is asked again every second"
            )
        going = set(pursued) - silent
        if going:
            words.append(f"goals of {_names(going)} are not known to have ended")
        return words

    def actions(self) -> list[str]:
        """The actions there are now."""
        return self._actions() or []

    def cancel(self, action: str, goal: bytes = _ALL_GOALS) -> Deferred[str | None]:
        """Cancel one goal of an action, or all, whoever gave them.

        :param goal: its id, 16 bytes
        :return: fires within :data:`PATIENCE` with what it refused, in words; ``None``: it was not reached
        """
        request = _HEADER + goal + _TIME
        answer = maybeDeferred(self._platform.call, action + CANCEL, CANCEL_TYPE, request, PATIENCE)
        answer.addTimeout(PATIENCE, self._clock)
        return answer.addCallbacks(
            lambda body: self._answered(action, body), lambda failure: self._missed(action, failure)
        )

    def _ask(self, round: _Round, moving: list[str]) -> None:
        for gone in round.tries.keys() - set(moving):
            del round.tries[gone]
        if len(round.heard) > MAX_HEARD:
            round.heard.intersection_update(moving)
        left = set(moving) - round.heard - round.asking.keys()
        # Those that never answer must not keep the others from being asked.
        turn = sorted(left, key=lambda action: (round.tries[action], action))
        for action in turn[: MAX_ACTIONS - len(round.asking)]:
            round.tries[action] += 1
            round.asking[action] = asked = self.cancel(action)
            asked.addCallback(self._heard, action, round)

    def _heard(self, words: str | None, action: str, round: _Round) -> None:
        round.asking.pop(action, None)
        if words is None:
            if round.tries[action] > 1:
                round.silent.add(action)
            return
        round.heard.add(action)
        round.silent.discard(action)
        if words and round.waiting is not None:
            round.refused.append(words)
        elif words and round is self._round:
            self.on_refused(words)
        self._tell(round)

    def _tell(self, round: _Round) -> None:
        """Tell who gave the order, if all have answered."""
        waiting = round.waiting
        if waiting is not None and not round.silent:
            self._told(round)
            waiting.callback(round.refused)

    def _told(self, round: _Round) -> None:
        round.waiting = None

    def _answered(self, action: str, body: bytes) -> str:
        self._unheard.discard(action)
        words = _refusal(action, body)
        if words:
            self._log.warn("{words}", words=words)
        return words

    def _missed(self, action: str, failure: Failure) -> None:
        if action in self._unheard or failure.check(CancelledError):
            return
        self._unheard.add(action)
        self._log.warn(
            "the goals of {action} could not be cancelled: {why}", action=action, why=_words(failure)
        )

    def _moving(self) -> list[str] | None:
        """The actions that move the robot; ``None``: nobody can tell."""
        actions = self._actions()
        return None if actions is None else [each for each in actions if self._policy.moves_by_action(each)]

    def _actions(self) -> list[str] | None:
        try:
            return list(self._platform.graph().actions)
        except Exception:  # the rest of the stop must not hang on it
            self._log.failure("the graph could not be read")
            return None


def _names(actions: set[str]) -> str:
    named = sorted(actions)
    more = len(named) - MAX_NAMES
    return " and ".join([", ".join(named[:MAX_NAMES]), *([f"{more} more"] if more > 0 else [])])


def _words(failure: Failure) -> str:
    if isinstance(failure.value, SwitchboardError):
        return failure.getErrorMessage()
    return failure.type.__name__ if failure.type is not None else "unknown"


def _refusal(action: str, body: bytes) -> str:
    """What an answer says went wrong; empty for nothing."""
    if len(body) <= len(_HEADER):
        return ""
    code = body[len(_HEADER)]
    return "" if code == 0 or code in _NOTHING_TO_CANCEL else f"{action} refuses to cancel its goals"
