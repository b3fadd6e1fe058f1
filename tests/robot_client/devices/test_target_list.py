"""Lists of targets, without ROS."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.devices.target_list import (
    ABORTED,
    CANCELED,
    SUCCEEDED,
    DriveTarget,
    TargetList,
    parse_targets,
)

KITCHEN, HALL = DriveTarget(1.0, 2.0, 0.5, "kitchen"), DriveTarget(3.0, 4.0, 0.0, "hall")


class Robot:
    def __init__(self) -> None:
        self.driven: list[DriveTarget] = []
        self.cancelled: list[bytes] = []
        self.reports: list[dict[str, Any]] = []
        self.list = TargetList(
            lambda goal, target: self.driven.append(target), self.cancelled.append, self.reports.append
        )

    @property
    def goal(self) -> bytes:
        assert self.list.goal is not None
        return self.list.goal


@pytest.fixture
def robot() -> Robot:
    made = Robot()
    made.list.begin([KITCHEN, HALL], sender=1)
    return made


def test_targets_are_driven_one_after_another(robot: Robot) -> None:
    assert robot.driven == [KITCHEN]
    first = robot.goal
    robot.list.goal_ended(first, SUCCEEDED)
    assert robot.driven == [KITCHEN, HALL]
    # The end of a goal counts once.
    robot.list.goal_ended(first, SUCCEEDED)
    robot.list.goal_ended(robot.goal, SUCCEEDED)
    assert [(each["state"], each.get("target")) for each in robot.reports] == [
        ("driving", "kitchen"),
        ("arrived", "kitchen"),
        ("driving", "hall"),
        ("arrived", "hall"),
        ("done", None),
    ]
    assert robot.list.goal is None and robot.cancelled == []


@pytest.mark.parametrize(
    ("status", "why"),
    [(CANCELED, "it was cancelled"), (ABORTED, "the navigator gave up"), (0, "its goal ended with status 0")],
)
def test_target_that_is_not_reached_ends_the_list(robot: Robot, status: int, why: str) -> None:
    robot.list.goal_ended(robot.goal, status)
    assert robot.reports[-1] == {"state": "ended", "target": "kitchen", "number": 1, "of": 2, "why": why}
    assert robot.driven == [KITCHEN]


def test_end_by_a_client_cancels_the_goal(robot: Robot) -> None:
    goal = robot.goal
    robot.list.sender_left(2)
    assert robot.cancelled == []
    robot.list.sender_left(1)
    assert robot.cancelled == [goal]
    assert robot.reports[-1]["why"] == "its client has disconnected"
    # Later events of the goal do not count.
    robot.list.goal_ended(goal, SUCCEEDED)
    assert robot.driven == [KITCHEN]
    robot.list.begin([HALL], sender=2)
    assert robot.driven == [KITCHEN, HALL]


def test_second_list_is_refused_meanwhile(robot: Robot) -> None:
    with pytest.raises(ValueError, match=r"send .* first"):
        robot.list.begin([HALL], sender=2)
    robot.list.refused(robot.goal, "the navigator has refused it")
    assert robot.reports[-1]["why"] == "the navigator has refused it"
    robot.list.begin([HALL], sender=2)


@pytest.mark.parametrize(
    ("targets", "text"),
    [
        (None, "go needs a list"),
        ([], "go needs a list"),
        ([{"x": 0, "y": 0}] * 101, "go needs a list"),
        ([{"x": 0}], "target 1 needs x and y"),
        ([{"x": 0, "y": 0}, {"x": 0, "y": 0, "z": 1}], "target 2 needs x and y"),
        ([{"x": "0", "y": 0}], "must be numbers"),
        ([{"x": True, "y": 0}], "must be numbers"),
        ([{"x": float("inf"), "y": 0}], "must be finite"),
        ([{"x": 10**400, "y": 0}], "must be finite"),
        ([{"x": 0, "y": 0, "name": ""}], "printable"),
        ([{"x": 0, "y": 0, "name": "a\x1b[2J"}], "printable"),
        ([{"x": 0, "y": 0, "name": "x" * 61}], "printable"),
    ],
)
def test_wrong_targets_are_named(targets: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        parse_targets(targets)


json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["x", "y", "heading", "name", "z"]), inner)
    ),
    max_leaves=8,
)


@given(json)
def test_any_json_is_targets_or_an_error(value: Any) -> None:
    try:
        found = parse_targets(value)
    except ValueError:
        return
    assert all(isinstance(each, DriveTarget) for each in found)


def test_targets_without_a_name_are_numbered() -> None:
    assert parse_targets([{"x": 1, "y": 2}, {"x": 3, "y": 4, "heading": 0.5, "name": "hall"}]) == [
        DriveTarget(1.0, 2.0, 0.0, "target 1"),
        DriveTarget(3.0, 4.0, 0.5, "hall"),
    ]
