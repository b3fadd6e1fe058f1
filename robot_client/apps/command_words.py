"""What words mean to a robot, one after the other. Pure."""

from __future__ import annotations

import enum
import math
from typing import NamedTuple

from robot_client.apps.driver import MaximumSpeeds, VelocityCommand

SECONDS = 1.5
"""How long a word acts."""

FIRST = 0.5
"""Of the fastest: how fast it goes before anybody has said anything of it."""

SLOWEST = 0.1
STEP = 1.3
"""How many times as fast it is after *faster*."""


class CommandWord(enum.Enum):
    """All that are understood."""

    RIGHT = "right"
    LEFT = "left"
    AHEAD = "ahead"
    BACK = "back"
    FASTER = "faster"
    SLOWER = "slower"
    STOP = "stop"


class _WordMotion(NamedTuple):
    ahead: float
    left: float


_WAYS = {
    CommandWord.AHEAD: _WordMotion(1.0, 0.0),
    CommandWord.BACK: _WordMotion(-1.0, 0.0),
    CommandWord.LEFT: _WordMotion(0.0, 1.0),
    CommandWord.RIGHT: _WordMotion(0.0, -1.0),
}

MOVES = frozenset(_WAYS)
"""Words that make a robot move that stands."""


class WordCommands:
    """The word under way, and how fast it is done.

    :param seconds: how long a word acts; said again, or followed by *faster* or *slower*, it goes on from there
    """

    def __init__(self, seconds: float = SECONDS) -> None:
        self._seconds = seconds
        self._part = FIRST
        self._way: _WordMotion | None = None
        self._until = -math.inf

    def say(self, word: CommandWord, now: float) -> None:
        """A word was said.

        :param now: monotonic seconds
        """
        if word is CommandWord.STOP:
            self.still()
        elif word in _WAYS:
            self._way, self._until = _WAYS[word], now + self._seconds
        else:
            self._part *= STEP if word is CommandWord.FASTER else 1 / STEP
            self._part = min(1.0, max(SLOWEST, self._part))
            if self.under_way(now):
                self._until = now + self._seconds

    def still(self) -> None:
        """Nothing is under way any more."""
        self._way = None

    def under_way(self, now: float) -> bool:
        """Whether a word still acts."""
        return self._way is not None and now < self._until

    def command(self, top: MaximumSpeeds, now: float) -> VelocityCommand | None:
        """What the robot is to do now; ``None`` to stand.

        :param top: the fastest it may be
        """
        if self._way is None or now >= self._until:
            return None
        return VelocityCommand(
            self._way.ahead * self._part * top.speed, self._way.left * self._part * top.turn
        )
