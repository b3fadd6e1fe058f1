"""Slows commands to the limits of speed and acceleration of their level, and never speeds them up. No I/O.

Linear and angular speed are limited separately, each by its length, so that the direction stays. Acceleration is
measured from the last command on the topic, along the direction of the new one: its speed may grow by the allowed
acceleration times the time since. Slowing down is never limited. Where limits hold, commands whose speed can't be read
are refused.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import NamedTuple

from relay_protocol.link.motion import Limits
from robot_client.motion.limits import LEVELS, NO_LIMITS, limits_of
from robot_client.motion.typed_topic import TypedTopic
from robot_client.motion.velocity import STILL, Vector, Velocity, VelocityAccess, scaled, velocity_access

NANO = 1_000_000_000
LONGEST = NANO // 10
"""Most nanoseconds counted between two commands, so that the first after a pause can't start at full speed."""

REMEDY = "drive by Twist or TwistStamped, or have the topic listed in 'unlimited' of the robot's [limits]"


def unreadable(topic: TypedTopic) -> str:
    """Error message for a topic whose commands have no speed that can be read."""
    return (
        f"speed is limited, and how fast {topic.type} on {topic.name} moves the robot can't be read: {REMEDY}"
    )


class _LastCommand(NamedTuple):
    velocity: Velocity
    at: int


class SpeedLimiter:
    """Limits commands by level.

    :param limits_by_level: limits by level, as :func:`robot_client.motion.limits.limits_by_level` gives them
    :param encoding: of the commands, ``cdr`` or ``json``
    :param unlimited: shell patterns of topics on which commands pass although their speed can't be read
    """

    def __init__(
        self, limits_by_level: Mapping[str, Limits], encoding: str, unlimited: Sequence[str] = ()
    ) -> None:
        self.limited = 0
        """How many commands were slowed so far."""
        self._limits_by_level = dict(limits_by_level)
        self._encoding = encoding
        self._unlimited = tuple(unlimited)
        self._last_commands: dict[TypedTopic, _LastCommand] = {}
        self._cached_limits: dict[str, Limits | None] = {}

    def allows(self, topic: TypedTopic, level: str) -> bool:
        """Whether commands of a level on a topic may pass.

        They may where the level has no limits, their speed can be read, or the topic is exempt.

        :param level: as of :meth:`limit`
        """
        return (
            self._velocity_access(topic) is not None or self._limits_for(level) is None or self._exempt(topic)
        )

    def refuses_every_level(self, topic: TypedTopic) -> bool:
        """Whether no level may command a topic, see :meth:`allows`."""
        return not any(self.allows(topic, level) for level in LEVELS)

    def limit(self, topic: TypedTopic, body: bytes, level: str, now: int) -> bytes | None:
        """Slow a command to the limits.

        :param body: the command, of finite numbers
        :param level: of its sender; for an unknown level the strictest limits hold
        :param now: monotonic nanoseconds
        :returns: the command, unchanged where it is slow enough; ``None``: its speed can't be read, so refuse it
        """
        limits = self._limits_for(level)
        if limits is None:
            return body
        access = self._velocity_access(topic)
        if access is None:
            return body if self._exempt(topic) else None
        requested = access.read(body)
        if requested is None or not requested.finite:
            return None
        last, seconds = self._last_velocity(topic, now)
        allowed = Velocity(
            _clamp(requested.linear, last.linear, limits.linear, limits.linear_acceleration, seconds),
            _clamp(requested.angular, last.angular, limits.angular, limits.angular_acceleration, seconds),
        )
        self._last_commands[topic] = _LastCommand(allowed, now)
        if allowed == requested:
            return body
        self.limited += 1
        return access.write(body, allowed)

    def zero_published(self, topic: TypedTopic, now: int) -> None:
        """Note that zero was published on a topic: acceleration counts from there."""
        self.slowed(topic, STILL, now)

    def slowed(self, topic: TypedTopic, velocity: Velocity, now: int) -> None:
        """Note the speed that a ramp published on a topic: acceleration counts from there."""
        if topic in self._last_commands:
            self._last_commands[topic] = _LastCommand(velocity, now)

    def forget(self, topic: TypedTopic) -> None:
        """Forget a topic that is no longer commanded."""
        self._last_commands.pop(topic, None)

    def _last_velocity(self, topic: TypedTopic, now: int) -> tuple[Velocity, float]:
        last = self._last_commands.get(topic)
        if last is None:
            return STILL, LONGEST / NANO
        return last.velocity, min(max(now - last.at, 0), LONGEST) / NANO

    def _velocity_access(self, topic: TypedTopic) -> VelocityAccess | None:
        return velocity_access(topic.type, self._encoding)

    def _exempt(self, topic: TypedTopic) -> bool:
        return any(fnmatchcase(topic.name, pattern) for pattern in self._unlimited)

    def _limits_for(self, level: str) -> Limits | None:
        if not self._limits_by_level:
            return None
        if level not in self._cached_limits:
            limits = limits_of(self._limits_by_level, level)
            self._cached_limits = {
                level: None if limits == NO_LIMITS else limits
            }  # one entry only, as the relay chooses the names of levels
        return self._cached_limits[level]


def _clamp(
    requested: Vector, last: Vector, most: float | None, acceleration: float | None, seconds: float
) -> Vector:
    length = math.hypot(*requested)
    allowed = length if most is None else min(length, most)
    if acceleration is not None and length:
        along = sum(a * b for a, b in zip(requested, last, strict=True)) / length
        allowed = min(allowed, max(0.0, along) + acceleration * seconds)
    return requested if allowed >= length else scaled(requested, allowed / length)
