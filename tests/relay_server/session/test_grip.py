"""Who commanded in vain and goes on must let go; what counts as that."""

from __future__ import annotations

import json
from typing import Any

import pytest

from relay_server.sessions.rearm import LET_GO_NS, STILL_BYTES, TOPICS, ReleaseTracker, is_zero_command

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
    """As the robot judges it; what can't be told counts as moving."""
    assert is_zero_command(type_name, json.dumps(message).encode()) is still


def test_what_is_long_or_no_json_counts_as_moving() -> None:
    """It is not looked at, or can't be."""
    assert not is_zero_command(TWIST, b'{"linear":' + b" " * STILL_BYTES + b"{}}")
    assert not is_zero_command(TWIST, b"{")


def test_silence_and_zero_are_letting_go() -> None:
    """On that topic; each command counts anew."""
    grips = ReleaseTracker()
    assert not grips.holds("/a", 0)
    grips.in_vain("/a", 0)
    grips.in_vain("/b", 0)
    assert grips.holds("/a", LET_GO_NS - 1)
    assert not grips.holds("/a", LET_GO_NS)
    grips.in_vain("/a", LET_GO_NS)
    assert grips.holds("/a", LET_GO_NS + 1)
    grips.let_go("/a")
    grips.let_go("/c")
    assert not grips.holds("/a", LET_GO_NS + 1)
    assert grips.holds("/b", 1)


def test_topics_that_are_remembered_are_bounded() -> None:
    """The longest quiet are forgotten first."""
    grips = ReleaseTracker()
    for number in range(TOPICS):
        grips.in_vain(f"/t{number}", 0)
    grips.in_vain("/t0", 0)
    grips.in_vain("/one/more", 0)
    assert [grips.holds(topic, 1) for topic in ("/t0", "/t1", "/one/more")] == [True, False, True]
