"""How a camera looks at the world: a pinhole, with the distortion its calibration tells. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from relay_protocol.errors import Invalid


class CameraModel(NamedTuple):
    """Of one size of picture.

    :ivar fx: focal length, pixels
    :ivar fy: the same for rows
    :ivar cx: column of the optical axis
    :ivar cy: its row
    :ivar distortion: as OpenCV has it, none for what was rectified
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def scaled(self, factor: float) -> CameraModel:
        """The same camera's, with pictures so many times as wide."""
        if factor == 1.0:
            return self
        # The middle of the first pixel lies at 0, so its edge at -0.5.
        cx, cy = ((at + 0.5) * factor - 0.5 for at in (self.cx, self.cy))
        return CameraModel(self.fx * factor, self.fy * factor, cx, cy, self.distortion)


def of_view(width: int, height: int, degrees: float) -> CameraModel:
    """A lens without distortion that sees so much from the left edge to the right.

    :param width: pixels
    :param height: pixels
    """
    focal = width / 2 / math.tan(math.radians(degrees) / 2)
    return CameraModel(focal, focal, (width - 1) / 2, (height - 1) / 2)


_MODELS = {"": (0,), "plumb_bob": (0, 4, 5), "rational_polynomial": (0, 8)}
"""Distortion models of sensor_msgs/CameraInfo that OpenCV's functions for pinholes take, by numbers they may have."""


def calibrated(matrix: Sequence[float], distortion: Sequence[float], model: str) -> CameraModel:
    """What sensor_msgs/CameraInfo tells.

    :param matrix: ``k``, nine numbers by row
    :param distortion: ``d``
    :param model: ``distortion_model``
    :raises Invalid: not calibrated, or a model that isn't known here
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
            f"distortion '{model[:40]}' of {len(numbers)} numbers is not known here; these are: {known}"
        )
    return CameraModel(fx, fy, cx, cy, numbers)
