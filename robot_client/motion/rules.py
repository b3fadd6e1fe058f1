"""What holds for commands and stops beside the policy that the relay is told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from relay_protocol.link.motion import Limits
from robot_client.config import RobotSettings
from robot_client.motion.limits import limits_told
from robot_client.motion.safety import Times


class MotionRules(NamedTuple):
    """Of one robot.

    :ivar topics: times of single topics
    :ivar ramp_ms: how long it takes to a standstill where nobody said stop; 0: no time
    :ivar limits: how fast whom may move it, by level
    :ivar unlimited: patterns of topics on which commands pass whose speeds can't be read
    """

    topics: Mapping[str, Times] = {}
    ramp_ms: int = 0
    limits: Mapping[str, Limits] = {}
    unlimited: Sequence[str] = ()


def rules_of(settings: RobotSettings) -> MotionRules:
    """As the settings have them."""
    safety = settings.safety
    return MotionRules(
        {each.name: safety.times(each.name) for each in safety.topic},
        safety.ramp_ms,
        limits_told(settings),
        settings.limits.unlimited,
    )
