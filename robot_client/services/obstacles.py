"""Finds the nearest obstacle in each direction, from a scan or a depth image. Pure."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from relay_protocol.errors import Invalid
from robot_client.camera.images import ImageMessage
from robot_client.services.camera_model import CameraModel
from robot_client.services.health import Level, ServiceFinding

Floats = npt.NDArray[np.float64]
Depth = npt.NDArray[np.float32]

MAX_SECTORS = 360
MAX_RAYS = 100_000
MIN_PIXELS = 20
"""Depth pixels that must agree on an obstacle, because single ones are noise."""
HYSTERESIS = 1.1
"""An obstacle stays near until it is this many times as far as the threshold."""

_WHOLE_TURN = math.tau * 0.99


class Scan(NamedTuple):
    """One scan.

    :ivar ranges: metres by ray
    :ivar begin: radians of the first ray from straight ahead, counter-clockwise
    :ivar step: radians from one ray to the next; negative for clockwise
    :ivar least: least range, metres; nearer obstacles count as this far
    :ivar most: largest range, metres; farther obstacles do not count
    """

    ranges: Floats
    begin: float
    step: float
    least: float
    most: float


class ObstaclePosition(NamedTuple):
    """Position of an obstacle.

    :ivar distance: along the floor, metres
    :ivar bearing: radians from straight ahead, counter-clockwise
    """

    distance: float
    bearing: float


class Sectors(NamedTuple):
    """The nearest obstacle of each sector.

    :ivar first: centre of the first sector, radians
    :ivar width: width of each, radians
    :ivar places: by sector; ``None`` without an obstacle
    """

    first: float
    width: float
    places: tuple[ObstaclePosition | None, ...]

    @property
    def nearest(self) -> ObstaclePosition | None:
        """The nearest of all."""
        return min(filter(None, self.places), default=None)


class Band(NamedTuple):
    """Heights that count as obstacles, metres above the floor.

    :ivar camera: height of the camera, which must be level
    :ivar low: lower objects are driven over
    :ivar high: higher objects are driven under
    """

    camera: float = 0.2
    low: float = 0.05
    high: float = 1.5


def of_scan(scan: Scan, count: int) -> Sectors:
    """The nearest obstacle of each sector of a scan.

    A full-circle scan has one sector straight ahead; otherwise the field of view is divided evenly. Ranges too near to
    measure (REP 117: ``-inf``, or below the least) count as the least; zero, NaN and negative numbers mean no
    measurement.

    :param count: how many sectors
    :raises Invalid: the scan is invalid, or no ray has a measurement
    """
    rays = len(scan.ranges)
    if not 0 < rays <= MAX_RAYS:
        raise Invalid(f"a scan of {rays} rays; 1 to {MAX_RAYS} are supported")
    if not (math.isfinite(scan.begin) and 0 < abs(scan.step) <= math.tau):
        raise Invalid(f"a scan from {scan.begin} in steps of {scan.step} radians is invalid")
    if not 0 <= scan.least < scan.most:
        raise Invalid(f"a scan of what is {scan.least} to {scan.most} m is invalid")
    bearings: Floats = scan.begin + scan.step * np.arange(rays, dtype=np.float64)
    if rays * abs(scan.step) >= _WHOLE_TURN:
        width = math.tau / count
        first = -(count // 2) * width
        index = np.round((bearings - first) / width).astype(int) % count
    else:
        edges = sorted((bearings[0] - scan.step / 2, bearings[-1] + scan.step / 2))
        width = (edges[1] - edges[0]) / count
        first = edges[0] + width / 2
        index = ((bearings - edges[0]) / width).astype(int).clip(0, count - 1)
    with np.errstate(invalid="ignore"):
        known = (scan.ranges > 0) | np.isneginf(scan.ranges)
        hit = known & (scan.ranges <= scan.most) & (scan.ranges < np.inf)
    if not known.any():
        raise Invalid(f"none of the {rays} rays of the scan has a measurement")
    distances = np.maximum(scan.ranges[hit], scan.least)
    return Sectors(first, width, _nearest(distances, bearings[hit], index[hit], count))


def of_depth(depth: Depth, model: CameraModel, count: int, band: Band) -> Sectors:
    """The nearest obstacle of each sector of a depth image, without floor and ceiling.

    Depths too near to measure (REP 117: ``-inf``) count as 0 m away at the height of the camera.

    :param depth: metres along the optical axis, shape (height, width), NaN without a measurement
    :param model: camera model for this image size
    :param count: how many sectors
    :raises Invalid: fewer than :data:`MIN_PIXELS` pixels have a measurement
    """
    height, width = depth.shape
    # Bearings grow to the left, columns to the right.
    aside: Floats = (model.cx - np.arange(width, dtype=np.float64)) / model.fx
    bearings = np.arctan(aside)
    left, right = math.atan((model.cx + 0.5) / model.fx), math.atan((model.cx - width + 0.5) / model.fx)
    sector = (left - right) / count
    lifts = ((model.cy - np.arange(height)) / model.fy).astype(np.float32)
    with np.errstate(invalid="ignore"):
        touching = np.isneginf(depth)
        known = (depth > 0) | touching
        if np.count_nonzero(known) < MIN_PIXELS:
            raise Invalid(
                f"fewer than {MIN_PIXELS} pixels of the {width}×{height} depth image have a measurement"
            )
        depth = np.where(touching, np.float32(0), depth)
        heights = band.camera + depth * lifts[:, None]
        there = known & (heights >= band.low) & (heights <= band.high)
        distances = np.where(there, depth * np.sqrt(1 + aside**2).astype(np.float32), np.float32(np.inf))
    # The first column of each sector, from the leftmost.
    edges = np.searchsorted(-bearings, -(left - sector * np.arange(1, count)))
    found = [
        _agreed(block, bearings[first:])
        for first, block in zip([0, *edges], np.split(distances, edges, axis=1), strict=True)
    ]
    return Sectors(right + sector / 2, sector, tuple(reversed(found)))


def _agreed(distances: Depth, bearings: Floats) -> ObstaclePosition | None:
    """The nearest position on which enough pixels agree.

    :param distances: metres by row and column, infinite without an obstacle
    :param bearings: of the columns
    """
    if distances.size < MIN_PIXELS:
        return None
    which = int(np.argpartition(distances, MIN_PIXELS - 1, axis=None)[MIN_PIXELS - 1])
    row, column = divmod(which, distances.shape[1])
    distance = float(distances[row, column])
    return ObstaclePosition(distance, float(bearings[column])) if math.isfinite(distance) else None


def metres(image: ImageMessage) -> Depth:
    """Depth of an image (REP 118): ``16UC1`` are millimetres, ``32FC1`` metres.

    :raises Invalid: another encoding, or fewer bytes than its size takes
    """
    kinds = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
    if image.encoding not in kinds:
        raise Invalid(f"encoding '{image.encoding}' has no depth; use 16UC1 or 32FC1")
    kind = np.dtype(kinds[image.encoding]).newbyteorder(">" if image.big_endian else "<")
    if image.step < image.width * kind.itemsize or len(image.pixels) < image.step * image.height:
        raise Invalid(f"{image.width}×{image.height} of {image.encoding} needs more bytes than the image has")
    values: npt.NDArray[Any] = np.ndarray(
        (image.height, image.width), kind, image.pixels, strides=(image.step, kind.itemsize)
    )
    depth = values.astype(np.float32)
    if kind.kind == "u":
        depth[depth == 0] = np.nan
        depth /= 1000
    return depth


def _nearest(
    distances: Floats, bearings: Floats, index: npt.NDArray[np.int_], count: int
) -> tuple[ObstaclePosition | None, ...]:
    """:param index: the sector of each"""
    places: list[ObstaclePosition | None] = []
    for sector in range(count):
        inside = np.flatnonzero(index == sector)
        if len(inside):
            which = inside[np.argmin(distances[inside])]
            places.append(ObstaclePosition(float(distances[which]), float(bearings[which])))
        else:
            places.append(None)
    return tuple(places)


class ProximityAlarm:
    """Whether an obstacle is too near, with hysteresis.

    :param threshold: metres
    """

    def __init__(self, threshold: float) -> None:
        self._threshold = threshold
        self.near = False

    def update(self, nearest: ObstaclePosition | None, least: float = 0.0) -> bool:
        """Take the nearest obstacle now.

        :param least: least range of the sensor, metres; obstacles at this range always count as near
        :returns: whether the answer has changed
        """
        before = self.near
        limit = self._threshold * (HYSTERESIS if before else 1.0)
        self.near = nearest is not None and (nearest.distance < limit or nearest.distance <= least)
        return self.near is not before


def finding(near: bool, nearest: ObstaclePosition | None) -> ServiceFinding:
    """Diagnostics."""
    if nearest is None:
        return ServiceFinding(Level.OK, "no obstacle")
    side = "left" if nearest.bearing >= 0 else "right"
    where = f"{nearest.distance:.2f} m away, {abs(math.degrees(nearest.bearing)):.0f}° to the {side}"
    values = {"distance_m": f"{nearest.distance:.3f}", "bearing_deg": f"{math.degrees(nearest.bearing):.1f}"}
    if near:
        return ServiceFinding(Level.WARN, f"an obstacle is near: {where}", values)
    return ServiceFinding(Level.OK, f"the nearest is {where}", values)
