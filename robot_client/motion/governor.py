"""Commands made slower, never faster: speed and acceleration within the limits of who gives them. Pure.

Linear and angular speed are limited apart, each by its length, so that the direction stays. Acceleration is counted
from the last command on the topic: what goes on in the direction now asked for may grow by as much as the time since
allows. To slow down, in any direction, is never limited. What can't be read is not followed where there are limits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import NamedTuple

from relay_protocol.link.motion import Limits
from robot_client.motion.limits import LEVELS, NONE, limits_of
from robot_client.motion.typed_topic import TypedTopic
from robot_client.motion.velocity import STILL, Vector, Velocity, VelocityAccess, form, scaled

NANO = 1_000_000_000
LONGEST = NANO // 10
"""Most time that counts between two commands: after a pause nobody starts at full speed."""

REMEDY = "drive by Twist or TwistStamped, or have the topic listed in 'unlimited' of the robot's [limits]"


def unreadable(on: TypedTopic) -> str:
    """Why nobody may command a topic whose commands have no speeds to read."""
    return f"speed is limited, and how fast {on.type} on {on.topic} moves the robot can't be told: {REMEDY}"


class _Last(NamedTuple):
    velocity: Velocity
    at: int


class Governor:
    """Holds commands to the limits.

    :param told: limits by level, as :func:`robot_client.motion.limits.limits_told` gives them
    :param encoding: of the commands, ``cdr`` or ``json``
    :param unlimited: patterns of topics on which commands pass though their speeds can't be read
    """

    def __init__(self, told: Mapping[str, Limits], encoding: str, unlimited: Sequence[str] = ()) -> None:
        self.limited = 0
        """Commands made slower so far."""
        self._told = dict(told)
        self._encoding = encoding
        self._unlimited = tuple(unlimited)
        self._last: dict[TypedTopic, _Last] = {}
        self._of: dict[str, Limits | None] = {}

    def covers(self, on: TypedTopic, level: str) -> bool:
        """Whether a level's commands on a topic may be followed: it has no limits, or they can be held to them, or need
        not be.

        :param level: as of :meth:`tame`
        """
        return self._form(on) is not None or self._limits(level) is None or self._exempt(on)

    def closed(self, on: TypedTopic) -> bool:
        """Whether that is so for nobody."""
        return not any(self.covers(on, level) for level in LEVELS)

    def tame(self, on: TypedTopic, body: bytes, level: str, now: int) -> bytes | None:
        """The command as it may be followed: itself where it is slow enough.

        :param body: of finite numbers
        :param level: of whoever gave it; the strictest limits hold for one that is not known
        :param now: monotonic nanoseconds
        :returns: ``None`` where its speeds can't be found, so that it must not be followed
        """
        limits = self._limits(level)
        if limits is None:
            return body
        where = self._form(on)
        if where is None:
            return body if self._exempt(on) else None
        asked = where.read(body)
        if asked is None or not asked.finite:
            return None
        last, seconds = self._since(on, now)
        allowed = Velocity(
            _within(asked.linear, last.linear, limits.linear, limits.linear_acceleration, seconds),
            _within(asked.angular, last.angular, limits.angular, limits.angular_acceleration, seconds),
        )
        self._last[on] = _Last(allowed, now)
        if allowed == asked:
            return body
        self.limited += 1
        return where.write(body, allowed)

    def stood(self, on: TypedTopic, now: int) -> None:
        """Zero was said on a topic: who moves it next begins there."""
        self.slowed(on, STILL, now)

    def slowed(self, on: TypedTopic, velocity: Velocity, now: int) -> None:
        """A ramp has come down to a speed on a topic: who ends it goes on from there."""
        if on in self._last:
            self._last[on] = _Last(velocity, now)

    def forget(self, on: TypedTopic) -> None:
        """A topic is commanded no more."""
        self._last.pop(on, None)

    def _since(self, on: TypedTopic, now: int) -> tuple[Velocity, float]:
        last = self._last.get(on)
        if last is None:
            return STILL, LONGEST / NANO
        return last.velocity, min(max(now - last.at, 0), LONGEST) / NANO

    def _form(self, on: TypedTopic) -> VelocityAccess | None:
        return form(on.type, self._encoding)

    def _exempt(self, on: TypedTopic) -> bool:
        return any(fnmatchcase(on.topic, pattern) for pattern in self._unlimited)

    def _limits(self, level: str) -> Limits | None:
        if not self._told:
            return None
        if level not in self._of:
            limits = limits_of(self._told, level)
            self._of = {
                level: None if limits == NONE else limits
            }  # one at a time: levels come from the relay
        return self._of[level]


def _within(
    asked: Vector, last: Vector, most: float | None, acceleration: float | None, seconds: float
) -> Vector:
    length = math.hypot(*asked)
    allowed = length if most is None else min(length, most)
    if acceleration is not None and length:
        along = sum(a * b for a, b in zip(asked, last, strict=True)) / length
        allowed = min(allowed, max(0.0, along) + acceleration * seconds)
    return asked if allowed >= length else scaled(asked, allowed / length)
