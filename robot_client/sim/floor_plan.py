"""The map of a world, as a survey by scanner leaves it: walls and pillars, without furniture. Pure."""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from robot_client.sim.world import World

FINEST = 0.05
"""Side of a cell, metres; larger worlds have larger cells."""
MOST_CELLS = 250_000
MARGIN = 0.2
"""Metres around the outermost walls."""
OCCUPIED, FREE = 100, 0
_CHUNK = 20_000
"""Cells at a time, to bound the memory."""


class FloorPlan(NamedTuple):
    """A grid.

    :ivar x: of its lower left corner, metres
    :ivar y: of its lower left corner, metres
    :ivar resolution: side of a cell, metres
    :ivar cells: rows from the lowest y up, shape (rows, columns)
    """

    x: float
    y: float
    resolution: float
    cells: npt.NDArray[np.int8]


@cache
def floor_plan(world: World) -> FloorPlan:
    """Draw the map of a world."""
    low, high = world.bounds()
    low, high = low - MARGIN, high + MARGIN
    resolution = max(FINEST, math.sqrt(float(np.prod(high - low)) / MOST_CELLS))
    columns, rows = (int(each) for each in np.ceil((high - low) / resolution))
    x = low[0] + (np.arange(columns) + 0.5) * resolution
    y = low[1] + (np.arange(rows) + 0.5) * resolution
    points = np.stack([each.ravel() for each in np.meshgrid(x, y)], axis=1)
    chunks = [world.wall_distance(points[at : at + _CHUNK]) for at in range(0, len(points), _CHUNK)]
    near = np.concatenate(chunks) < resolution * 0.71
    cells = np.where(near, OCCUPIED, FREE).astype(np.int8).reshape(rows, columns)
    return FloorPlan(float(low[0]), float(low[1]), resolution, cells)
