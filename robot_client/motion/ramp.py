"""Coming to a standstill over a time instead of at once. Pure: times in, speeds out."""

from __future__ import annotations

from typing import NamedTuple

from robot_client.motion.velocity import Velocity

STEP = 20_000_000
"""Nanoseconds from one command of a ramp to the next."""


class Ramp(NamedTuple):
    """The way from the last command to zero.

    :ivar velocity: what was asked for last
    :ivar since: when it begins, monotonic nanoseconds
    :ivar until: when it must be over
    """

    velocity: Velocity
    since: int
    until: int

    def at(self, now: int) -> Velocity | None:
        """The speed at a moment; ``None`` when it is time for zero.

        Never faster than at the beginning, whatever the clock says.
        """
        if now >= self.until:
            return None
        return self.velocity.times(min(1.0, (self.until - now) / (self.until - self.since)))


def ramp(velocity: Velocity, now: int, length: int, latest: int) -> Ramp | None:
    """A ramp that begins now, ``None`` where there is no time for one.

    :param length: nanoseconds it takes where there is time
    :param latest: moment by which zero must be said
    """
    until = min(now + length, latest)
    return Ramp(velocity, now, until) if until - now > STEP and velocity.moves else None
