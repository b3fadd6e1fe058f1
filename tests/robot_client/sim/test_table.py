"""A table as seen by scanner, depth camera, camera and body."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot_client.sim.camera import SimCamera
from robot_client.sim.depth_camera import HEIGHT, WIDTH, SimDepthCamera
from robot_client.sim.drive import RADIUS, SimBody, Twist
from robot_client.sim.floor_plan import FREE, OCCUPIED, floor_plan
from robot_client.sim.world import Colour, Pose, Table, Texture, WallTexture, World, box

GREY = WallTexture(Colour(128, 128, 128), Texture.BRICK)
WOOD = WallTexture(Colour(70, 120, 180), Texture.PANEL)
TABLE = Table(2.0, 0.0, 1.0, 0.8, 0.0, WOOD)
"""Its near edge is 1.5 m ahead of the start."""


def room(*tables: Table) -> World:
    return World(box(0.0, 0.0, 10.0, 6.0, 0.0, GREY), [], Pose(0.0, 0.0, 0.0), tables=tables)


def drive_ahead(world: World) -> SimBody:
    body = SimBody(world, world.start)
    body.target = Twist(0.5, 0.0)
    body.step(12.0)
    return body


def test_scanner_sees_the_legs_alone() -> None:
    world = room(TABLE)
    leg = math.atan2(0.35, 1.55)
    ahead, at_leg = world.scan(0.0, 0.0, np.array([0.0, leg]))
    assert ahead == pytest.approx(5.0)
    assert at_leg == pytest.approx(math.hypot(0.35, 1.55) - 0.02)


@pytest.mark.parametrize(
    ("tables", "reached"),
    [
        ((), 5.0 - RADIUS),
        ((TABLE,), 1.5 - RADIUS),
        ((TABLE._replace(underside=0.6, top=0.64),), 5.0 - RADIUS),
    ],
    ids=["no table", "plate at the height of the body", "plate above the body"],
)
def test_body_meets_a_plate_at_its_height(tables: tuple[Table, ...], reached: float) -> None:
    assert drive_ahead(room(*tables)).pose.x == pytest.approx(reached, abs=0.01)


def test_body_meets_legs_under_a_high_plate() -> None:
    table = TABLE._replace(y=0.35, underside=0.6, top=0.64)  # two legs are straight ahead
    assert drive_ahead(room(table)).pose.x < 1.5


def test_depth_camera_sees_the_plate_and_the_floor_below_it() -> None:
    without, depth = (SimDepthCamera(room(*each), 1).render(Pose(0.0, 0.0, 0.0)) for each in ((), (TABLE,)))
    middle = WIDTH // 2
    plate = np.flatnonzero(np.abs(depth[: HEIGHT // 2, middle].astype(int) - 1500) < 30)
    # 2 to 3 rows: 4 cm at 1.5 m by a focal length of 104 pixels. The underside is as high as the camera.
    assert len(plate) in (2, 3)
    below = slice(HEIGHT // 2, None)
    assert np.abs(depth[below, middle].astype(int) - without[below, middle]).max() < 250


def test_depth_is_zero_where_nothing_is_measured() -> None:
    depth = SimDepthCamera(room(), 1).render(Pose(0.0, 0.0, 0.0))
    assert not depth[0].any()  # over the walls
    assert depth[HEIGHT // 2, WIDTH // 2] == pytest.approx(5000, abs=300)


def test_image_shows_the_table_before_the_wall_and_not_behind_it() -> None:
    pose = Pose(0.0, 0.0, 0.0)
    pictures = [
        SimCamera(room(*each)).render(pose, 0.0, 0.0) for each in ((), (TABLE,), (TABLE._replace(x=6.0),))
    ]
    assert (pictures[0] != pictures[1]).any()
    assert (pictures[0] == pictures[2]).all()


def test_map_has_walls_and_no_table() -> None:
    with_table, without = floor_plan(room(TABLE)), floor_plan(room())
    assert (with_table.cells == without.cells).all()
    row, column = round((0.0 - without.y) / 0.05), round((5.0 - without.x) / 0.05)
    assert without.cells[row, column] == OCCUPIED
    assert without.cells[row, column - 20] == FREE
