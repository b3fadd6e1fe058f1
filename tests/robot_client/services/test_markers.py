"""Markers in drawn images."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from robot_client.camera.formats import Pixels
from robot_client.services.camera_model import CameraModel, of_view
from robot_client.services.markers import DICTIONARIES, Detector, quaternion

LENS = of_view(640, 480, 75)
SIZE = 0.16


def drawn(
    number: int,
    at: tuple[float, float, float],
    turn: float = 0.0,
    model: CameraModel = LENS,
    onto: Pixels | None = None,
    dictionary: str = "4X4_50",
) -> Pixels:
    """Draw a marker as a camera would see it. :param at: its middle, metres to the right, down and ahead :param
    turn: radians about the vertical"""
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
    side, edge = 240, 60
    texture = cv2.copyMakeBorder(
        cv2.aruco.generateImageMarker(family, number, side),
        edge,
        edge,
        edge,
        edge,
        cv2.BORDER_CONSTANT,
        value=255,
    )
    half = SIZE / 2 * (1 + 2 * edge / side)
    corners = np.array([(-half, -half, 0.0), (half, -half, 0.0), (half, half, 0.0), (-half, half, 0.0)])
    turned = np.array([[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]])
    x, y, z = (corners @ turned.T + np.array(at)).T
    # Drawn larger and made smaller, so that edges are as smooth as a camera's.
    large = 4
    fine = model.scaled(large)
    pixels = np.stack((fine.fx * x / z + fine.cx, fine.fy * y / z + fine.cy), axis=1).astype(np.float32)
    whole = side + 2 * edge
    # Edges of the texture, not the middles of its outer pixels.
    square = np.array([(0, 0), (whole, 0), (whole, whole), (0, whole)], np.float32) - 0.5
    matrix = cv2.getPerspectiveTransform(square, pixels)
    size = (640 * large, 480 * large)
    there = cv2.warpPerspective(np.full_like(texture, 255), matrix, size)
    shown = cv2.warpPerspective(texture, matrix, size, borderMode=cv2.BORDER_REPLICATE)
    share = cv2.resize(there, (640, 480), interpolation=cv2.INTER_AREA) / 255
    before = np.full((480, 640), 170, np.uint8) if onto is None else onto
    after = share * cv2.resize(shown, (640, 480), interpolation=cv2.INTER_AREA) + (1 - share) * before
    return np.rint(after).astype(np.uint8)


@pytest.mark.parametrize("at", [(0.0, 0.0, 0.8), (0.3, -0.1, 1.5), (-0.9, 0.2, 2.0)])
def test_marker_is_found_at_its_position(at: tuple[float, float, float]) -> None:
    (seen,) = Detector("4X4_50", SIZE).find(drawn(7, at), LENS)
    assert seen.number == 7
    assert seen.distance == pytest.approx(math.hypot(*at), rel=0.02)
    assert seen.bearing == pytest.approx(math.atan2(-at[0], at[2]), abs=math.radians(0.5))


@pytest.mark.parametrize("turn", [-0.8, 0.5])
def test_orientation_of_a_marker_is_found(turn: float) -> None:
    (seen,) = Detector("4X4_50", SIZE).find(drawn(3, (0.1, 0.0, 0.8), turn), LENS)
    assert seen.distance == pytest.approx(math.hypot(0.1, 0.8), rel=0.02)
    x, y, z, w = seen.orientation
    out = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    assert out == pytest.approx((-math.sin(turn), 0.0, -math.cos(turn)), abs=0.06)


def test_several_markers_are_sorted_by_number() -> None:
    """Of two with one number the nearer counts."""
    picture = drawn(9, (-0.5, 0.0, 1.2))
    picture = drawn(2, (0.5, 0.0, 1.2), onto=picture)
    picture = drawn(9, (0.0, 0.2, 0.9), onto=picture)
    found = Detector("4X4_50", SIZE).find(np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)), LENS)
    assert [each.number for each in found] == [2, 9]
    assert found[1].distance == pytest.approx(math.hypot(0.2, 0.9), rel=0.02)


def test_no_marker_is_found_in_other_images() -> None:
    detector = Detector("4X4_50", SIZE)
    noise = np.random.default_rng(1).integers(0, 255, (480, 640), np.uint8)
    other = drawn(7, (0.0, 0.0, 0.8), dictionary="APRILTAG_36h11")
    for picture in (np.zeros((480, 640), np.uint8), noise, other):
        assert detector.find(picture, LENS) == []


def test_distortion_is_corrected() -> None:
    bent = CameraModel(400.0, 400.0, 319.5, 239.5, (-0.25, 0.05, 0.0, 0.0, 0.0))
    flat = drawn(5, (0.45, 0.25, 1.0), model=bent)
    matrix = np.array([[400.0, 0, 319.5], [0, 400.0, 239.5], [0, 0, 1]])
    rows, columns = np.mgrid[0:480, 0:640].astype(np.float32)
    points = np.stack((columns.ravel(), rows.ravel()), axis=1)[:, None, :]
    straight = cv2.undistortPoints(points, matrix, np.array(bent.distortion), P=matrix).reshape(480, 640, 2)
    seen_through = cv2.remap(
        flat, straight.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    detector = Detector("4X4_50", SIZE)
    (seen,) = detector.find(np.asarray(seen_through, np.uint8), bent)
    assert seen.position == pytest.approx((0.45, 0.25, 1.0), rel=0.02)
    (wrong,) = detector.find(np.asarray(seen_through, np.uint8), bent._replace(distortion=()))
    assert abs(wrong.distance - seen.distance) > 0.02


@pytest.mark.parametrize("name", DICTIONARIES)
def test_all_dictionaries_exist(name: str) -> None:
    assert Detector(name, SIZE).find(np.zeros((48, 64), np.uint8), LENS) == []


def test_quaternion_of_a_quarter_turn() -> None:
    assert quaternion(np.array([0.0, 0.0, math.pi / 2])) == pytest.approx((0, 0, 0.5**0.5, 0.5**0.5))
    assert quaternion(np.zeros(3)) == (0.0, 0.0, 0.0, 1.0)
