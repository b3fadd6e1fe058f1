"""Classifies ROS 2 messages by whether they move the robot, and makes the zero command of the same shape.

Any value other than zero moves the robot, headers excepted. Types with other rules are named here.
"""

from __future__ import annotations

import math
from typing import Any

from robot_client.platforms.base import CommandEffect

HEADER = "std_msgs/Header"

JOY = "sensor_msgs/msg/Joy"
TRAJECTORIES = frozenset(
    {"trajectory_msgs/msg/JointTrajectory", "trajectory_msgs/msg/MultiDOFJointTrajectory"}
)
JOG = "control_msgs/msg/JointJog"

TYPES_WITH_TEMPLATE = TRAJECTORIES | {JOY, JOG}
"""Types whose zero command depends on the command before: on its joints or number of axes."""


def classify(type: str, message: Any) -> CommandEffect:
    """Whether a command moves the robot.

    :param type: full name of its type
    """
    effect = _classify_message(message)
    if effect is CommandEffect.INVALID:
        return effect
    if type in TRAJECTORIES:  # a trajectory to zero positions moves too
        return CommandEffect.MOVING if message.points else CommandEffect.STILL
    if type == JOG:  # its duration does not move anything
        return (
            CommandEffect.MOVING
            if any(message.displacements) or any(message.velocities)
            else CommandEffect.STILL
        )
    return effect


def zero_like(type: str, message: Any, zero: Any) -> Any:
    """The zero command of the same shape, for the types of :data:`TYPES_WITH_TEMPLATE`.

    A joystick has as many axes and buttons, a jog the same joints at zero velocity, a trajectory the same
    joints and no points.

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


def _classify_message(value: Any) -> CommandEffect:
    """The most severe effect of all values in a message, headers excepted."""
    effect = CommandEffect.STILL
    for field, type in value.get_fields_and_field_types().items():
        if type == HEADER:
            continue
        inner = _classify_value(getattr(value, field))
        if inner is CommandEffect.INVALID:
            return inner
        if inner is CommandEffect.MOVING:
            effect = inner
    return effect


def _classify_value(value: Any) -> CommandEffect:
    if isinstance(value, (bool, int, float)):
        if not math.isfinite(value):
            return CommandEffect.INVALID
        return CommandEffect.MOVING if value else CommandEffect.STILL
    if hasattr(value, "get_fields_and_field_types"):
        return _classify_message(value)
    if isinstance(value, (str, bytes)):
        return CommandEffect.STILL
    if hasattr(value, "tolist"):
        return _classify_numbers(value.tolist())
    effects = {_classify_value(each) for each in value}
    for worst in (CommandEffect.INVALID, CommandEffect.MOVING):
        if worst in effects:
            return worst
    return CommandEffect.STILL


def _classify_numbers(numbers: list[Any]) -> CommandEffect:
    """The same for arrays, which may have a hundred thousand elements."""
    if not all(map(math.isfinite, numbers)):
        return CommandEffect.INVALID
    return CommandEffect.MOVING if any(numbers) else CommandEffect.STILL
