"""Texts of errors for people who did not build ROS."""

from __future__ import annotations

import pytest

from relay_protocol.errors import Invalid, NotFound
from robot_client.platforms.ros2.errors import error_text, refusals


@pytest.mark.parametrize(
    ("said", "left"),
    [
        ("topic name is invalid, at /project/src/rcl/publisher.cpp:145", "topic name is invalid"),
        ("create() called: no such type, at ./src/a.c:9, at /ws/b.cpp:2", "create() called: no such type"),
        ("a is bad, at /x/a.c:1\nin another line, at /x/b.c:2", "a is bad"),
        ("no publisher looks at /scan", "no publisher looks at /scan"),
        ("arrives at noon, or not", "arrives at noon, or not"),
        ("", "RuntimeError"),
    ],
)
def test_source_locations_are_left_out(said: str, left: str) -> None:
    assert error_text(RuntimeError(said)) == left


@pytest.mark.parametrize(
    ("error", "reported"),
    [
        (
            RuntimeError("wrong type, at /project/src/a.c:1"),
            Invalid("ROS 2 refuses the service /a: wrong type"),
        ),
        (NotFound("there is no /a"), NotFound("there is no /a")),
    ],
)
def test_errors_of_ros_become_sentences(error: Exception, reported: Exception) -> None:
    with pytest.raises(type(reported)) as caught, refusals("the service /a"):
        raise error
    assert str(caught.value) == str(reported)
