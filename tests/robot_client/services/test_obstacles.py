"""What is nearest in each direction."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest

from relay_protocol.errors import Invalid
from robot_client.camera.messages import Image
from robot_client.services import obstacles
from robot_client.services.camera_model import of_view
from robot_client.services.health import Level
from robot_client.services.obstacles import Band, ObstaclePosition, ProximityAlarm, Scan

LENS = of_view(160, 120, 60)


def scan(ranges: list[float], begin: float, step: float) -> Scan:
    return Scan(np.array(ranges), begin, step, 0.1, 10.0)


def turn(**at: float) -> Scan:
    """A whole turn of 360 rays from straight behind; what is met by degree."""
    ranges = [math.inf] * 360
    for degree, distance in at.items():
        ranges[(int(degree.replace("m", "-").lstrip("d")) + 180) % 360] = distance
    return scan(ranges, -math.pi, math.radians(1))


def test_of_a_whole_turn_a_sector_lies_straight_ahead() -> None:
    """What is 10 degrees to either side is in the sector in the middle, and so is the exact bearing."""
    found = obstacles.of_scan(turn(d10=2.0, dm10=3.0, d90=4.0), 12)
    assert found.first + 6 * found.width == pytest.approx(0.0)
    assert found.places[6] == (2.0, pytest.approx(math.radians(10)))
    assert found.places[9] == (4.0, pytest.approx(math.radians(90)))
    assert sum(each is not None for each in found.places) == 2
    assert found.nearest == found.places[6]


def test_what_is_behind_is_one_sector_across_the_end_of_the_scan() -> None:
    """The first sector is straight behind, on both sides of where the turn begins."""
    found = obstacles.of_scan(turn(d170=2.0, dm170=1.5), 12)
    assert found.places[0] == (1.5, pytest.approx(math.radians(-170)))
    assert found.places[1:] == (None,) * 11


def test_less_than_a_turn_is_divided_evenly() -> None:
    """Three sectors of 90 degrees are 30 each, the first to the right."""
    ranges = [math.inf] * 90
    ranges[5], ranges[85] = 1.0, 2.0
    found = obstacles.of_scan(scan(ranges, math.radians(-44.5), math.radians(1)), 3)
    assert found.width == pytest.approx(math.radians(30))
    assert found.first == pytest.approx(math.radians(-30))
    assert [each and each.distance for each in found.places] == [1.0, None, 2.0]


def test_a_scanner_that_turns_clockwise_is_read_the_other_way_round() -> None:
    """Its first ray is the leftmost."""
    ranges = [1.0] + [math.inf] * 89
    found = obstacles.of_scan(scan(ranges, math.radians(44.5), -math.radians(1)), 3)
    assert [each and each.distance for each in found.places] == [None, None, 1.0]


def test_what_was_not_measured_is_nothing() -> None:
    """Too far, infinite, zero and NaN are no obstacles, nor is a distance below zero."""
    found = obstacles.of_scan(scan([11.0, math.inf, 0.0, math.nan, -1.0, math.inf], 0.0, 0.1), 2)
    assert found.places == (None, None)
    assert found.nearest is None


@pytest.mark.parametrize("ray", [-math.inf, 0.05])
def test_what_is_too_near_to_be_measured_is_as_near_as_can_be(ray: float) -> None:
    """It is an obstacle at the least distance, at its bearing, and nearer than all that was measured."""
    found = obstacles.of_scan(scan([2.0, ray, 3.0, math.nan], 0.0, 0.1), 1)
    assert found.nearest == (0.1, pytest.approx(0.1))


@pytest.mark.parametrize("ray", [math.nan, 0.0, -1.0])
def test_a_scan_without_any_measurement_is_refused(ray: float) -> None:
    """It does not say that nothing is there; one ray into the distance does."""
    with pytest.raises(Invalid, match="not one of the 90 rays"):
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
def test_a_scan_that_makes_no_sense_is_refused(bad: Scan) -> None:
    """In words, not by a crash."""
    with pytest.raises(Invalid):
        obstacles.of_scan(bad, 4)


def wall(distance: float) -> np.ndarray:
    return np.full((120, 160), distance, np.float32)


def test_a_wall_of_depth_is_as_near_in_the_middle_and_farther_aside() -> None:
    """Depth is along the axis; what counts is the distance."""
    found = obstacles.of_depth(wall(2.0), LENS, 3, Band())
    assert found.places[1] is not None and found.places[1].distance == pytest.approx(2.0, rel=0.01)
    outer = [each for each in (found.places[0], found.places[2]) if each]
    assert [each.distance for each in outer] == [
        pytest.approx(2.0 / math.cos(math.radians(10)), rel=0.01)
    ] * 2
    assert outer[0].bearing < 0 < outer[1].bearing


def test_a_post_to_the_left_of_a_picture_has_a_bearing_to_the_left() -> None:
    """It is where the lens says, and all other sectors are empty."""
    depth = np.full((120, 160), np.nan, np.float32)
    depth[:, 20:30] = 1.5
    found = obstacles.of_depth(depth, LENS, 5, Band())
    assert [each is not None for each in found.places] == [False, False, False, False, True]
    nearest = found.nearest
    assert nearest is not None
    at = math.atan((LENS.cx - 29) / LENS.fx)
    assert nearest.bearing == pytest.approx(at, abs=0.01)
    assert nearest.distance == pytest.approx(1.5 / math.cos(at), rel=0.01)


def test_the_floor_is_no_obstacle_and_what_stands_on_it_is() -> None:
    """A camera 0.2 m over the floor sees the floor below its horizon, and a box of 0.1 m before it."""
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
    """Single pixels that are near do not count; the wall behind them does."""
    depth = wall(3.0)
    depth[60, :19] = 0.3
    found = obstacles.of_depth(depth, LENS, 1, Band()).nearest
    assert found is not None and found.distance > 2.9


def test_depth_too_near_to_be_measured_is_an_obstacle_before_the_camera() -> None:
    """No metres away, in its sector; unless the camera looks out over all that is in the robot's way."""
    depth = wall(3.0)
    depth[10:20, 140:] = -math.inf
    right, middle, left = obstacles.of_depth(depth, LENS, 3, Band()).places
    assert right is not None and (right.distance, right.bearing < 0) == (0.0, True)
    assert middle is not None and left is not None and min(middle.distance, left.distance) > 2.9
    lofty = obstacles.of_depth(depth, LENS, 3, Band(camera=2.0)).nearest
    assert lofty is None or lofty.distance > 2.9


@pytest.mark.parametrize("pixel", [math.nan, 0.0, -1.0])
def test_a_picture_without_any_depth_is_refused(pixel: float) -> None:
    """It does not say that nothing is there, nor do a few pixels of noise; as many far ones as agree do."""
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
    """Millimetres and metres; zero millimetres were not measured."""
    picture = Image(encoding, 2, 2, False, len(data) // 2, memoryview(data))
    np.testing.assert_allclose(obstacles.metres(picture).ravel(), expected)


def test_big_endian_rows_with_padding_are_read() -> None:
    """What pads a row is stepped over."""
    data = struct.pack(">3H", 1000, 2000, 9) + struct.pack(">3H", 3000, 4000, 9)
    picture = Image("16UC1", 2, 2, True, 6, memoryview(data))
    assert obstacles.metres(picture).tolist() == [[1.0, 2.0], [3.0, 4.0]]


@pytest.mark.parametrize(
    "picture",
    [
        Image("rgb8", 1, 1, False, 3, memoryview(b"abc")),
        Image("16UC1", 2, 2, False, 2, memoryview(b"abcdefgh")),
        Image("32FC1", 2, 2, False, 8, memoryview(b"abcdefgh")),
    ],
)
def test_a_picture_without_depth_or_too_small_is_refused(picture: Image) -> None:
    """In words."""
    with pytest.raises(Invalid):
        obstacles.metres(picture)


def test_nearness_does_not_flicker() -> None:
    """It begins below the threshold and ends a tenth above it."""
    near = ProximityAlarm(1.0)
    seen = [near.see(ObstaclePosition(distance, 0.0)) for distance in (1.2, 0.99, 1.05, 0.98, 1.11)]
    assert seen == [False, True, False, False, True]
    assert not near.near
    assert near.see(ObstaclePosition(0.5, 0.0)) and near.see(None)


def test_what_is_as_near_as_can_be_measured_is_near_below_any_threshold() -> None:
    """A scanner that measures from 0.6 m can't tell whether it is 0.5 m away, so it may be."""
    near = ProximityAlarm(0.5)
    assert not near.see(ObstaclePosition(0.61, 0.0), 0.6)
    assert near.see(ObstaclePosition(0.6, 0.0), 0.6) and near.near


def test_the_finding_says_where() -> None:
    """A warning when it is near, with distance and side."""
    found = obstacles.finding(True, ObstaclePosition(0.32, math.radians(-30)))
    assert (found.level, found.message) == (Level.WARN, "an obstacle is near: 0.32 m away, 30° to the right")
    assert obstacles.finding(False, None).level is Level.OK
