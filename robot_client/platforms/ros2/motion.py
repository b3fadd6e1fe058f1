"""What ROS 2 messages do to a robot: move it, let it stand, or make no sense. And what lets it stand.

Whatever is not zero moves, headers left out. Of some types that would be wrong, and they are named here.
"""

from __future__ import annotations

import math
from typing import Any

from robot_client.platforms.base import Motion

HEADER = "std_msgs/Header"

JOY = "sensor_msgs/msg/Joy"
TRAJECTORIES = frozenset(
    {"trajectory_msgs/msg/JointTrajectory", "trajectory_msgs/msg/MultiDOFJointTrajectory"}
)
JOG = "control_msgs/msg/JointJog"

SHAPED = TRAJECTORIES | {JOY, JOG}
"""Types whose zero depends on the command before: on its joints, or how many axes it had."""


def judge(type: str, message: Any) -> Motion:
    """What a command would do.

    :param type: full name of its type
    """
    verdict = _judge(message)
    if verdict is Motion.INVALID:
        return verdict
    if type in TRAJECTORIES:  # to all zeros is a way as well
        return Motion.MOVING if message.points else Motion.STILL
    if type == JOG:  # its duration alone moves nothing
        return Motion.MOVING if any(message.displacements) or any(message.velocities) else Motion.STILL
    return verdict


def rest(type: str, message: Any, zero: Any) -> Any:
    """The command of the same shape that stands still, for the types of :data:`SHAPED`.

    A joystick has as many axes and buttons as before, a jog the same joints at no speed, a trajectory the same joints
    and no way to go.

    :param message: the command
    :param zero: an empty message of the type, which is filled
    """
    zero.header.frame_id = message.header.frame_id
    if type == JOY:
        zero.axes = [0.0] * len(message.axes)
        zero.buttons = [0] * len(message.buttons)
        return zero
    zero.joint_names = message.joint_names
    if type == JOG:
        zero.velocities = [0.0] * len(message.joint_names)
    return zero


def _judge(value: Any) -> Motion:
    """The worst of all numbers in a message, headers left out."""
    verdict = Motion.STILL
    for field, type in value.get_fields_and_field_types().items():
        if type == HEADER:
            continue
        inner = _judge_value(getattr(value, field))
        if inner is Motion.INVALID:
            return inner
        if inner is Motion.MOVING:
            verdict = inner
    return verdict


def _judge_value(value: Any) -> Motion:
    if isinstance(value, (bool, int, float)):
        if not math.isfinite(value):
            return Motion.INVALID
        return Motion.MOVING if value else Motion.STILL
    if hasattr(value, "get_fields_and_field_types"):
        return _judge(value)
    if isinstance(value, (str, bytes)):
        return Motion.STILL
    if hasattr(value, "tolist"):
        return _judge_numbers(value.tolist())
    verdicts = {_judge_value(each) for each in value}
    for worst in (Motion.INVALID, Motion.MOVING):
        if worst in verdicts:
            return worst
    return Motion.STILL


def _judge_numbers(numbers: list[Any]) -> Motion:
    """The same, for what may be a hundred thousand of them."""
    if not all(map(math.isfinite, numbers)):
        return Motion.INVALID
    return Motion.MOVING if any(numbers) else Motion.STILL
