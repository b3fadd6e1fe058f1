"""Finds ArUco markers in images, with their poses."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from robot_client.camera.formats import Pixels
from robot_client.services.camera_model import CameraModel, bearing_of, distance_of

DICTIONARIES = (
    *(f"{family}_{count}" for family in ("4X4", "5X5", "6X6", "7X7") for count in (50, 100, 250, 1000)),
    *("ARUCO_ORIGINAL", "APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11"),
)
"""Marker dictionaries of OpenCV."""


class SeenMarker(NamedTuple):
    """A marker in the camera's optical frame: x to the right, y down, z ahead (REP 103).

    :ivar number: the marker's own
    :ivar position: metres
    :ivar orientation: x, y, z, w; of a frame with x to the right of the marker, y up and z out of it
    """

    number: int
    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]

    @property
    def distance(self) -> float:
        """Metres from the camera."""
        return distance_of(self.position)

    @property
    def bearing(self) -> float:
        """Radians from straight ahead, positive to the left."""
        return bearing_of(self.position)


class Detector:
    """Finds markers.

    :param dictionary: one of :data:`DICTIONARIES`
    :param size: side of the black square, metres
    """

    def __init__(self, dictionary: str, size: float) -> None:
        family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
        settings = cv2.aruco.DetectorParameters()
        settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._detector = cv2.aruco.ArucoDetector(family, settings)
        half = size / 2
        # In the order of detected corners.
        self._corners = np.array(
            [(-half, half, 0.0), (half, half, 0.0), (half, -half, 0.0), (-half, -half, 0.0)]
        )

    def find(self, pixels: Pixels, model: CameraModel) -> list[SeenMarker]:
        """The markers in an image, sorted by number; of several with one number the nearest.

        :param pixels: BGR or grey
        :param model: camera model for this image size
        """
        grey: Any = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
        corners, numbers, _ = self._detector.detectMarkers(np.ascontiguousarray(grey))
        found: dict[int, SeenMarker] = {}
        for number, corner in zip([] if numbers is None else np.ravel(numbers), corners, strict=True):
            seen = self._place(int(number), np.asarray(corner, np.float64).reshape(4, 2), model)
            if seen and (seen.number not in found or seen.distance < found[seen.number].distance):
                found[seen.number] = seen
        return [found[number] for number in sorted(found)]

    def _place(self, number: int, corners: npt.NDArray[np.float64], model: CameraModel) -> SeenMarker | None:
        matrix = np.array([[model.fx, 0.0, model.cx], [0.0, model.fy, model.cy], [0.0, 0.0, 1.0]])
        # IPPE_SQUARE, meant for this, gives wrong rotations in OpenCV 5.0.0.
        done, turned, moved = cv2.solvePnP(
            self._corners, corners, matrix, np.array(model.distortion), flags=cv2.SOLVEPNP_SQPNP
        )
        x, y, z = (float(each) for each in np.ravel(moved)) if done else (0.0, 0.0, 0.0)
        if not z > 0:  # behind the camera
            return None
        return SeenMarker(number, (x, y, z), quaternion(np.ravel(turned)))


def quaternion(turned: npt.NDArray[Any]) -> tuple[float, float, float, float]:
    """Quaternion x, y, z, w of a rotation vector.

    :param turned: the axis; its length is the angle in radians
    """
    angle = float(np.linalg.norm(turned))
    if angle == 0.0:
        return (0.0, 0.0, 0.0, 1.0)
    x, y, z = (float(each) for each in turned * (math.sin(angle / 2) / angle))
    return (x, y, z, math.cos(angle / 2))
