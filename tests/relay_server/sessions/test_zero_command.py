"""Commands that count as zero."""

from __future__ import annotations

import json
from typing import Any

import pytest

from relay_server.sessions.zero_command import STILL_BYTES, is_zero_command

TWIST = "geometry_msgs/msg/Twist"
STAMPED = "geometry_msgs/msg/TwistStamped"
JOY = "sensor_msgs/msg/Joy"
JOG = "control_msgs/msg/JointJog"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
MULTI_DOF = "trajectory_msgs/msg/MultiDOFJointTrajectory"
HEADER = {"stamp": {"sec": 7}, "frame_id": "base"}


@pytest.mark.parametrize(
    ("type_name", "message", "still"),
    [
        (TWIST, {}, True),
        (TWIST, {"linear": {"x": 0.0, "y": -0.0}, "angular": {"z": 0}}, True),
        (TWIST, {"linear": {"x": 0.0}, "angular": {"z": 0.01}}, False),
        (TWIST, {"linear": {"x": None}}, False),
        (TWIST, 0, False),
        (STAMPED, {"header": HEADER, "twist": {"linear": {"x": 0}}}, True),
        (STAMPED, {"header": HEADER, "twist": {"linear": {"x": 1}}}, False),
        (JOY, {"header": HEADER, "axes": [0.0, 0.0], "buttons": [0]}, True),
        (JOY, {"header": HEADER, "axes": [0.0, 0.0], "buttons": [1]}, False),
        (JOG, {"joint_names": ["a"], "velocities": [0.0], "duration": 0.1}, True),
        (JOG, {"joint_names": ["a"], "displacements": [0.1]}, False),
        (TRAJECTORY, {"header": HEADER, "joint_names": ["a"]}, True),
        (TRAJECTORY, {"joint_names": ["a"], "points": [{"positions": [0.0]}]}, False),
        (MULTI_DOF, {"header": HEADER, "joint_names": ["a"], "points": []}, True),
        (MULTI_DOF, {"joint_names": ["a"], "points": [{"transforms": []}]}, False),
        ("some_msgs/msg/Motor", {"level": 0, "on": False}, True),
        ("some_msgs/msg/Motor", {"level": 0, "on": True}, False),
        ("some_msgs/msg/Motor", {"bytes": "AQ=="}, False),
    ],
)
def test_zero_goes_by_the_type(type_name: str, message: Any, still: bool) -> None:
    """As the robot decides it; commands that cannot be decoded count as moving."""
    assert is_zero_command(type_name, json.dumps(message).encode()) is still


def test_long_or_invalid_command_counts_as_moving() -> None:
    """It is not decoded, or cannot be."""
    assert not is_zero_command(TWIST, b'{"linear":' + b" " * STILL_BYTES + b"{}}")
    assert not is_zero_command(TWIST, b"{")
