"""Linear ramps to a standstill. Pure: times in, speeds out."""

from __future__ import annotations

from typing import NamedTuple

from robot_client.motion.velocity import Velocity

STEP = 20_000_000
"""Nanoseconds between two commands of a ramp."""


class Ramp(NamedTuple):
    """A linear ramp from the last command to zero.

    :ivar velocity: of the last command
    :ivar since: when the ramp begins, monotonic nanoseconds
    :ivar until: when it ends, monotonic nanoseconds
    """

    velocity: Velocity
    since: int
    until: int

    def at(self, now: int) -> Velocity | None:
        """The speed at a time; ``None``: the ramp is over, so publish zero.

        Never faster than at the beginning, even if the clock goes back.
        """
        if now >= self.until:
            return None
        return self.velocity.times(min(1.0, (self.until - now) / (self.until - self.since)))


def ramp(velocity: Velocity, now: int, length: int, latest: int) -> Ramp | None:
    """A ramp that begins now; ``None``: no time is left, or nothing moves.

    :param length: nanoseconds it takes, where time allows
    :param latest: when zero must be published at the latest, monotonic nanoseconds
    """
    until = min(now + length, latest)
    return Ramp(velocity, now, until) if until - now > STEP and velocity.moves else None
