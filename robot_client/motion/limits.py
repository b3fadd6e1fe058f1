"""Speed and acceleration limits by level: the stricter of those for the robot and those for the level."""

from __future__ import annotations

from collections.abc import Mapping

from relay_protocol.link.motion import Limits
from robot_client.config import RobotSettings

NO_LIMITS = Limits()

LEVELS = frozenset({"operator", "owner"})
"""Levels that may move a robot."""


def limits_by_level(settings: RobotSettings) -> dict[str, Limits]:
    """The settings' limits by level; levels without limits are left out."""
    own = settings.limits
    levels = {
        "operator": stricter(own.reported, own.operator.reported),
        "owner": stricter(own.reported, own.owner.reported),
    }
    return {level: limits for level, limits in levels.items() if limits != NO_LIMITS}


def stricter(one: Limits, other: Limits) -> Limits:
    """Take the lower of each limit; ``None`` is no limit."""
    return Limits(
        linear=_lower_of(one.linear, other.linear),
        angular=_lower_of(one.angular, other.angular),
        linear_acceleration=_lower_of(one.linear_acceleration, other.linear_acceleration),
        angular_acceleration=_lower_of(one.angular_acceleration, other.angular_acceleration),
    )


def limits_of(by_level: Mapping[str, Limits], level: str) -> Limits:
    """The limits of a level; for an unknown level, the strictest of all levels.

    :param by_level: as :func:`limits_by_level` returns them
    """
    if level in LEVELS:
        return by_level.get(level, NO_LIMITS)
    strictest = NO_LIMITS
    for limits in by_level.values():
        strictest = stricter(strictest, limits)
    return strictest


def _lower_of(one: float | None, other: float | None) -> float | None:
    if one is None or other is None:
        return other if one is None else one
    return min(one, other)
