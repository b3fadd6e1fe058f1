"""Whether a command is zero (docs/explain/safety.md, "Zero, by type").

The robot judges the CDR it gets by itself (``robot_client.platforms.ros2.command_classifier``).
"""

from __future__ import annotations

from typing import Any

from relay_protocol import jsontext
from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import KIB

STILL_BYTES = 64 * KIB
"""Most bytes of a command that is examined; a longer one counts as one that moves."""

_TRAJECTORIES = frozenset(
    {"trajectory_msgs/msg/JointTrajectory", "trajectory_msgs/msg/MultiDOFJointTrajectory"}
)
_NOT_MOTION = {"control_msgs/msg/JointJog": ("header", "joint_names", "duration")}
"""Fields that move nothing, by type."""


def is_zero_command(type_name: str, body: bytes) -> bool:
    """Whether a command is zero. A command that can't be decoded counts as one that moves.

    :param type_name: full name
    :param body: JSON
    """
    if len(body) > STILL_BYTES:
        return False
    try:
        message = jsontext.decode_any(body)
    except SwitchboardError:
        return False
    if not isinstance(message, dict):
        return False
    if type_name in _TRAJECTORIES:  # A goal of all zeros is a goal as well.
        return not message.get("points")
    not_motion = _NOT_MOTION.get(type_name, ("header",))
    return all(_is_all_zero(value) for field, value in message.items() if field not in not_motion)


def _is_all_zero(value: Any) -> bool:
    """Whether all numbers in a value are 0. Text may be bytes in base64, and ``null`` is no number."""
    if isinstance(value, dict):
        return all(_is_all_zero(each) for field, each in value.items() if field != "header")
    if isinstance(value, list):
        return all(map(_is_all_zero, value))
    return value is not None and not value
