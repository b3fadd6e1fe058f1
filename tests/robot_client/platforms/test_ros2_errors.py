"""Words of errors that reach people who did not build ROS."""

from __future__ import annotations

import pytest

from relay_protocol.errors import Invalid, NotFound
from robot_client.platforms.ros2.errors import in_words, refusals


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


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (
            RuntimeError("wrong type, at /project/src/a.c:1"),
            Invalid("ROS 2 refuses the service /a: wrong type"),
        ),
        (NotFound("there is no /a"), NotFound("there is no /a")),
    ],
)
def test_refusals_are_told_in_words(error: Exception, told: Exception) -> None:
    """What ROS 2 throws becomes a sentence about what was tried; what is one already stays."""
    with pytest.raises(type(told)) as caught, refusals("the service /a"):
        raise error
    assert str(caught.value) == str(told)
