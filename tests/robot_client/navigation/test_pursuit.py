"""Commands along a path, and of recoveries, in small maps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot_client.navigation.costmap import Costmap
from robot_client.navigation.grid import GridGeometry, Pose2D
from robot_client.navigation.pursuit import STANDSTILL, DriveCommand, DriveLimits, PathFollower, is_free
from robot_client.navigation.recovery import BackUp, TurnAround, recovery

GEOMETRY = GridGeometry(0.0, 0.0, 0.05, 80, 80)
"""4 × 4 m."""
TICK = 0.05
FREE, AT_WALL = Pose2D(1.0, 2.0, 0.0), Pose2D(1.0, 0.35, 0.0)
LIMITS = DriveLimits()


def costmap(crate: float | None = None) -> Costmap:
    """Walls around; a crate that begins so many metres from the left."""
    occupancy = np.zeros((80, 80), dtype=np.int8)
    occupancy[[0, -1], :] = occupancy[:, [0, -1]] = 100
    if crate is not None:
        occupancy[34:46, round(crate / 0.05) : round(crate / 0.05) + 6] = 100
    return Costmap(GEOMETRY, occupancy, (), radius=0.2, inflation=0.5)


def settled(pose: Pose2D, end: Pose2D, costs: Costmap) -> DriveCommand | None:
    """The command after two seconds of such commands, the robot being held at its place."""
    count = max(2, round(pose.distance(end.x, end.y) / 0.05))
    path = np.linspace(pose[:2], end[:2], count)
    follower, last = PathFollower(path, end, LIMITS), STANDSTILL
    for _ in range(40):
        command = follower.command(pose, last, costs, TICK)
        if command is None:
            return None
        last = command
    return last


def test_free_path_is_driven_at_full_speed() -> None:
    assert settled(FREE, Pose2D(3.0, 2.0, 0.0), costmap()) == pytest.approx((LIMITS.speed, 0.0))


@pytest.mark.parametrize(
    ("pose", "end"),
    [
        (AT_WALL, Pose2D(3.0, 0.35, 0.0)),  # beside a wall
        (Pose2D(1.0, 2.0, 0.85), Pose2D(3.0, 2.0, 0.0)),  # a curve
        (Pose2D(2.8, 2.0, 0.0), Pose2D(3.0, 2.0, 0.0)),  # the end
    ],
    ids=["near an obstacle", "in a curve", "before the goal"],
)
def test_speed_is_less_than_full(pose: Pose2D, end: Pose2D) -> None:
    command = settled(pose, end, costmap())
    assert command is not None
    assert 0.05 < command.speed < 0.95 * LIMITS.speed


def test_speed_grows_by_the_acceleration() -> None:
    follower = PathFollower(np.linspace((1.0, 2.0), (3.0, 2.0), 40), Pose2D(3.0, 2.0, 0.0), LIMITS)
    command = follower.command(FREE, STANDSTILL, costmap(), TICK)
    assert command == pytest.approx((LIMITS.acceleration * TICK, 0.0))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_path_behind_is_turned_to_first(side: float) -> None:
    command = settled(Pose2D(2.0, 2.0, side * 2.5), Pose2D(3.0, 2.0, 0.0), costmap())
    assert command == pytest.approx((0.0, -side * LIMITS.turn))


def test_obstacle_on_the_path_is_not_driven_into() -> None:
    costs, pose, last = costmap(crate=2.0), FREE, STANDSTILL
    follower = PathFollower(np.linspace((1.0, 2.0), (3.0, 2.0), 40), Pose2D(3.0, 2.0, 0.0), LIMITS)
    assert follower.is_blocked(costs)
    assert not follower.is_blocked(costmap())
    for _ in range(200):
        command = follower.command(pose, last, costs, TICK)
        assert command is not None
        last, pose = command, command.step(pose, TICK)
        assert costs.clearance_at(np.array([pose[:2]]))[0] > 0.17
    assert (last, pose.x) == (STANDSTILL, pytest.approx(1.79, abs=0.06))


@pytest.mark.parametrize(
    "last", [STANDSTILL, DriveCommand(0.4, 0.0), DriveCommand(0.3, 1.2), DriveCommand(0.3, -1.2)]
)
@pytest.mark.parametrize(
    "end", [(3.0, 2.0), (1.0, 2.0), (2.0, 3.0)], ids=["behind the crate", "behind", "beside"]
)
def test_every_command_is_free_as_it_is_sent(last: DriveCommand, end: tuple[float, float]) -> None:
    costs, path = costmap(crate=2.0), np.linspace((1.5, 2.3), end, 40)
    for x in np.arange(1.3, 1.8, 0.04):
        for heading in np.arange(-math.pi, math.pi, 0.3):
            pose = Pose2D(float(x), 2.0, float(heading))
            command = PathFollower(path, Pose2D(*end, 0.0), LIMITS).command(pose, last, costs, TICK)
            assert command is not None
            assert is_free(pose, command, costs), (pose, command)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_speed_that_is_left_is_braked_at_once_before_an_obstacle(side: float) -> None:
    follower = PathFollower(np.linspace((1.7, 2.0), (0.5, 2.0), 40), Pose2D(0.5, 2.0, 0.0), LIMITS)
    last, pose = DriveCommand(0.4, side), Pose2D(1.7, 2.0, side * 0.1)
    command = follower.command(pose, last, costmap(crate=2.0), TICK)
    assert command is not None and (command.speed, abs(command.turn) > 0.5) == (0.0, True)
    free = follower.command(Pose2D(1.2, 2.0, side * 0.1), last, costmap(crate=2.0), TICK)
    assert free is not None and free.speed == pytest.approx(0.28)


@pytest.mark.parametrize(
    ("heading", "expected"), [(0.05, None), (1.0, -LIMITS.turn), (-1.0, LIMITS.turn), (-0.13, 0.325)]
)
def test_at_the_goal_the_heading_is_left(heading: float, expected: float | None) -> None:
    command = settled(Pose2D(3.0, 2.0, heading), Pose2D(3.05, 2.0, 0.0), costmap())
    assert command is None if expected is None else command == pytest.approx((0.0, expected))


# --- recovery ---------------------------------------------------------------------------------------------


def test_recoveries_take_turns() -> None:
    kinds = [type(recovery(number, FREE, 0.0)) for number in range(1, 5)]
    assert kinds == [BackUp, TurnAround, BackUp, TurnAround]


@pytest.mark.parametrize(
    ("start", "least", "most"),
    [(FREE, 0.28, 0.34), (Pose2D(0.35, 2.0, 0.0), 0.0, 0.12), (Pose2D(0.2, 2.0, 0.0), 0.0, 0.0)],
    ids=["free", "a wall behind", "at a wall"],
)
def test_backing_up_ends_at_an_obstacle(start: Pose2D, least: float, most: float) -> None:
    costs, back, now, pose = costmap(), BackUp(start, 0.0), 0.0, start
    while (command := back.command(pose, costs, now)) is not None:
        pose, now = command.step(pose, TICK), now + TICK
    assert least <= start.x - pose.x <= most
    assert costs.clearance_at(np.array([pose[:2]]))[0] >= min(0.15, start.x - 0.05)


@pytest.mark.parametrize("left", [True, False])
def test_turning_around(left: bool) -> None:
    turn, now, pose = TurnAround(FREE, 0.0, left), 0.0, FREE
    while (command := turn.command(pose, costmap(), now)) is not None:
        pose, now = command.step(pose, TICK), now + TICK
    assert math.degrees(pose.heading) == pytest.approx(100 if left else -100, abs=3)
    assert pose[:2] == pytest.approx(FREE[:2])


def test_a_turn_that_does_not_get_on_ends() -> None:
    turn = TurnAround(FREE, 0.0, left=True)
    assert turn.command(FREE, costmap(), 3.9) is not None
    assert turn.command(FREE, costmap(), 4.1) is None
