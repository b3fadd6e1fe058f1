"""A base stands still without fresh commands, and while the robot is stopped. No ROS."""

from __future__ import annotations

import math

import pytest

from robot_client.devices import Odometry
from robot_client.devices.ros_node import CommandWatch


class Base:
    def __init__(self) -> None:
        self.driven: list[tuple[float, float]] = []

    def drive(self, speed: float, turn: float) -> None:
        self.driven.append((speed, turn))

    def odometry(self) -> Odometry:
        return Odometry()


class Watched:
    def __init__(self) -> None:
        self.base = Base()
        self.now = 100.0
        self.watch = CommandWatch(self.base, 0.5, lambda: self.now)

    def after(self, seconds: float) -> list[tuple[float, float]]:
        self.now += seconds
        self.base.driven.clear()
        self.watch.check()
        return self.base.driven


@pytest.fixture
def watched() -> Watched:
    made = Watched()
    made.watch.hold(False)
    made.watch.command(0.3, 0.1)
    assert made.base.driven == [(0.3, 0.1)]
    return made


def test_old_command_stops_the_base(watched: Watched) -> None:
    assert watched.after(0.49) == []
    assert watched.after(0.01) == [(0.0, 0.0)]


@pytest.mark.parametrize("by", ["age", "hold", "zero"])
def test_standing_still_is_repeated_for_a_base_that_missed_it(watched: Watched, by: str) -> None:
    if by == "age":
        watched.after(0.5)
    elif by == "hold":
        watched.watch.hold(True)
    else:
        watched.watch.command(0.0, 0.0)
    for _ in range(3):
        assert watched.after(0.49) == []
        assert watched.after(0.01) == [(0.0, 0.0)]


def test_base_that_was_never_commanded_is_stopped() -> None:
    assert Watched().after(0.0) == [(0.0, 0.0)]


def test_fresh_command_is_good_again(watched: Watched) -> None:
    watched.after(0.4)
    watched.watch.command(0.2, 0.0)
    assert watched.after(0.4) == []
    assert watched.after(0.1) == [(0.0, 0.0)]


def test_stopped_robot_takes_no_command(watched: Watched) -> None:
    watched.base.driven.clear()
    watched.watch.hold(True)
    watched.watch.command(0.3, 0.0)
    assert set(watched.base.driven) == {(0.0, 0.0)}
    watched.watch.hold(False)
    assert watched.after(1.0) == [(0.0, 0.0)]


def test_robot_counts_as_stopped_at_first() -> None:
    made = Watched()
    made.watch.command(0.3, 0.0)
    assert made.base.driven == [(0.0, 0.0)]


@pytest.mark.parametrize("command", [(math.nan, 0.0), (0.1, math.inf)])
def test_command_that_is_no_number_stops_the_base(watched: Watched, command: tuple[float, float]) -> None:
    watched.base.driven.clear()
    watched.watch.command(command[0], command[1])
    assert watched.base.driven == [(0.0, 0.0)]
    assert watched.after(1.0) == [(0.0, 0.0)]


@pytest.mark.parametrize("limit", [0.0, -1.0, math.nan])
def test_limit_must_be_positive(limit: float) -> None:
    with pytest.raises(ValueError, match="command_limit"):
        CommandWatch(Base(), limit, lambda: 0.0)
