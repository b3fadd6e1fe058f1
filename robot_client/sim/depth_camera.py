"""The simulated depth camera: how far the world is in each pixel, cast analytically. Pure."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from robot_client.sim.camera import CAMERA_HEIGHT, VIEW_ANGLE, WALL_HEIGHT
from robot_client.sim.world import Floats, PlateHits, Pose, World

WIDTH, HEIGHT = 160, 120
"""Pixels."""
FOCAL = WIDTH / 2 / math.tan(VIEW_ANGLE / 2)
"""Focal length, pixels."""
NEAREST, FARTHEST = 0.15, 6.0
"""Depths that are measured, metres."""
NOISE = 0.002
"""Standard deviation at 1 m, metres; it grows with the square of the depth, as with stereo cameras."""


class SimDepthCamera:
    """Measures the robot's view; it looks straight ahead and level, from the place of the picture camera.

    :param seed: of the noise
    """

    def __init__(self, world: World, seed: int | None = None) -> None:
        self._world = world
        self._random = np.random.default_rng(seed)
        self._angles = np.arctan(((WIDTH - 1) / 2 - np.arange(WIDTH)) / FOCAL)
        self._straighten = np.cos(self._angles)
        self._lift: Floats = (((HEIGHT - 1) / 2 - np.arange(HEIGHT, dtype=np.float64)) / FOCAL)[:, None]
        floor = np.full((HEIGHT, 1), np.inf)
        np.divide(-CAMERA_HEIGHT, self._lift, out=floor, where=self._lift < 0)
        self._floor = floor

    def render(self, pose: Pose) -> npt.NDArray[np.uint16]:
        """Depth along the optical axis, millimetres (REP 118), shape (height, width); 0 without a measurement."""
        angles = pose.heading + self._angles
        walls = self._world.cast(pose.x, pose.y, angles).distance * self._straighten
        depth = np.where(CAMERA_HEIGHT + walls * self._lift <= WALL_HEIGHT, walls, np.inf)
        np.minimum(depth, self._floor, out=depth)
        for hits in self._world.cast_tables(pose.x, pose.y, angles):
            self._add_table(depth, hits)
        depth += (
            self._random.standard_normal(depth.shape, dtype=np.float32)
            * NOISE
            * np.minimum(depth, FARTHEST) ** 2
        )
        measured = (depth >= NEAREST) & (depth <= FARTHEST)
        return np.where(measured, np.minimum(depth, FARTHEST) * 1000, 0.0).astype(np.uint16)

    def _add_table(self, depth: Floats, hits: PlateHits) -> None:
        columns = np.flatnonzero(np.isfinite(hits.enter) | np.isfinite(hits.leg))
        if not len(columns):
            return
        straighten, lift, table = self._straighten[columns], self._lift, hits.table
        enter, leave, leg = (each[columns] * straighten for each in (hits.enter, hits.leave, hits.leg))
        # Depths at which the ray of a pixel is at the height of the plate's two faces.
        lower, upper = (table.underside - CAMERA_HEIGHT) / lift, (table.top - CAMERA_HEIGHT) / lift
        first = np.maximum(enter, np.minimum(lower, upper))
        last = np.minimum(leave, np.maximum(lower, upper))
        found = np.where(first < last, first, np.inf)
        at_leg = CAMERA_HEIGHT + np.where(np.isfinite(leg), leg, 0.0) * lift
        found = np.minimum(found, np.where((at_leg >= 0) & (at_leg <= table.underside), leg, np.inf))
        depth[:, columns] = np.minimum(depth[:, columns], found)
