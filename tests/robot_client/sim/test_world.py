"""Rays and distances in the flat world, against cases with a known answer."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from robot_client.sim.drive import RADIUS
from robot_client.sim.world import (
    WORLDS,
    Charger,
    Circle,
    Colour,
    Pose,
    Segment,
    Texture,
    WallTexture,
    World,
    box,
)

GREY = WallTexture(Colour(128, 128, 128), Texture.BRICK)
ANGLES = st.floats(-math.pi, math.pi)


def room(width: float = 8.0, depth: float = 6.0, pillars: tuple[Circle, ...] = ()) -> World:
    return World(box(0, 0, width, depth, 0.0, GREY), list(pillars), Pose(0, 0, 0))


@given(x=st.floats(-3.9, 3.9), y=st.floats(-2.9, 2.9), angle=ANGLES)
def test_ray_in_an_empty_room_reaches_the_analytic_wall(x: float, y: float, angle: float) -> None:
    cos, sin = math.cos(angle), math.sin(angle)
    assume(abs(cos) > 1e-6 and abs(sin) > 1e-6)
    expected = min((math.copysign(4, cos) - x) / cos, (math.copysign(3, sin) - y) / sin)
    assert room().cast(x, y, np.array([angle])).distance[0] == pytest.approx(expected)


@given(distance=st.floats(1.0, 3.0), radius=st.floats(0.1, 0.8), offset=st.floats(-0.99, 0.99))
def test_ray_at_a_pillar_follows_the_circle_equation(distance: float, radius: float, offset: float) -> None:
    """A ray that passes the centre at offset o meets the circle at d - sqrt(r² - o²)."""
    miss = offset * radius
    world = room(pillars=(Circle(distance, miss, radius, GREY),))
    hits = world.cast(0.0, 0.0, np.array([0.0]))
    assert hits.distance[0] == pytest.approx(distance - math.sqrt(radius**2 - miss**2))
    assert hits.surface[0] == 4


def test_ray_beside_a_pillar_reaches_the_wall() -> None:
    world = room(pillars=(Circle(2.0, 0.501, 0.5, GREY),))
    assert world.cast(0.0, 0.0, np.array([0.0])).distance[0] == pytest.approx(4.0)


def test_ray_that_meets_nothing_is_infinite() -> None:
    hits = World([Segment(1, -1, 1, 1, GREY)], [], Pose(0, 0, 0)).cast(0, 0, np.array([math.pi, 0.0]))
    assert hits.distance.tolist() == [math.inf, 1.0]
    assert hits.surface.tolist() == [-1, 0]


def test_ray_along_a_wall_does_not_divide_by_zero() -> None:
    world = World([Segment(1, 0, 2, 0, GREY), Segment(3, -1, 3, 1, GREY)], [], Pose(0, 0, 0))
    assert world.cast(0, 0, np.array([0.0])).distance[0] == pytest.approx(3.0)


@given(angle=ANGLES)
def test_no_ray_slips_through_a_closed_room(angle: float) -> None:
    corner = math.atan2(3, 4)
    angles = np.array([angle, corner, -corner, math.pi - corner, corner - math.pi])
    assert np.isfinite(room().cast(0.0, 0.0, angles).distance).all()


def test_hits_have_surface_facing_and_position() -> None:
    world = World([Segment(2, -3, 2, 3, GREY)], [], Pose(0, 0, 0))
    hits = world.cast(0, 0, np.array([0.0, math.pi / 4]))
    assert hits.facing == pytest.approx([1.0, math.sqrt(0.5)])
    assert hits.along == pytest.approx([3.0, 5.0])


@given(x=st.floats(-3.9, 3.9), y=st.floats(-2.9, 2.9))
def test_nearest_wall_of_a_room_is_the_least_of_four(x: float, y: float) -> None:
    contact = room().nearest(x, y)
    assert contact.distance == pytest.approx(min(4 - x, 4 + x, 3 - y, 3 + y), abs=1e-9)
    assert math.hypot(contact.away_x, contact.away_y) == pytest.approx(1.0)


def test_inside_a_pillar_the_distance_is_negative() -> None:
    contact = room(pillars=(Circle(1.0, 0.0, 0.5, GREY),)).nearest(0.8, 0.0)
    assert contact == pytest.approx((-0.3, -1.0, 0.0))


@pytest.mark.parametrize("name", sorted(WORLDS))
def test_worlds_start_in_the_open(name: str) -> None:
    world = WORLDS[name]()
    assert world.nearest(world.start.x, world.start.y).distance > 2 * RADIUS
    assert world.cast(*world.start[:2], np.array([world.start.heading])).distance[0] > 2.0


def test_default_world_shows_many_colours() -> None:
    looks = {look.colour for look in WORLDS["default"]().appearances}
    assert len(looks) >= 8


@pytest.mark.parametrize(
    ("x", "y", "charged"),
    [(0.0, -2.5, True), (0.4, -2.7, True), (0.0, -2.3, False), (0.7, -2.9, False), (0.0, -3.3, False)],
)
def test_charger_charges_a_robot_in_front_of_it(x: float, y: float, charged: bool) -> None:
    walls = box(0, 0, 8.0, 6.0, 0.0, GREY)
    world = World(walls, [], Pose(0, 0, 0), (Charger(wall=1, along=4.0, marker=1),))
    assert world.charges(x, y) is charged
    assert not room().charges(x, y)
