"""Linear ramps to a standstill."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.motion.ramp import STEP, ramp
from robot_client.motion.velocity import STILL, Velocity

MS = 1_000_000
AHEAD = Velocity((1.0, 0.0, 0.0), (0.0, 0.0, -2.0))


def test_speed_falls_linearly_to_zero() -> None:
    way = ramp(AHEAD, 0, 200 * MS, 1000 * MS)
    assert way is not None
    assert way.at(0) == AHEAD
    assert way.at(100 * MS) == AHEAD.times(0.5)
    assert way.at(200 * MS) is None
    assert way.at(9999 * MS) is None


def test_ramp_is_steeper_when_less_time_is_left() -> None:
    way = ramp(AHEAD, 0, 200 * MS, 100 * MS)
    assert way is not None
    assert way.at(50 * MS) == AHEAD.times(0.5)
    assert way.at(100 * MS) is None


@pytest.mark.parametrize(
    ("velocity", "length", "latest"), [(AHEAD, 0, 99 * MS), (AHEAD, MS, 0), (STILL, MS, MS)]
)
def test_no_ramp_without_time_or_speed(velocity: Velocity, length: int, latest: int) -> None:
    assert ramp(velocity, 0, length, latest) is None


@given(st.integers(0, 10**9), st.integers(-(10**9), 10**9), st.integers(-(10**9), 3 * 10**9))
def test_ramp_is_never_faster_and_never_late(length: int, latest: int, at: int) -> None:
    """Also when the clock jumps."""
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
