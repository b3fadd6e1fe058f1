"""Scans and depth images as ROS messages, of known geometry."""

from __future__ import annotations

import array
import math

import numpy as np
import numpy.typing as npt
import pytest
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import CameraInfo, Image, LaserScan

from relay_protocol.errors import Invalid
from robot_client.navigation.costmap import SensorView
from robot_client.navigation.messages import depth_view, read_map, scan_view
from robot_client.navigation.transforms import matrix_of

FACING_NORTH = np.array(
    [
        [1.0, 0.0, 0.0, 1.0],  # an optical frame's x axis points to its right: east
        [0.0, 0.0, 1.0, 2.0],  # its z axis ahead: north
        [0.0, -1.0, 0.0, 0.4],  # its y axis down
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""Of a camera at (1, 2), 0.4 m high."""
FOCAL, WIDTH, HEIGHT = 100.0, 10, 100
BLANK = {"u2": 0, "f4": math.nan}


def camera_info(scale: int = 1) -> CameraInfo:
    """Of images that are so many times as large."""
    info = CameraInfo(width=WIDTH * scale, height=HEIGHT * scale)
    cx, cy = ((side * scale - 1) / 2 for side in (WIDTH, HEIGHT))
    info.k = np.array([FOCAL * scale, 0, cx, 0, FOCAL * scale, cy, 0, 0, 1], dtype=np.float64)
    return info


def image(encoding: str, kind: str, value: float, padding: int = 0) -> Image:
    """A plate before all columns, 40 to 54 cm high if it is 1.5 m away; nothing is measured elsewhere."""
    pixels = np.full((HEIGHT, WIDTH), BLANK[kind[1:]], dtype=kind)
    pixels[40:50] = value
    rows = b"".join(row.tobytes() + b"\xff" * padding for row in pixels)
    step = WIDTH * pixels.itemsize + padding
    big = int(kind[0] == ">")
    made = Image(encoding=encoding, width=WIDTH, height=HEIGHT, step=step, is_bigendian=big)
    made.data = array.array("B", rows)
    return made


def points(view: SensorView) -> npt.NDArray[np.float64]:
    """What a view hit, in the map."""
    unit = np.stack((np.cos(view.directions), np.sin(view.directions)), axis=1)
    return np.asarray(view.origin + unit * view.distances[:, None])


@pytest.mark.parametrize(
    ("encoding", "kind", "value", "padding"),
    [
        ("16UC1", "<u2", 1500, 0),
        ("16UC1", ">u2", 1500, 6),
        ("32FC1", "<f4", 1.5, 0),
        ("32FC1", ">f4", 1.5, 8),
    ],
    ids=["millimetres", "millimetres, big-endian, padded", "metres", "metres, big-endian, padded"],
)
@pytest.mark.parametrize("scale", [1, 2], ids=["as calibrated", "half as large as calibrated"])
def test_depth_image_is_placed_in_the_map(
    encoding: str, kind: str, value: float, padding: int, scale: int
) -> None:
    view = depth_view(image(encoding, kind, value, padding), camera_info(scale), FACING_NORTH)
    # Pairs of columns, from the left: the plate is 1.5 m north of the camera.
    expected = [(1 + 1.5 * column / FOCAL, 3.5) for column in (-4, -2, 0, 2, 4)]
    assert points(view) == pytest.approx(np.array(expected), abs=0.002)


def test_depth_counts_by_the_height_of_the_camera() -> None:
    higher = FACING_NORTH.copy()
    higher[2, 3] = 0.7
    assert np.isinf(depth_view(image("16UC1", "<u2", 1500), camera_info(), higher).distances).all()


@pytest.mark.parametrize(
    ("degrees", "refused"), [(4.0, False), (-4.0, False), (6.0, True), (-6.0, True), (180.0, True)]
)
def test_camera_is_level(degrees: float, refused: bool) -> None:
    half = math.radians(degrees) / 2
    tilted = FACING_NORTH @ matrix_of((0.0, 0.0, 0.0), (math.sin(half), 0.0, 0.0, math.cos(half)))
    if refused:
        with pytest.raises(Invalid, match="not level"):
            depth_view(image("16UC1", "<u2", 1500), camera_info(), tilted)
    else:
        assert len(depth_view(image("16UC1", "<u2", 1500), camera_info(), tilted).distances) == WIDTH // 2


@pytest.mark.parametrize(
    ("encoding", "cut", "calibrated"), [("rgb8", 0, True), ("16UC1", 1, True), ("16UC1", 0, False)]
)
def test_broken_depth_is_refused(encoding: str, cut: int, calibrated: bool) -> None:
    made = image("16UC1", "<u2", 1500)
    made.encoding, made.data = encoding, made.data[: len(made.data) - cut]
    with pytest.raises(Invalid):
        depth_view(made, camera_info() if calibrated else CameraInfo(), FACING_NORTH)


def test_scan_is_placed_in_the_map() -> None:
    quarter = math.sin(math.pi / 4)
    to_map = matrix_of((1.0, 2.0, 0.18), (0.0, 0.0, quarter, quarter))  # facing north
    scan = LaserScan(angle_min=-math.pi / 2, angle_increment=math.pi / 2, range_max=10.0)
    scan.ranges = array.array("f", [1.0, 2.0, 3.0, math.inf, 11.0])  # from its right, counter-clockwise
    view = scan_view(scan, to_map)
    assert points(view)[:3] == pytest.approx(np.array([(2.0, 2.0), (1.0, 4.0), (-2.0, 2.0)]), abs=1e-6)
    assert np.isinf(view.distances[3:]).all()


@pytest.mark.parametrize(
    ("rows", "columns", "reported"),
    [(4000, 4001, "at most 16,000,000 cells"), (0, 10, "invalid"), (4000, 4000, "invalid")],
    ids=["too large", "empty", "without data"],
)
def test_unusable_map_is_refused(rows: int, columns: int, reported: str) -> None:
    made = OccupancyGrid()
    made.info.height, made.info.width, made.info.resolution = rows, columns, 0.05
    with pytest.raises(Invalid, match=reported):
        read_map(made)
