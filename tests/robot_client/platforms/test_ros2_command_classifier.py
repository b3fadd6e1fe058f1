"""The effect of messages on a robot. Few robots have the types of control_msgs, so a double replaces JointJog."""

from __future__ import annotations

import math
from array import array
from types import SimpleNamespace

import pytest

from robot_client.platforms.base import CommandEffect
from robot_client.platforms.ros2.command_classifier import JOG, classify, zero_like


class Jog:
    def __init__(self) -> None:
        self.header = SimpleNamespace(frame_id="arm")
        self.joint_names = ["a", "b"]
        self.displacements = array("d")
        self.velocities = array("d")
        self.duration = 0.0

    def get_fields_and_field_types(self) -> dict[str, str]:
        return {
            "header": "std_msgs/Header",
            "joint_names": "sequence<string>",
            "displacements": "sequence<double>",
            "velocities": "sequence<double>",
            "duration": "double",
        }


@pytest.mark.parametrize(
    ("displacements", "velocities", "duration", "motion"),
    [
        ([], [], 0.0, CommandEffect.STILL),
        ([], [0.0, 0.0], 0.5, CommandEffect.STILL),
        ([], [0.0, -0.1], 0.0, CommandEffect.MOVING),
        ([0.1], [], 0.0, CommandEffect.MOVING),
        ([], [math.nan], 0.0, CommandEffect.INVALID),
        ([], [], math.inf, CommandEffect.INVALID),
    ],
)
def test_jog_moves_by_displacements_and_velocities(
    displacements: list[float], velocities: list[float], duration: float, motion: CommandEffect
) -> None:
    """Not by its duration."""
    jog = Jog()
    jog.displacements, jog.velocities, jog.duration = (
        array("d", displacements),
        array("d", velocities),
        duration,
    )
    assert classify(JOG, jog) is motion


def test_zero_of_a_jog_has_the_same_joints() -> None:
    jog, zero = Jog(), Jog()
    jog.velocities, jog.duration, zero.joint_names = array("d", [1.0, 2.0]), 3.0, []
    made = zero_like(JOG, jog, zero)
    assert made.joint_names == ["a", "b"]
    assert list(made.velocities) == [0.0, 0.0]
    assert list(made.displacements) == []
    assert made.duration == 0.0
    assert classify(JOG, made) is CommandEffect.STILL
