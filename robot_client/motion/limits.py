"""How fast whom may move the robot: the stricter of what holds for the robot and what holds for his level."""

from __future__ import annotations

from collections.abc import Mapping

from relay_protocol.link.motion import Limits
from robot_client.config import RobotSettings

NONE = Limits()
"""Nothing is limited."""

LEVELS = frozenset({"operator", "owner"})
"""Those that may move a robot."""


def limits_told(settings: RobotSettings) -> dict[str, Limits]:
    """What ``safety.limits`` says: by level, those that are limited."""
    own = settings.limits
    levels = {
        "operator": stricter(own.whole, own.operator.whole),
        "owner": stricter(own.whole, own.owner.whole),
    }
    return {level: limits for level, limits in levels.items() if limits != NONE}


def stricter(one: Limits, other: Limits) -> Limits:
    """Of each limit the lower one."""
    return Limits(
        linear=_lower(one.linear, other.linear),
        angular=_lower(one.angular, other.angular),
        linear_acceleration=_lower(one.linear_acceleration, other.linear_acceleration),
        angular_acceleration=_lower(one.angular_acceleration, other.angular_acceleration),
    )


def limits_of(told: Mapping[str, Limits], level: str) -> Limits:
    """What holds for a level; for one that is not known, the strictest of all."""
    if level in LEVELS:
        return told.get(level, NONE)
    strictest = NONE
    for limits in told.values():
        strictest = stricter(strictest, limits)
    return strictest


def _lower(one: float | None, other: float | None) -> float | None:
    if one is None or other is None:
        return other if one is None else one
    return min(one, other)
