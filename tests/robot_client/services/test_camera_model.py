"""Camera models."""

from __future__ import annotations

import math

import pytest

from relay_protocol.errors import Invalid
from robot_client.services import camera_model

K = (600.0, 0.0, 320.0, 0.0, 610.0, 240.0, 0.0, 0.0, 1.0)


def test_focal_length_of_a_view_of_ninety_degrees() -> None:
    """Half the width."""
    found = camera_model.of_view(640, 480, 90)
    assert found.fx == found.fy == pytest.approx(320)
    assert (found.cx, found.cy) == (319.5, 239.5)


def test_calibration_is_read() -> None:
    """Zeros are no distortion."""
    assert camera_model.calibrated(K, (0.1, 0.0, 0.0, 0.0, 0.0), "plumb_bob").distortion == (
        0.1,
        0.0,
        0.0,
        0.0,
        0.0,
    )
    assert camera_model.calibrated(K, (0.0,) * 5, "") == (600.0, 610.0, 320.0, 240.0, ())


@pytest.mark.parametrize(
    ("matrix", "distortion", "model"),
    [
        ((0.0,) * 9, (), ""),
        ((math.nan, *K[1:]), (), "plumb_bob"),
        (K, (0.1,) * 4, "equidistant"),
        (K, (0.1,) * 3, "plumb_bob"),
        (K, (math.nan,) * 5, "plumb_bob"),
    ],
)
def test_invalid_calibrations_are_refused(
    matrix: tuple[float, ...], distortion: tuple[float, ...], model: str
) -> None:
    with pytest.raises(Invalid):
        camera_model.calibrated(matrix, distortion, model)


def test_model_scales_with_the_image() -> None:
    half = camera_model.of_view(640, 480, 90).scaled(0.5)
    assert half[:4] == pytest.approx(camera_model.of_view(320, 240, 90)[:4])
