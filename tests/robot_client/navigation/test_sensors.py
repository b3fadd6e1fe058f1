"""Scans and depth images as input of a costmap."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot_client.navigation.costmap import Costmap
from robot_client.navigation.grid import GridGeometry, Pose2D
from robot_client.navigation.sensors import view_of_depth, view_of_scan
from robot_client.services.camera_model import CameraModel

MODEL = CameraModel(100.0, 100.0, 4.5, 49.5)
"""Of 10 × 100 pixels: a row is 1 cm high at 1 m."""
AWAY = np.full((100, 10), np.nan, dtype=np.float32)


def depth(rows: slice, metres: float) -> np.ndarray:
    image = AWAY.copy()
    image[rows] = metres
    return image


def test_scan_has_no_echo_or_no_measurement() -> None:
    ranges = np.array([1.0, math.inf, 12.0, 0.0, math.nan])
    view = view_of_scan(Pose2D(1.0, 2.0, 0.5), ranges, np.zeros(5), farthest=10.0)
    assert view.origin == (1.0, 2.0)
    assert view.directions.tolist() == [0.5] * 5
    assert view.distances.tolist() == pytest.approx(
        [1.0, math.inf, math.inf, math.nan, math.nan], nan_ok=True
    )


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (depth(slice(40, 50), 1.0), 1.0),  # 40 to 50 cm high: a plate
        (depth(slice(10, 25), 1.0), math.inf),  # 65 to 80 cm: it is driven under
        (depth(slice(88, 90), 1.0), math.inf),  # 0 to 2 cm: the floor
        (AWAY, math.nan),
    ],
    ids=["plate", "higher than the robot", "floor", "nothing measured"],
)
def test_depth_counts_what_is_as_high_as_the_robot(image: np.ndarray, expected: float) -> None:
    view = view_of_depth(Pose2D(0.0, 0.0, 0.0), image, MODEL, camera_height=0.4)
    assert view.distances.tolist() == pytest.approx([expected] * 5, rel=0.01, nan_ok=True)
    assert view.directions.tolist() == pytest.approx([0.04, 0.02, 0.0, -0.02, -0.04], abs=0.001)


def test_a_single_pixel_is_noise() -> None:
    image = depth(slice(88, 90), 1.0)
    image[45, 4] = 0.5
    assert np.isinf(view_of_depth(Pose2D(0.0, 0.0, 0.0), image, MODEL, 0.4).distances).all()


FLOOR = 0.4 * 100.0 / (np.arange(100) - 49.5)
"""Depth of the floor in each row, seen by a camera 0.4 m high; negative above the horizon."""


def view(of: np.ndarray, shortest: float = 0.5) -> tuple[float, float, float]:
    """Distance of the middle column, and from and to where it is clear."""
    image = np.repeat(of[:, None], 10, axis=1).astype(np.float32)
    found = view_of_depth(Pose2D(0.0, 0.0, 0.0), image, MODEL, 0.4, shortest)
    return tuple(float(np.broadcast_to(each, 5)[2]) for each in found[2:])  # type: ignore[return-value]


def column(*parts: tuple[int, int, float], unseen: tuple[int, int] = (0, 0)) -> np.ndarray:
    """The floor below a wall 4 m away; parts are rows and a depth."""
    made = np.where((FLOOR > 0) & (FLOOR < 4.0), FLOOR, 4.0)
    for begin, end, metres in parts:
        made[begin:end] = metres
    made[slice(*unseen)] = np.nan
    return made


def test_a_column_that_is_measured_is_clear_from_the_camera_on() -> None:
    assert view(column()) == pytest.approx((4.0, 0.0, math.inf), rel=0.01)


def test_what_is_too_near_for_the_camera_is_not_cleared() -> None:
    # A plate from 0.3 to 0.4 m, 0.2 m away, and the floor below it.
    distance, begin, end = view(column(unseen=(0, 90)))
    assert math.isinf(distance)
    assert begin == pytest.approx(0.5, rel=0.01)
    assert end == pytest.approx(FLOOR[90], rel=0.01)
    # A plate above the camera: everything below is seen.
    assert view(column(unseen=(0, 40)))[1] == pytest.approx(0.5, rel=0.01)
    assert view(column(unseen=(0, 40)), shortest=0.3)[1] == pytest.approx(0.3, rel=0.01)


def test_a_plate_stays_in_the_layer_when_it_becomes_too_near() -> None:
    geometry = GridGeometry(-1.0, -1.0, 0.05, 40, 100)
    costmap = Costmap(geometry, np.zeros((40, 100), dtype=np.int8), ("depth",), 0.2, 0.5)
    plate = geometry.cell(0.6, 0.0)
    seen = np.repeat(column((50, 66, 0.6))[:, None], 10, axis=1).astype(np.float32)
    costmap.observe("depth", view_of_depth(Pose2D(0.0, 0.0, 0.0), seen, MODEL, 0.4))
    near = np.repeat(column(unseen=(0, 90))[:, None], 10, axis=1).astype(np.float32)
    costmap.observe("depth", view_of_depth(Pose2D(0.4, 0.0, 0.0), near, MODEL, 0.4))
    costmap.update()
    assert costmap.is_occupied(*plate)
    # From farther away, the place is seen to be free.
    free = np.repeat(column()[:, None], 10, axis=1).astype(np.float32)
    costmap.observe("depth", view_of_depth(Pose2D(0.0, 0.0, 0.0), free, MODEL, 0.4))
    costmap.update()
    assert not costmap.is_occupied(*plate)


def test_what_is_not_measured_on_the_floor_is_not_cleared() -> None:
    # A black box 1.4 m away; the wall is seen above it.
    assert view(column(unseen=(45, 78)))[2] == pytest.approx(FLOOR[78], rel=0.01)


def test_farther_than_the_camera_measures_is_clear() -> None:
    distance, begin, end = view(column((0, 60, math.inf)))
    assert (distance, begin, end) == (math.inf, 0.0, math.inf)
    # Cameras that send no infinite depths.
    distance, begin, end = view(column(unseen=(0, 60)))
    assert math.isinf(distance) and begin == pytest.approx(0.5, rel=0.01) and end > 3.0


def test_a_single_row_of_the_floor_may_be_missing() -> None:
    assert view(column(unseen=(70, 71)))[2] == math.inf


@pytest.mark.parametrize("depth", [0.0, -1.0, -math.inf])
def test_depths_that_are_none_are_not_measured(depth: float) -> None:
    assert math.isnan(view(np.full(100, depth))[0])
