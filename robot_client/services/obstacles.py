"""What is nearest in each direction, from a scan or a picture of depth. Pure."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from relay_protocol.errors import Invalid
from robot_client.camera.messages import Image
from robot_client.services.camera_model import CameraModel
from robot_client.services.health import Level, ServiceFinding

Floats = npt.NDArray[np.float64]
Depth = npt.NDArray[np.float32]

MOST_SECTORS = 360
MOST_RAYS = 100_000
AGREE = 20
"""Pixels of depth that must be as near before it counts: single ones are noise."""
LET_GO = 1.1
"""What was near is near until it is so many times as far as the threshold."""

_WHOLE_TURN = math.tau * 0.99


class Scan(NamedTuple):
    """One turn of a scanner, or a part of one.

    :ivar ranges: metres by ray
    :ivar begin: radians of the first ray from straight ahead, counter-clockwise
    :ivar step: radians from one ray to the next; less than zero for clockwise
    :ivar least: metres; what is nearer is there, and counts as so near
    :ivar most: metres; what is farther counts as nothing
    """

    ranges: Floats
    begin: float
    step: float
    least: float
    most: float


class ObstaclePosition(NamedTuple):
    """Where an obstacle is.

    :ivar distance: metres, along the floor
    :ivar bearing: radians from straight ahead, counter-clockwise
    """

    distance: float
    bearing: float


class Sectors(NamedTuple):
    """The nearest obstacle of each sector.

    :ivar first: radians of the middle of the first sector
    :ivar width: radians of each
    :ivar places: by sector; ``None`` where nothing is
    """

    first: float
    width: float
    places: tuple[ObstaclePosition | None, ...]

    @property
    def nearest(self) -> ObstaclePosition | None:
        """The nearest of all."""
        return min(filter(None, self.places), default=None)


class Band(NamedTuple):
    """Which heights are in the robot's way, metres over the floor.

    :ivar camera: height of the camera, which looks level
    :ivar low: what is lower the robot drives over
    :ivar high: what is higher it drives under
    """

    camera: float = 0.2
    low: float = 0.05
    high: float = 1.5


def of_scan(scan: Scan, count: int) -> Sectors:
    """The nearest obstacle of each sector of a scan.

    Of a whole turn one sector lies straight ahead; of less the field of view is divided evenly. What is too near
    to be measured (REP 117: ``-inf``, or less than the least) is as near as the least; zero, NaN and other numbers
    below zero were not measured.

    :param count: how many sectors
    :raises Invalid: the scan makes no sense, or not one ray says what is there
    """
    rays = len(scan.ranges)
    if not 0 < rays <= MOST_RAYS:
        raise Invalid(f"a scan of {rays} rays; there are 1 to {MOST_RAYS}")
    if not (math.isfinite(scan.begin) and 0 < abs(scan.step) <= math.tau):
        raise Invalid(f"a scan from {scan.begin} in steps of {scan.step} radians makes no sense")
    if not 0 <= scan.least < scan.most:
        raise Invalid(f"a scan of what is {scan.least} to {scan.most} m away makes no sense")
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
        met = known & (scan.ranges <= scan.most) & (scan.ranges < np.inf)
    if not known.any():
        raise Invalid(f"not one of the {rays} rays of the scan has measured anything")
    distances = np.maximum(scan.ranges[met], scan.least)
    return Sectors(first, width, _nearest(distances, bearings[met], index[met], count))


def of_depth(depth: Depth, lens: CameraModel, count: int, band: Band) -> Sectors:
    """The nearest obstacle of each sector of a picture of depth; floor and ceiling are left out.

    What is too near to be measured (REP 117: ``-inf``) is where the camera is: at its height, and no metres away.

    :param depth: metres along the optical axis, shape (height, width), NaN where nothing was measured
    :param lens: of this picture
    :param count: how many sectors
    :raises Invalid: fewer pixels than :data:`AGREE` say what is there
    """
    height, width = depth.shape
    # Bearings grow to the left, columns to the right.
    aside: Floats = (lens.cx - np.arange(width, dtype=np.float64)) / lens.fx
    bearings = np.arctan(aside)
    left, right = math.atan((lens.cx + 0.5) / lens.fx), math.atan((lens.cx - width + 0.5) / lens.fx)
    sector = (left - right) / count
    lifts = ((lens.cy - np.arange(height)) / lens.fy).astype(np.float32)
    with np.errstate(invalid="ignore"):
        touching = np.isneginf(depth)
        known = (depth > 0) | touching
        if np.count_nonzero(known) < AGREE:
            raise Invalid(
                f"fewer than {AGREE} pixels of the {width}×{height} of depth have measured anything"
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
    """The nearest place that enough pixels agree on.

    :param distances: metres by row and column, infinite where nothing is
    :param bearings: of the columns
    """
    if distances.size < AGREE:
        return None
    which = int(np.argpartition(distances, AGREE - 1, axis=None)[AGREE - 1])
    row, column = divmod(which, distances.shape[1])
    distance = float(distances[row, column])
    return ObstaclePosition(distance, float(bearings[column])) if math.isfinite(distance) else None


def metres(picture: Image) -> Depth:
    """Depth of a picture (REP 118): ``16UC1`` are millimetres, ``32FC1`` metres.

    :raises Invalid: another encoding, or fewer bytes than its size takes
    """
    kinds = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
    if picture.encoding not in kinds:
        raise Invalid(f"a picture of encoding '{picture.encoding}' has no depth; 16UC1 and 32FC1 have")
    kind = np.dtype(kinds[picture.encoding]).newbyteorder(">" if picture.big_endian else "<")
    if picture.step < picture.width * kind.itemsize or len(picture.pixels) < picture.step * picture.height:
        raise Invalid(
            f"{picture.width}×{picture.height} of {picture.encoding} take more bytes than there are"
        )
    values: npt.NDArray[Any] = np.ndarray(
        (picture.height, picture.width), kind, picture.pixels, strides=(picture.step, kind.itemsize)
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
    """Whether something is too near; it does not flicker at the threshold.

    :param threshold: metres
    """

    def __init__(self, threshold: float) -> None:
        self._threshold = threshold
        self.near = False

    def see(self, nearest: ObstaclePosition | None, least: float = 0.0) -> bool:
        """Look at what is nearest now.

        :param least: metres, the least that the sensor measures: what is as near as that may be nearer than any
            threshold, and is near
        :returns: whether the answer has changed
        """
        before = self.near
        limit = self._threshold * (LET_GO if before else 1.0)
        self.near = nearest is not None and (nearest.distance < limit or nearest.distance <= least)
        return self.near is not before


def finding(near: bool, nearest: ObstaclePosition | None) -> ServiceFinding:
    """What is said of it."""
    if nearest is None:
        return ServiceFinding(Level.OK, "nothing in sight")
    side = "left" if nearest.bearing >= 0 else "right"
    where = f"{nearest.distance:.2f} m away, {abs(math.degrees(nearest.bearing)):.0f}° to the {side}"
    values = {"distance_m": f"{nearest.distance:.3f}", "bearing_deg": f"{math.degrees(nearest.bearing):.1f}"}
    if near:
        return ServiceFinding(Level.WARN, f"an obstacle is near: {where}", values)
    return ServiceFinding(Level.OK, f"the nearest is {where}", values)
