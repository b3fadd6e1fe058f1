"""Rules for commands and stops that are not part of the policy sent to the relay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from relay_protocol.link.motion import Limits
from robot_client.config import RobotSettings
from robot_client.motion.limits import limits_by_level
from robot_client.motion.watchdog import CommandTimes


class MotionRules(NamedTuple):
    """The rules of one robot.

    :ivar topics: times of single topics, by name
    :ivar ramp_ms: length of the ramp to a standstill when commands end without a stop, milliseconds; 0: no ramp
    :ivar limits: speed and acceleration limits by level
    :ivar unlimited: shell patterns of topics on which commands pass although their speed can't be read
    """

    topics: Mapping[str, CommandTimes] = {}
    ramp_ms: int = 0
    limits: Mapping[str, Limits] = {}
    unlimited: Sequence[str] = ()


def rules_of(settings: RobotSettings) -> MotionRules:
    """Build the rules from the settings."""
    safety = settings.safety
    return MotionRules(
        {each.name: safety.times(each.name) for each in safety.topic},
        safety.ramp_ms,
        limits_by_level(settings),
        settings.limits.unlimited,
    )
