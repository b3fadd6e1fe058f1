"""What a stop does beyond the daemon's own clients: goals and topics of others, and of a daemon before this."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred, DeferredList, maybeDeferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol.errors import SwitchboardError
from relay_protocol.link import MotionPolicy
from robot_client.guard_protocol import CANCEL, CANCEL_TYPE
from robot_client.platforms.base import GraphView, Platform
from robot_client.zeros import Zeros

PATIENCE = 1.0
"""Seconds an action may take to cancel its goals."""

MAX_ACTIONS = 64
"""Actions that are told at a stop."""

_HEADER = b"\0\1\0\0"
_ALL_GOALS = _HEADER + bytes(16 + 4 + 4)
"""No goal's id and no time: cancel all."""

_NOTHING_TO_CANCEL = frozenset((2, 3))
"""What an action answers whose goals are unknown, or at their end already."""


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
        self._policy = policy
        self._platform = platform
        self._clock = clock
        self._asked: set[str] = set()
        """Actions that have not answered yet."""
        self._log = Logger("sweep")

    def cancel_goals(self, but: frozenset[str] = frozenset()) -> tuple[set[str], Deferred[list[str]]]:
        """Cancel all goals of the actions that move the robot, whoever gave them.

        An action that is still to answer is not asked again.

        :param but: actions that need not be asked
        :return: the actions asked, and what fires within :data:`PATIENCE` with what they refused, in words
        """
        moving = (each for each in self.actions() if self._policy.moves_by_action(each))
        asked = sorted(set(moving) - but - self._asked)[:MAX_ACTIONS]
        answers = DeferredList([self.cancel(each) for each in asked], consumeErrors=True)
        return set(asked), answers.addCallback(lambda ends: [words for good, words in ends if good and words])

    def actions(self) -> list[str]:
        """The actions there are now."""
        return list(self._graph().actions)

    def cancel(self, action: str) -> Deferred[str | None]:
        """Cancel all goals of an action, whoever gave them.

        :return: fires within :data:`PATIENCE` with what it refused, in words; ``None``: it was not reached
        """
        self._asked.add(action)
        answer = maybeDeferred(self._platform.call, action + CANCEL, CANCEL_TYPE, _ALL_GOALS, PATIENCE)
        answer.addTimeout(PATIENCE, self._clock)
        words = answer.addCallbacks(
            lambda body: _refusal(action, body), lambda failure: self._unheard(action, failure)
        )
        return words.addCallback(self._answered, action)

    def _answered(self, words: str | None, action: str) -> str | None:
        self._asked.discard(action)
        if words:
            self._log.warn("{words}", words=words)
        return words

    def _unheard(self, action: str, failure: Failure) -> None:
        self._log.warn(
            "the goals of {action} could not be cancelled: {why}", action=action, why=_words(failure)
        )

    def _graph(self) -> GraphView:
        try:
            return self._platform.graph()
        except Exception:  # the rest of the stop must not hang on it
            self._log.failure("the graph could not be read")
            return GraphView()


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
