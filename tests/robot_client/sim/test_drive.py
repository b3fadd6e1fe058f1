"""The body's physics: limits, exact arcs, quick stops, and walls that hold."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from robot_client.sim.drive import HIGHEST_SPEED, RADIUS, STANDING, MotorLimits, SimBody, Twist, along_arc
from robot_client.sim.world import Circle, Colour, Pose, Segment, Texture, WallTexture, World, box
from robot_client.sim.worlds import WORLDS

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
    """What was asked, and how the body was just before."""

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
def test_never_inside_a_wall(commands: list[tuple[float, float, int]]) -> None:
    """Whatever is asked at the highest speed, the hull overlaps no obstacle and stays in the hall."""
    robot = body(HALL, HALL.start, HIGHEST_SPEED)
    for _ in steps(robot, commands):
        assert HALL.nearest(robot.pose.x, robot.pose.y).distance >= RADIUS
        assert abs(robot.pose.x) < 6 and abs(robot.pose.y) < 4.5


@settings(max_examples=60, deadline=None)
@given(COMMANDS)
def test_no_energy_from_nowhere(commands: list[tuple[float, float, int]]) -> None:
    """Speed never exceeds what was asked or what was there, and never grows faster than the motors can."""
    robot = body(HALL, HALL.start, HIGHEST_SPEED)
    for asked, before, _ in steps(robot, commands):
        now = robot.velocity
        assert abs(now.speed) <= max(abs(before.speed), abs(asked.speed)) + 1e-9
        assert abs(now.speed) - abs(before.speed) <= robot.limits.speeding_up * STEP + 1e-9
        assert abs(now.turn) <= max(abs(before.turn), abs(asked.turn)) + 1e-9


@settings(max_examples=60, deadline=None)
@given(COMMANDS)
def test_says_it_stands_only_when_it_stands(commands: list[tuple[float, float, int]]) -> None:
    """`moving` is the truth about the pose: no step changes it while the body claims to stand."""
    robot = body(HALL, HALL.start, HIGHEST_SPEED)
    for _, _, before in steps(robot, commands):
        if not robot.moving:
            assert robot.pose == pytest.approx(before, abs=1e-8)


@given(speed=st.floats(-0.5, 0.5), turn=st.floats(-2, 2), heading=st.floats(-3, 3), cuts=st.integers(2, 20))
def test_arcs_are_exact(speed: float, turn: float, heading: float, cuts: int) -> None:
    """One arc of a second ends where many small ones do: no error of integration."""
    begin = Pose(1.0, 2.0, heading)
    pose = begin
    for _ in range(cuts):
        pose = along_arc(pose, Twist(speed, turn), 1 / cuts)
    whole = along_arc(begin, Twist(speed, turn), 1.0)
    assert pose[:2] == pytest.approx(whole[:2], abs=1e-9)
    assert math.remainder(pose.heading - whole.heading, math.tau) == pytest.approx(0, abs=1e-9)


def test_full_circle_comes_home() -> None:
    """v/w is the radius: after 2π/w seconds the body is where it began."""
    pose = Pose(0.5, -0.5, 0.7)
    for _ in range(100):
        pose = along_arc(pose, Twist(0.4, math.tau / 2.0), 0.02)
    assert pose == pytest.approx((0.5, -0.5, 0.7), abs=1e-9)


def test_stops_within_two_steps_from_the_default_speed() -> None:
    """0.5 m/s and 2 rad/s are gone 40 ms after the first step that knows of the zero."""
    robot = body()
    drive(robot, 0.5, 2.0, 100)
    assert robot.velocity == (0.5, 2.0)
    drive(robot, 0.0, 0.0, 2)
    assert robot.velocity == STANDING
    assert not robot.moving


def test_braking_way_is_centimetres() -> None:
    """From 0.5 m/s the robot rolls less than a centimetre."""
    robot = body()
    drive(robot, 0.5, 0.0, 100)
    before = robot.pose.x
    drive(robot, 0.0, 0.0, 50)
    assert 0 < robot.pose.x - before < 0.01


def test_starts_at_the_motors_pace() -> None:
    """After a tenth of a second at 1.5 m/s² the speed is 0.15 m/s."""
    robot = body()
    drive(robot, 0.5, 0.0, 5)
    assert robot.velocity.speed == pytest.approx(0.15)


def test_lower_limit_takes_effect_while_driving() -> None:
    """A speed over a new limit is braked to it."""
    robot = body()
    drive(robot, 0.5, 0.0, 100)
    robot.limits = robot.limits._replace(speed=0.2)
    drive(robot, 0.5, 0.0, 3)
    assert robot.velocity.speed == pytest.approx(0.2)


def test_reversing_passes_through_zero() -> None:
    """Braking ends at zero before the other way begins, so the start is never as hard as a stop."""
    robot = body()
    drive(robot, 0.5, 0.0, 100)
    drive(robot, -0.5, 0.0, 2)
    assert robot.velocity.speed == 0.0
    drive(robot, -0.5, 0.0, 1)
    assert robot.velocity.speed == pytest.approx(-0.03)


def test_stands_stalled_at_a_wall_head_on() -> None:
    """Against a wall the body comes to rest at its hull's radius, blocked, and reverses freely."""
    world = World([Segment(1, -5, 1, 5, GREY)], [], Pose(0, 0, 0))
    robot = body(world)
    drive(robot, 0.5, 0.0, 400)
    assert robot.pose.x == pytest.approx(1 - RADIUS, abs=1e-4)
    assert robot.velocity == STANDING
    assert robot.blocked and not robot.moving
    drive(robot, -0.5, 0.0, 50)
    assert robot.pose.x < 0.7
    assert not robot.blocked


def test_slides_along_a_wall_met_at_a_flat_angle() -> None:
    """A slanting approach keeps the part of the speed that runs along the wall."""
    world = World([Segment(-50, 1, 50, 1, GREY)], [], Pose(0, 0, 0))
    robot = body(world, Pose(0, 0.5, math.radians(20)))
    drive(robot, 0.5, 0.0, 400)
    assert robot.pose.y == pytest.approx(1 - RADIUS, abs=1e-4)
    assert robot.pose.x > 2.0
    assert robot.moving and not robot.blocked


def test_turns_on_the_spot_at_a_wall() -> None:
    """A round hull can always turn, even when it touches."""
    world = World([Segment(1, -5, 1, 5, GREY)], [], Pose(0, 0, 0))
    robot = body(world)
    drive(robot, 0.5, 0.0, 300)
    drive(robot, 0.0, 1.0, 100)
    assert robot.pose.heading > 1.0


def test_a_wedge_narrower_than_the_hull_holds_it() -> None:
    """Between two pillars closer than its width the body stays out."""
    pillars = [Circle(1, 0.3, 0.2, GREY), Circle(1, -0.3, 0.2, GREY)]
    world = World([], pillars, Pose(0, 0, 0))
    robot = body(world, speed=HIGHEST_SPEED)
    drive(robot, HIGHEST_SPEED, 0.0, 400)
    assert robot.pose.x < 1.0
    assert robot.blocked


def test_a_long_time_is_cut_into_steps() -> None:
    """A second at once does what fifty steps do: no wall is jumped over."""
    world = World([Segment(1, -5, 1, 5, GREY)], [], Pose(0, 0, 0))
    robot = body(world, speed=HIGHEST_SPEED)
    robot.target = Twist(HIGHEST_SPEED, 0.0)
    robot.step(3.0)
    assert robot.pose.x < 1.0


def test_reset_stands_still() -> None:
    """After a reset nothing of the drive is left."""
    robot = body()
    drive(robot, 0.5, 1.0, 100)
    robot.reset(Pose(3, 4, 1))
    robot.step(STEP)
    assert (robot.pose, robot.velocity, robot.travelled, robot.moving) == ((3, 4, 1), STANDING, 0.0, False)
