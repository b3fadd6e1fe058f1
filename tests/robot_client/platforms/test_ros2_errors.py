"""Words of errors that reach people who did not build ROS."""

from __future__ import annotations

import pytest

from robot_client.platforms.ros2_errors import in_words


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
def test_places_in_sources_are_left_out(said: str, left: str) -> None:
    """From the first path on it is of no use to who reads it."""
    assert in_words(RuntimeError(said)) == left
