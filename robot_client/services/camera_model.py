"""Camera models: a pinhole with the distortion of its calibration. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from relay_protocol.errors import Invalid


class CameraModel(NamedTuple):
    """Model for one image size.

    :ivar fx: focal length, pixels
    :ivar fy: the same for rows
    :ivar cx: column of the optical axis
    :ivar cy: its row
    :ivar distortion: OpenCV's coefficients; empty for rectified images
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def scaled(self, factor: float) -> CameraModel:
        """The model for images scaled by ``factor``."""
        if factor == 1.0:
            return self
        # The middle of the first pixel lies at 0, so its edge at -0.5.
        cx, cy = ((at + 0.5) * factor - 0.5 for at in (self.cx, self.cy))
        return CameraModel(self.fx * factor, self.fy * factor, cx, cy, self.distortion)


def of_view(width: int, height: int, degrees: float) -> CameraModel:
    """A model without distortion and with a given horizontal field of view.

    :param width: pixels
    :param height: pixels
    :param degrees: horizontal field of view
    """
    focal = width / 2 / math.tan(math.radians(degrees) / 2)
    return CameraModel(focal, focal, (width - 1) / 2, (height - 1) / 2)


_MODELS = {"": (0,), "plumb_bob": (0, 4, 5), "rational_polynomial": (0, 8)}
"""Supported distortion models of sensor_msgs/CameraInfo, with the numbers of coefficients they may have."""


def calibrated(matrix: Sequence[float], distortion: Sequence[float], model: str) -> CameraModel:
    """The model of a sensor_msgs/CameraInfo.

    :param matrix: ``k``, nine numbers by row
    :param distortion: ``d``
    :param model: ``distortion_model``
    :raises Invalid: not calibrated, or an unsupported distortion model
    """
    fx, _, cx, _, fy, cy = (float(each) for each in matrix[:6])
    if not (fx > 0 and fy > 0 and all(map(math.isfinite, (fx, fy, cx, cy)))):
        raise Invalid("the camera is not calibrated: its CameraInfo has no focal length")
    numbers = tuple(float(each) for each in distortion)
    if not any(numbers):
        return CameraModel(fx, fy, cx, cy)
    if len(numbers) not in _MODELS.get(model, ()) or not all(map(math.isfinite, numbers)):
        known = ", ".join(filter(None, _MODELS))
        raise Invalid(
            f"distortion '{model[:40]}' of {len(numbers)} numbers is not supported; supported are: {known}"
        )
    return CameraModel(fx, fy, cx, cy, numbers)


def distance_of(position: tuple[float, float, float]) -> float:
    """Metres from the camera to a position in its optical frame."""
    return math.hypot(*position)


def bearing_of(position: tuple[float, float, float]) -> float:
    """Radians from straight ahead to a position in the camera's optical frame, positive to the left."""
    x, _, z = position
    return math.atan2(-x, z)
