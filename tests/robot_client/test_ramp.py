"""A standstill that takes its time, and no longer."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.motion.ramp import STEP, ramp
from robot_client.motion.velocity import STILL, Velocity

MS = 1_000_000
AHEAD = Velocity((1.0, 0.0, 0.0), (0.0, 0.0, -2.0))


def test_speed_goes_down_evenly_to_zero() -> None:
    """Full at the beginning, half after half of the time, zero at its end."""
    way = ramp(AHEAD, 0, 200 * MS, 1000 * MS)
    assert way is not None
    assert way.at(0) == AHEAD
    assert way.at(100 * MS) == AHEAD.times(0.5)
    assert way.at(200 * MS) is None
    assert way.at(9999 * MS) is None


def test_what_must_be_over_earlier_is_steeper() -> None:
    """The latest moment counts before the length."""
    way = ramp(AHEAD, 0, 200 * MS, 100 * MS)
    assert way is not None
    assert way.at(50 * MS) == AHEAD.times(0.5)
    assert way.at(100 * MS) is None


@pytest.mark.parametrize(
    ("velocity", "length", "latest"), [(AHEAD, 0, 99 * MS), (AHEAD, MS, 0), (STILL, MS, MS)]
)
def test_without_time_or_speed_there_is_none(velocity: Velocity, length: int, latest: int) -> None:
    """Zero at once, then."""
    assert ramp(velocity, 0, length, latest) is None


@given(st.integers(0, 10**9), st.integers(-(10**9), 10**9), st.integers(-(10**9), 3 * 10**9))
def test_it_is_never_faster_and_never_late(length: int, latest: int, at: int) -> None:
    """Whatever the clock does."""
    way = ramp(AHEAD, 0, length, latest)
    if way is None:
        return
    assert STEP < way.until <= latest
    speed = way.at(at)
    if speed is None:
        assert at >= way.until
    else:
        assert at < way.until
        assert 0.0 < speed.linear[0] <= 1.0
