"""The body's physics: limits, exact arcs, braking and walls."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from robot_client.sim.drive import HIGHEST_SPEED, RADIUS, ZERO_TWIST, MotorLimits, SimBody, Twist, along_arc
from robot_client.sim.world import WORLDS, Circle, Colour, Pose, Segment, Texture, WallTexture, World, box

STEP = 0.02
GREY = WallTexture(Colour(128, 128, 128), Texture.BRICK)
ORIGIN = Pose(0, 0, 0)
HALL = WORLDS["default"]()
COMMANDS = st.lists(
    st.tuples(
        st.floats(-HIGHEST_SPEED, HIGHEST_SPEED), st.floats(-3.0, 3.0), st.integers(1, 60)
    ),
    min_size=1,
    max_size=12,
)  # fmt: skip


def body(world: World | None = None, pose: Pose = ORIGIN, speed: float = 0.5) -> SimBody:
    return SimBody(world or World(box(0, 0, 40, 40, 0, GREY), [], pose), pose, MotorLimits(speed=speed))


def drive(each: SimBody, speed: float, turn: float, steps: int) -> None:
    each.target = Twist(speed, turn)
    for _ in range(steps):
        each.step(STEP)


class Step(NamedTuple):
    """The commanded velocity, and the body before the step."""

    asked: Twist
    velocity: Twist
    pose: Pose


def steps(robot: SimBody, commands: list[tuple[float, float, int]]) -> Iterator[Step]:
    for speed, turn, count in commands:
        robot.target = Twist(speed, turn)
        for _ in range(count):
            step = Step(robot.target, robot.velocity, robot.pose)
            robot.step(STEP)
            yield step


@settings(max_examples=60, deadline=None)
@given(COMMANDS)
@example([(HIGHEST_SPEED, 0.0, 400)])
@example([(-HIGHEST_SPEED, 0.0, 400), (HIGHEST_SPEED, 3.0, 400)])
def test_body_never_overlaps_a_wall(commands: list[tuple[float, float, int]]) -> None:
    robot = body(HALL, HALL.start, HIGHEST_SPEED)
    for _ in steps(robot, commands):
        assert HALL.nearest(robot.pose.x, robot.pose.y).distance >= RADIUS
        assert abs(robot.pose.x) < 6 and abs(robot.pose.y) < 4.5


@settings(max_examples=60, deadline=None)
@given(COMMANDS)
def test_speed_never_exceeds_command_and_limits(commands: list[tuple[float, float, int]]) -> None:
    robot = body(HALL, HALL.start, HIGHEST_SPEED)
    for asked, before, _ in steps(robot, commands):
        now = robot.velocity
        assert abs(now.speed) <= max(abs(before.speed), abs(asked.speed)) + 1e-9
        assert abs(now.speed) - abs(before.speed) <= robot.limits.speeding_up * STEP + 1e-9
        assert abs(now.turn) <= max(abs(before.turn), abs(asked.turn)) + 1e-9


@settings(max_examples=60, deadline=None)
@given(COMMANDS)
def test_moving_is_true_whenever_the_pose_changes(commands: list[tuple[float, float, int]]) -> None:
    robot = body(HALL, HALL.start, HIGHEST_SPEED)
    for _, _, before in steps(robot, commands):
        if not robot.moving:
            assert robot.pose == pytest.approx(before, abs=1e-8)


@given(speed=st.floats(-0.5, 0.5), turn=st.floats(-2, 2), heading=st.floats(-3, 3), cuts=st.integers(2, 20))
def test_arcs_are_exact(speed: float, turn: float, heading: float, cuts: int) -> None:
    begin = Pose(1.0, 2.0, heading)
    pose = begin
    for _ in range(cuts):
        pose = along_arc(pose, Twist(speed, turn), 1 / cuts)
    whole = along_arc(begin, Twist(speed, turn), 1.0)
    assert pose[:2] == pytest.approx(whole[:2], abs=1e-9)
    assert math.remainder(pose.heading - whole.heading, math.tau) == pytest.approx(0, abs=1e-9)


def test_full_circle_ends_at_its_start() -> None:
    pose = Pose(0.5, -0.5, 0.7)
    for _ in range(100):
        pose = along_arc(pose, Twist(0.4, math.tau / 2.0), 0.02)
    assert pose == pytest.approx((0.5, -0.5, 0.7), abs=1e-9)


def test_stops_within_two_steps_from_the_default_speed() -> None:
    robot = body()
    drive(robot, 0.5, 2.0, 100)
    assert robot.velocity == (0.5, 2.0)
    drive(robot, 0.0, 0.0, 2)
    assert robot.velocity == ZERO_TWIST
    assert not robot.moving


def test_braking_distance_is_below_a_centimetre() -> None:
    robot = body()
    drive(robot, 0.5, 0.0, 100)
    before = robot.pose.x
    drive(robot, 0.0, 0.0, 50)
    assert 0 < robot.pose.x - before < 0.01


def test_acceleration_is_that_of_the_motors() -> None:
    robot = body()
    drive(robot, 0.5, 0.0, 5)
    assert robot.velocity.speed == pytest.approx(0.15)


def test_lower_limit_takes_effect_while_driving() -> None:
    robot = body()
    drive(robot, 0.5, 0.0, 100)
    robot.limits = robot.limits._replace(speed=0.2)
    drive(robot, 0.5, 0.0, 3)
    assert robot.velocity.speed == pytest.approx(0.2)


def test_reversing_passes_through_zero() -> None:
    robot = body()
    drive(robot, 0.5, 0.0, 100)
    drive(robot, -0.5, 0.0, 2)
    assert robot.velocity.speed == 0.0
    drive(robot, -0.5, 0.0, 1)
    assert robot.velocity.speed == pytest.approx(-0.03)


def test_body_is_blocked_at_a_wall_head_on() -> None:
    """It can reverse."""
    world = World([Segment(1, -5, 1, 5, GREY)], [], Pose(0, 0, 0))
    robot = body(world)
    drive(robot, 0.5, 0.0, 400)
    assert robot.pose.x == pytest.approx(1 - RADIUS, abs=1e-4)
    assert robot.velocity == ZERO_TWIST
    assert robot.blocked and not robot.moving
    drive(robot, -0.5, 0.0, 50)
    assert robot.pose.x < 0.7
    assert not robot.blocked


def test_body_slides_along_a_wall() -> None:
    world = World([Segment(-50, 1, 50, 1, GREY)], [], Pose(0, 0, 0))
    robot = body(world, Pose(0, 0.5, math.radians(20)))
    drive(robot, 0.5, 0.0, 400)
    assert robot.pose.y == pytest.approx(1 - RADIUS, abs=1e-4)
    assert robot.pose.x > 2.0
    assert robot.moving and not robot.blocked


def test_body_can_turn_at_a_wall() -> None:
    world = World([Segment(1, -5, 1, 5, GREY)], [], Pose(0, 0, 0))
    robot = body(world)
    drive(robot, 0.5, 0.0, 300)
    drive(robot, 0.0, 1.0, 100)
    assert robot.pose.heading > 1.0


def test_body_stays_out_of_a_narrow_gap() -> None:
    pillars = [Circle(1, 0.3, 0.2, GREY), Circle(1, -0.3, 0.2, GREY)]
    world = World([], pillars, Pose(0, 0, 0))
    robot = body(world, speed=HIGHEST_SPEED)
    drive(robot, HIGHEST_SPEED, 0.0, 400)
    assert robot.pose.x < 1.0
    assert robot.blocked


def test_long_times_are_cut_into_steps() -> None:
    world = World([Segment(1, -5, 1, 5, GREY)], [], Pose(0, 0, 0))
    robot = body(world, speed=HIGHEST_SPEED)
    robot.target = Twist(HIGHEST_SPEED, 0.0)
    robot.step(3.0)
    assert robot.pose.x < 1.0


def test_reset_ends_all_motion() -> None:
    robot = body()
    drive(robot, 0.5, 1.0, 100)
    robot.reset(Pose(3, 4, 1))
    robot.step(STEP)
    assert (robot.pose, robot.velocity, robot.travelled, robot.moving) == ((3, 4, 1), ZERO_TWIST, 0.0, False)


@settings(max_examples=60, deadline=None)
@given(COMMANDS)
def test_a_body_that_has_stood_drives_as_any_other(commands: list[tuple[float, float, int]]) -> None:
    """Steps in which nothing changes are skipped."""
    fresh, stood = (body(HALL, HALL.start, HIGHEST_SPEED) for _ in range(2))
    drive(stood, 0.0, 0.0, 5)
    assert stood.pose == HALL.start
    for speed, turn, count in commands:
        drive(fresh, speed, turn, count)
        drive(stood, speed, turn, count)
        assert (stood.pose, stood.velocity, stood.moving) == (fresh.pose, fresh.velocity, fresh.moving)


def test_a_body_that_is_put_into_a_wall_after_it_has_stood_is_pushed_out() -> None:
    robot = body()
    drive(robot, 0.0, 0.0, 5)
    robot.pose = Pose(19.9, 0.0, 0.0)
    drive(robot, 0.0, 0.0, 5)
    assert robot.pose.x <= 20 - RADIUS
