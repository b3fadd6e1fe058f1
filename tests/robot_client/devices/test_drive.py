"""Differential drive: both directions agree, arcs are exact, counters may begin again."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.devices import DifferentialDrive, MobileRobot, WheelSpeeds

sizes = st.floats(0.01, 2.0)
speeds = st.floats(-5.0, 5.0)
counts = st.integers(-(2**40), 2**40)
steps = st.tuples(st.integers(-5000, 5000), st.integers(-5000, 5000))
TICKS = 1000


def drive(bits: int = 32) -> DifferentialDrive:
    """Wheels of 1 m around: a tick is a millimetre. They are 0.5 m apart."""
    return DifferentialDrive(1 / math.tau, 0.5, TICKS, bits)


@given(sizes, sizes, speeds, speeds)
def test_wheel_speeds_and_velocity_undo_each_other(
    radius: float, gap: float, speed: float, turn: float
) -> None:
    made = DifferentialDrive(radius, gap, TICKS)
    assert made.velocity(made.wheel_speeds(speed, turn)) == pytest.approx((speed, turn), abs=1e-9)


@pytest.mark.parametrize(
    ("left", "right", "pose"),
    [
        (1000, 1000, (1.0, 0.0, 0.0)),
        (-1000, -1000, (-1.0, 0.0, 0.0)),
        # A quarter turn on the spot: a quarter of the circle between the wheels.
        (-round(125 * math.pi), round(125 * math.pi), (0.0, 0.0, math.pi / 2)),
        # Around the left wheel by half a turn: from its right to its left.
        (0, int(500 * math.pi), (0.0, 0.5, math.pi)),
    ],
)
def test_arcs(left: int, right: int, pose: tuple[float, float, float]) -> None:
    made = drive()
    made.update(0, 0, 0.0)
    assert made.update(left, right, 2.0)[:3] == pytest.approx(pose, abs=0.002)


def test_velocity_is_that_of_the_time_between_updates() -> None:
    made = drive()
    made.update(0, 0, 10.0)
    assert made.update(900, 1100, 12.0)[3:] == pytest.approx((0.5, 0.2))
    assert made.update(900, 1100, 12.0)[3:] == (0.0, 0.0)


@given(st.lists(steps, min_size=1, max_size=20), counts, counts, st.sampled_from([16, 32]))
def test_counters_may_begin_again(moves: list[tuple[int, int]], left: int, right: int, bits: int) -> None:
    """Of any size, signed or not, from any value."""
    plain, wrapped = drive(), drive(bits)
    size, total = 2**bits, [0, 0]
    plain.update(0, 0, 0.0)
    wrapped.update(left % size, right % size, 0.0)
    for at, (more_left, more_right) in enumerate(moves, 1):
        total = [total[0] + more_left, total[1] + more_right]
        found = wrapped.update((left + total[0]) % size, (right + total[1]) % size - size, float(at))
        assert found == pytest.approx(plain.update(total[0], total[1], float(at)), abs=1e-6)


@given(st.integers(-20_000, 20_000), st.integers(-20_000, 20_000), st.integers(2, 50))
def test_arc_is_the_same_in_any_number_of_parts(left: int, right: int, parts: int) -> None:
    whole, cut = drive(), drive()
    whole.update(0, 0, 0.0)
    cut.update(0, 0, 0.0)
    for part in range(1, parts + 1):
        found = cut.update(left * part, right * part, float(part))
    expected = whole.update(left * parts, right * parts, 1.0)
    assert found[:2] == pytest.approx(expected[:2], abs=1e-6)
    assert math.remainder(found.heading - expected.heading, math.tau) == pytest.approx(0.0, abs=1e-6)


@given(st.lists(steps, min_size=1, max_size=10))
def test_the_way_back_ends_at_the_start(moves: list[tuple[int, int]]) -> None:
    made = drive()
    made.update(0, 0, 0.0)
    left = right = 0
    for each in (*moves, *((-left, -right) for left, right in reversed(moves))):
        left, right = left + each[0], right + each[1]
        found = made.update(left, right, 1.0)
    assert (found.x, found.y) == pytest.approx((0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("sizes", [(0, 1, 1), (1, -1, 1), (1, 1, math.nan), (math.inf, 1, 1)])
def test_sizes_must_be_positive(sizes: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="is not a positive number"):
        DifferentialDrive(sizes[0], sizes[1], sizes[2])


def test_units() -> None:
    assert DifferentialDrive(0.1, 0.4, 100).wheel_speeds(1.0, 1.0) == pytest.approx(WheelSpeeds(8.0, 12.0))


def test_a_base_without_odometry_is_an_error_at_once() -> None:
    class Incomplete(MobileRobot):
        def drive(self, speed: float, turn: float) -> None:
            pass

    with pytest.raises(TypeError, match="odometry"):
        Incomplete()  # type: ignore[abstract]
