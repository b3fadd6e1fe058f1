"""Turns spoken command words into velocity commands."""

from __future__ import annotations

import enum
import math
from typing import NamedTuple

from robot_client.apps.driver import MaximumSpeeds, VelocityCommand

SECONDS = 1.5
"""Duration of a word's motion, seconds."""

INITIAL_FACTOR = 0.5
"""Initial speed, as fraction of the maximum."""

MIN_FACTOR = 0.1
FACTOR_STEP = 1.3
"""Factor of *faster* and *slower*."""


class CommandWord(enum.Enum):
    """Recognised words."""

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


_MOTIONS = {
    CommandWord.AHEAD: _WordMotion(1.0, 0.0),
    CommandWord.BACK: _WordMotion(-1.0, 0.0),
    CommandWord.LEFT: _WordMotion(0.0, 1.0),
    CommandWord.RIGHT: _WordMotion(0.0, -1.0),
}

MOTION_WORDS = frozenset(_MOTIONS)
"""Words that start a motion."""


class WordCommands:
    """The current motion and its speed.

    :param seconds: duration of a word's motion; the same word, *faster* and *slower* extend it
    """

    def __init__(self, seconds: float = SECONDS) -> None:
        self._seconds = seconds
        self._speed_factor = INITIAL_FACTOR
        self._motion: _WordMotion | None = None
        self._until = -math.inf

    def handle(self, word: CommandWord, now: float) -> None:
        """Take a word.

        :param now: monotonic seconds
        """
        if word is CommandWord.STOP:
            self.cancel()
        elif word in _MOTIONS:
            self._motion, self._until = _MOTIONS[word], now + self._seconds
        else:
            self._speed_factor *= FACTOR_STEP if word is CommandWord.FASTER else 1 / FACTOR_STEP
            self._speed_factor = min(1.0, max(MIN_FACTOR, self._speed_factor))
            if self.active(now):
                self._until = now + self._seconds

    def cancel(self) -> None:
        """End the motion."""
        self._motion = None

    def active(self, now: float) -> bool:
        """Whether a motion is active."""
        return self._motion is not None and now < self._until

    def command(self, top: MaximumSpeeds, now: float) -> VelocityCommand | None:
        """The command for the robot; ``None`` to stop.

        :param top: maximum speeds
        """
        if self._motion is None or now >= self._until:
            return None
        return VelocityCommand(
            self._motion.ahead * self._speed_factor * top.speed,
            self._motion.left * self._speed_factor * top.turn,
        )
