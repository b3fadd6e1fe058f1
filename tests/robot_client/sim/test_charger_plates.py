"""Chargers in the camera's image: their markers are found where they are."""

import math

import numpy as np
import pytest

from robot_client.services.camera_model import of_view
from robot_client.services.markers import Detector, SeenMarker
from robot_client.sim.camera import SimCamera
from robot_client.sim.charger_plates import MARKER_SIDE
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

NOON = 1_700_000_000.0
GREY = WallTexture(Colour(150, 150, 150), Texture.PANEL)
HALL = WORLDS["default"]()
LENS = of_view(640, 480, 75)
CAPTIONS = 430
"""Row from which there are captions."""
PLACE = (-2.7, -4.5)
"""Of the hall's charger."""


def seen(world: World, pose: Pose) -> list[SeenMarker]:
    """Markers that the camera sees from a pose; captions, which may look like markers, are masked."""
    picture = SimCamera(world).render(pose, 0.0, NOON)
    picture[CAPTIONS:] = 128
    return Detector("4X4_50", MARKER_SIDE).find(picture, LENS)


@pytest.mark.parametrize(
    ("x", "y", "aside"),
    [(-2.4, -0.4, 0.0), (-2.7, -2.5, 0.3), (-2.7, -2.5, -0.3), (-1.9, -3.2, 0.1), (-2.7, -4.05, 0.0)],
)
def test_marker_of_the_default_world_is_found_at_its_position(x: float, y: float, aside: float) -> None:
    ahead = math.atan2(PLACE[1] - y, PLACE[0] - x)
    (found,) = seen(HALL, Pose(x, y, ahead - aside))
    assert found.number == 7
    assert found.distance == pytest.approx(math.hypot(PLACE[0] - x, PLACE[1] - y), rel=0.05)
    assert found.bearing == pytest.approx(aside, abs=math.radians(1.5))


def room(*pillars: Circle) -> World:
    """A room with a charger ahead of the start."""
    walls = box(0.0, 0.0, 6.0, 6.0, 0.0, GREY)
    # The wall in the east runs from south to north.
    return World(walls, list(pillars), Pose(0.0, 0.0, 0.0), (Charger(wall=2, along=3.0, marker=3),))


def test_obstacle_hides_the_charger() -> None:
    assert [each.number for each in seen(room(), Pose(0.0, 0.0, 0.0))] == [3]
    assert seen(room(Circle(1.5, 0.0, 0.4, GREY)), Pose(0.0, 0.0, 0.0)) == []


def test_charger_is_not_visible_from_behind() -> None:
    walls = [Segment(1.0, -2.0, 1.0, 2.0, GREY)]
    for side, heading in ((-1.0, 0.0), (1.0, math.pi)):
        world = World(walls, [], Pose(0, 0, 0), (Charger(wall=0, along=2.0, marker=3),))
        found = seen(world, Pose(1.0 + 1.5 * side, 0.0, heading))
        assert [each.number for each in found] == ([3] if side < 0 else [])


def test_rest_of_the_image_is_the_same() -> None:
    bare = World(list(HALL.segments), list(HALL.circles), HALL.start, tables=HALL.tables)
    for heading, changed in ((0.0, False), (-math.pi / 2, True)):
        pose = Pose(HALL.start.x, HALL.start.y, heading)
        one, other = (SimCamera(world).render(pose, 0.0, NOON).astype(int) for world in (HALL, bare))
        share = float((one != other).any(axis=2).mean())
        assert (0 < share < 0.03) if changed else share == 0.0


@pytest.mark.parametrize("heading", [-math.pi / 2, 0.0, math.pi, -0.3])
def test_charger_right_before_the_camera(heading: float) -> None:
    with np.errstate(all="raise", under="ignore"):
        frame = SimCamera(HALL).render(Pose(PLACE[0], PLACE[1] + 0.001, heading), 0.0, NOON)
    assert frame.shape == (480, 640, 3)
