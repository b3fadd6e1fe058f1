"""What messages do to a robot. Of control_msgs only some robots have the types: a double stands for JointJog."""

from __future__ import annotations

import math
from array import array
from types import SimpleNamespace

import pytest

from robot_client.platforms.base import Motion
from robot_client.platforms.ros2.motion import JOG, judge, rest


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
        ([], [], 0.0, Motion.STILL),
        ([], [0.0, 0.0], 0.5, Motion.STILL),
        ([], [0.0, -0.1], 0.0, Motion.MOVING),
        ([0.1], [], 0.0, Motion.MOVING),
        ([], [math.nan], 0.0, Motion.INVALID),
        ([], [], math.inf, Motion.INVALID),
    ],
)
def test_a_jog_moves_by_what_its_joints_do(
    displacements: list[float], velocities: list[float], duration: float, motion: Motion
) -> None:
    """A duration alone moves nothing, but must be a number."""
    jog = Jog()
    jog.displacements, jog.velocities, jog.duration = (
        array("d", displacements),
        array("d", velocities),
        duration,
    )
    assert judge(JOG, jog) is motion


def test_a_jog_rests_with_the_same_joints() -> None:
    """Each at no speed, with nowhere to go."""
    jog, zero = Jog(), Jog()
    jog.velocities, jog.duration, zero.joint_names = array("d", [1.0, 2.0]), 3.0, []
    made = rest(JOG, jog, zero)
    assert made.joint_names == ["a", "b"]
    assert list(made.velocities) == [0.0, 0.0]
    assert list(made.displacements) == []
    assert made.duration == 0.0
    assert judge(JOG, made) is Motion.STILL
