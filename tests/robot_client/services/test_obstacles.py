"""The nearest obstacle in each direction."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest

from relay_protocol.errors import Invalid
from robot_client.camera.images import ImageMessage
from robot_client.services import obstacles
from robot_client.services.camera_model import of_view
from robot_client.services.health import Level
from robot_client.services.obstacles import Band, ObstaclePosition, ProximityAlarm, Scan

LENS = of_view(160, 120, 60)


def scan(ranges: list[float], begin: float, step: float) -> Scan:
    return Scan(np.array(ranges), begin, step, 0.1, 10.0)


def turn(**at: float) -> Scan:
    """A full-circle scan of 360 rays that begins straight behind."""
    ranges = [math.inf] * 360
    for degree, distance in at.items():
        ranges[(int(degree.replace("m", "-").lstrip("d")) + 180) % 360] = distance
    return scan(ranges, -math.pi, math.radians(1))


def test_full_circle_has_a_sector_straight_ahead() -> None:
    found = obstacles.of_scan(turn(d10=2.0, dm10=3.0, d90=4.0), 12)
    assert found.first + 6 * found.width == pytest.approx(0.0)
    assert found.places[6] == (2.0, pytest.approx(math.radians(10)))
    assert found.places[9] == (4.0, pytest.approx(math.radians(90)))
    assert sum(each is not None for each in found.places) == 2
    assert found.nearest == found.places[6]


def test_full_circle_has_a_sector_straight_behind() -> None:
    found = obstacles.of_scan(turn(d170=2.0, dm170=1.5), 12)
    assert found.places[0] == (1.5, pytest.approx(math.radians(-170)))
    assert found.places[1:] == (None,) * 11


def test_smaller_field_of_view_is_divided_evenly() -> None:
    ranges = [math.inf] * 90
    ranges[5], ranges[85] = 1.0, 2.0
    found = obstacles.of_scan(scan(ranges, math.radians(-44.5), math.radians(1)), 3)
    assert found.width == pytest.approx(math.radians(30))
    assert found.first == pytest.approx(math.radians(-30))
    assert [each and each.distance for each in found.places] == [1.0, None, 2.0]


def test_clockwise_scans_are_read() -> None:
    ranges = [1.0] + [math.inf] * 89
    found = obstacles.of_scan(scan(ranges, math.radians(44.5), -math.radians(1)), 3)
    assert [each and each.distance for each in found.places] == [None, None, 1.0]


def test_unmeasured_ranges_are_no_obstacles() -> None:
    found = obstacles.of_scan(scan([11.0, math.inf, 0.0, math.nan, -1.0, math.inf], 0.0, 0.1), 2)
    assert found.places == (None, None)
    assert found.nearest is None


@pytest.mark.parametrize("ray", [-math.inf, 0.05])
def test_too_near_ranges_count_as_the_least_range(ray: float) -> None:
    found = obstacles.of_scan(scan([2.0, ray, 3.0, math.nan], 0.0, 0.1), 1)
    assert found.nearest == (0.1, pytest.approx(0.1))


@pytest.mark.parametrize("ray", [math.nan, 0.0, -1.0])
def test_scan_without_measurements_is_refused(ray: float) -> None:
    """One ray without a hit is a measurement."""
    with pytest.raises(Invalid, match="none of the 90 rays"):
        obstacles.of_scan(scan([ray] * 90, 0.0, 0.01), 4)
    for far in (math.inf, 11.0):
        assert obstacles.of_scan(scan([ray] * 89 + [far], 0.0, 0.01), 4).nearest is None


@pytest.mark.parametrize(
    "bad",
    [
        scan([], 0.0, 0.1),
        scan([1.0], 0.0, 0.0),
        scan([1.0], math.nan, 0.1),
        scan([1.0], 0.0, math.inf),
        scan([1.0], 0.0, 0.1)._replace(least=0.0, most=0.0),
        scan([1.0], 0.0, 0.1)._replace(least=math.nan),
        scan([1.0], 0.0, 0.1)._replace(most=math.nan),
        scan([1.0], 0.0, 0.1)._replace(least=-1.0),
    ],
)
def test_invalid_scans_are_refused(bad: Scan) -> None:
    with pytest.raises(Invalid):
        obstacles.of_scan(bad, 4)


def wall(distance: float) -> np.ndarray:
    return np.full((120, 160), distance, np.float32)


def test_distance_is_along_the_floor_not_along_the_axis() -> None:
    found = obstacles.of_depth(wall(2.0), LENS, 3, Band())
    assert found.places[1] is not None and found.places[1].distance == pytest.approx(2.0, rel=0.01)
    outer = [each for each in (found.places[0], found.places[2]) if each]
    assert [each.distance for each in outer] == [
        pytest.approx(2.0 / math.cos(math.radians(10)), rel=0.01)
    ] * 2
    assert outer[0].bearing < 0 < outer[1].bearing


def test_bearing_of_an_obstacle_in_a_depth_image() -> None:
    depth = np.full((120, 160), np.nan, np.float32)
    depth[:, 20:30] = 1.5
    found = obstacles.of_depth(depth, LENS, 5, Band())
    assert [each is not None for each in found.places] == [False, False, False, False, True]
    nearest = found.nearest
    assert nearest is not None
    at = math.atan((LENS.cx - 29) / LENS.fx)
    assert nearest.bearing == pytest.approx(at, abs=0.01)
    assert nearest.distance == pytest.approx(1.5 / math.cos(at), rel=0.01)


def test_floor_is_no_obstacle() -> None:
    """A box on it is one."""
    rows = np.arange(120)
    with np.errstate(divide="ignore"):
        floor = np.where(rows > LENS.cy, 0.2 * LENS.fy / (rows - LENS.cy), np.inf)
    depth = np.repeat(floor[:, None], 160, axis=1).astype(np.float32)
    assert obstacles.of_depth(depth, LENS, 3, Band()).nearest is None
    top, bottom = (round(LENS.cy + (0.2 - height) * LENS.fy / 1.0) for height in (0.1, 0.0))
    depth[top:bottom, 70:90] = 1.0
    found = obstacles.of_depth(depth, LENS, 3, Band()).nearest
    assert found is not None and found.distance == pytest.approx(1.0, rel=0.01)


def test_a_few_pixels_of_noise_are_no_obstacle() -> None:
    depth = wall(3.0)
    depth[60, :19] = 0.3
    found = obstacles.of_depth(depth, LENS, 1, Band()).nearest
    assert found is not None and found.distance > 2.9


def test_too_near_depth_is_an_obstacle_at_the_camera() -> None:
    """Unless the camera is above all obstacles."""
    depth = wall(3.0)
    depth[10:20, 140:] = -math.inf
    right, middle, left = obstacles.of_depth(depth, LENS, 3, Band()).places
    assert right is not None and (right.distance, right.bearing < 0) == (0.0, True)
    assert middle is not None and left is not None and min(middle.distance, left.distance) > 2.9
    lofty = obstacles.of_depth(depth, LENS, 3, Band(camera=2.0)).nearest
    assert lofty is None or lofty.distance > 2.9


@pytest.mark.parametrize("pixel", [math.nan, 0.0, -1.0])
def test_depth_image_without_measurements_is_refused(pixel: float) -> None:
    depth = wall(pixel)
    depth[60, :19] = math.inf
    with pytest.raises(Invalid, match="fewer than 20 pixels of the 160×120"):
        obstacles.of_depth(depth, LENS, 3, Band())
    depth[60, 19] = math.inf
    assert obstacles.of_depth(depth, LENS, 3, Band()).nearest is None


@pytest.mark.parametrize(
    ("encoding", "data", "expected"),
    [
        ("16UC1", struct.pack("<4H", 1500, 0, 65535, 1), [1.5, math.nan, 65.535, 0.001]),
        ("32FC1", struct.pack("<4f", 1.5, math.nan, math.inf, 0.25), [1.5, math.nan, math.inf, 0.25]),
    ],
)
def test_depth_is_read_from_both_encodings(encoding: str, data: bytes, expected: list[float]) -> None:
    picture = ImageMessage(encoding, 2, 2, False, len(data) // 2, memoryview(data))
    np.testing.assert_allclose(obstacles.metres(picture).ravel(), expected)


def test_big_endian_rows_with_padding_are_read() -> None:
    data = struct.pack(">3H", 1000, 2000, 9) + struct.pack(">3H", 3000, 4000, 9)
    picture = ImageMessage("16UC1", 2, 2, True, 6, memoryview(data))
    assert obstacles.metres(picture).tolist() == [[1.0, 2.0], [3.0, 4.0]]


@pytest.mark.parametrize(
    "picture",
    [
        ImageMessage("rgb8", 1, 1, False, 3, memoryview(b"abc")),
        ImageMessage("16UC1", 2, 2, False, 2, memoryview(b"abcdefgh")),
        ImageMessage("32FC1", 2, 2, False, 8, memoryview(b"abcdefgh")),
    ],
)
def test_other_encodings_and_short_images_are_refused(picture: ImageMessage) -> None:
    with pytest.raises(Invalid):
        obstacles.metres(picture)


def test_proximity_has_hysteresis() -> None:
    near = ProximityAlarm(1.0)
    seen = [near.update(ObstaclePosition(distance, 0.0)) for distance in (1.2, 0.99, 1.05, 0.98, 1.11)]
    assert seen == [False, True, False, False, True]
    assert not near.near
    assert near.update(ObstaclePosition(0.5, 0.0)) and near.update(None)


def test_least_range_of_the_sensor_always_counts_as_near() -> None:
    near = ProximityAlarm(0.5)
    assert not near.update(ObstaclePosition(0.61, 0.0), 0.6)
    assert near.update(ObstaclePosition(0.6, 0.0), 0.6) and near.near


def test_finding_has_distance_and_side() -> None:
    found = obstacles.finding(True, ObstaclePosition(0.32, math.radians(-30)))
    assert (found.level, found.message) == (Level.WARN, "an obstacle is near: 0.32 m away, 30° to the right")
    assert obstacles.finding(False, None).level is Level.OK
