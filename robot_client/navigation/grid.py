"""Poses, and grids whose cells are squares of a plane. Metres and radians, counter-clockwise. Pure."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]


class Pose2D(NamedTuple):
    """A place and a direction in the plane."""

    x: float
    y: float
    heading: float

    def distance(self, x: float, y: float) -> float:
        """Metres to a point."""
        return math.hypot(x - self.x, y - self.y)

    def bearing(self, x: float, y: float) -> float:
        """Radians from straight ahead to a point, -π to π."""
        return angle_between(math.atan2(y - self.y, x - self.x), self.heading)

    def ahead(self, distance: float) -> Pose2D:
        """The pose so many metres straight ahead."""
        return Pose2D(
            self.x + distance * math.cos(self.heading),
            self.y + distance * math.sin(self.heading),
            self.heading,
        )


def angle_between(angle: float, other: float) -> float:
    """The difference of two directions, -π to π."""
    return math.remainder(angle - other, math.tau)


class GridGeometry(NamedTuple):
    """Where a grid lies.

    :ivar x: of the lower left corner, metres
    :ivar y: of the lower left corner, metres
    :ivar resolution: side of a cell, metres
    """

    x: float
    y: float
    resolution: float
    rows: int
    columns: int

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """Row and column of a point; it may be outside."""
        return math.floor((y - self.y) / self.resolution), math.floor((x - self.x) / self.resolution)

    def contains(self, row: int, column: int) -> bool:
        """Whether there is such a cell."""
        return 0 <= row < self.rows and 0 <= column < self.columns

    def cells(self, points: Floats) -> tuple[Ints, Ints]:
        """Rows and columns of the points that are inside; ``points`` has shape (n, 2)."""
        columns = np.floor((points[:, 0] - self.x) / self.resolution).astype(np.int64)
        rows = np.floor((points[:, 1] - self.y) / self.resolution).astype(np.int64)
        inside = (rows >= 0) & (rows < self.rows) & (columns >= 0) & (columns < self.columns)
        return rows[inside], columns[inside]

    def centres(self, rows: Ints, columns: Ints) -> Floats:
        """Middles of cells, shape (n, 2)."""
        return np.stack(
            (self.x + (columns + 0.5) * self.resolution, self.y + (rows + 0.5) * self.resolution), axis=1
        )
