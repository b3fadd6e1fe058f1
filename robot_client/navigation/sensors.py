"""Turns scans and depth images into what a costmap observes. Pure."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from robot_client.navigation.costmap import SensorView
from robot_client.navigation.grid import Floats, Pose2D
from robot_client.services.camera_model import CameraModel

LOW, HIGH = 0.06, 0.6
"""Heights above the floor that count as obstacles, metres: lower is driven over, higher is driven under."""

AGREEING = 2
"""Pixels of two columns that must agree on an obstacle, because single ones are noise."""

SHORTEST_DEPTH = 0.5
"""Metres, of a depth camera whose shortest range is not given."""

_COLUMNS = 2


def view_of_scan(pose: Pose2D, ranges: Floats, angles: Floats, farthest: float) -> SensorView:
    """What a flat scanner sees.

    :param pose: of the scanner, in the map
    :param ranges: metres by ray; infinite without an echo (REP 117)
    :param angles: of the rays, radians, counter-clockwise from straight ahead
    :param farthest: largest range, metres
    """
    with np.errstate(invalid="ignore"):
        distances = np.where(ranges > farthest, np.inf, ranges)
        distances = np.where(ranges > 0, distances, np.nan)
    return SensorView((pose.x, pose.y), pose.heading + angles, distances)


def view_of_depth(
    pose: Pose2D,
    depth: npt.NDArray[np.float32],
    model: CameraModel,
    camera_height: float,
    shortest: float = SHORTEST_DEPTH,
) -> SensorView:
    """What a level depth camera sees, between :data:`LOW` and :data:`HIGH`.

    A pixel without a measurement does not clear its ray: an obstacle there may be nearer than the shortest range,
    though the floor below it is measured.

    :param pose: of the camera, in the map; its heading is where the camera looks
    :param depth: metres along the optical axis, shape (height, width), NaN without a measurement; infinite:
        farther than it measures (REP 117)
    :param camera_height: metres above the floor
    :param shortest: the camera's shortest range, metres along the optical axis
    """
    height, width = depth.shape
    width -= width % _COLUMNS
    depth = depth[:, :width]
    depth = np.where(depth > 0, depth, np.float32(np.nan))
    aside = (model.cx - np.arange(width)) / model.fx
    lifts = ((model.cy - np.arange(height)) / model.fy)[:, None]
    with np.errstate(invalid="ignore"):
        heights = camera_height + depth * lifts
        inside = (heights >= LOW) & (heights <= HIGH)
    longer = np.sqrt(1 + aside**2)
    distance = np.where(inside, depth * longer, np.inf)
    pairs = distance.reshape(height, -1, _COLUMNS).transpose(1, 0, 2).reshape(width // _COLUMNS, -1)
    nearest = np.partition(pairs, AGREEING - 1, axis=1)[:, AGREEING - 1]
    measured = ~np.isnan(depth).all(axis=0).reshape(-1, _COLUMNS).any(axis=1)
    begin, end = _seen_through(
        depth, *_at_obstacle_height(lifts[:, 0].astype(np.float64), camera_height), shortest
    )
    bearings = np.arctan(aside).reshape(-1, _COLUMNS).mean(axis=1)
    return SensorView(
        (pose.x, pose.y),
        pose.heading + bearings,
        np.where(measured, nearest, math.nan).astype(np.float64),
        (begin * longer).reshape(-1, _COLUMNS).max(axis=1),
        (end * longer).reshape(-1, _COLUMNS).min(axis=1),
    )


def _at_obstacle_height(lifts: Floats, camera_height: float) -> tuple[Floats, Floats]:
    """Depths at which the ray of each row comes to an obstacle's height and leaves it; none: the first is greater."""
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = (LOW - camera_height) / lifts, (HIGH - camera_height) / lifts
    enter, leave = np.fmax(np.fmin(low, high), 0.0), np.fmax(low, high)
    inside = LOW <= camera_height <= HIGH
    level = lifts == 0
    enter[level], leave[level] = (0.0, math.inf) if inside else (math.inf, 0.0)
    return enter, leave


def _seen_through(
    depth: npt.NDArray[np.float32], enter: Floats, leave: Floats, shortest: float
) -> tuple[Floats, Floats]:
    """Depths from and to which each column is known to be free, as far as it meets no obstacle.

    A pixel without a measurement hides what is nearer than the shortest range; and, since most things stand on the
    floor, what is behind the place that the next measured pixel below shows.
    """
    unseen = np.isnan(depth) & (enter < leave)[:, None]
    near = unseen & (enter < shortest)[:, None]
    begin = np.where(near, np.minimum(leave, shortest)[:, None], 0.0).max(axis=0)
    begin[near.sum(axis=0) < AGREEING] = 0.0
    rows = np.where(np.isnan(depth), len(depth), np.arange(len(depth))[:, None])
    measured_row = np.minimum.accumulate(rows[::-1], axis=0)[::-1]
    """The row of the next measured pixel at or below each; beyond the last without one."""
    padded = np.vstack((depth, np.full((1, depth.shape[1]), np.nan, dtype=depth.dtype)))
    behind = np.maximum(np.take_along_axis(padded, measured_row, axis=0), enter[:, None])
    hidden = unseen & (behind < leave[:, None])
    end = np.where(hidden, behind, np.inf).min(axis=0)
    bottom = np.where(unseen & (measured_row == len(depth)), leave[:, None], 0.0).max(axis=0)
    return np.maximum(begin, bottom), end
