"""Costs of a robot's positions: the map, what each sensor sees, and a margin around both. Pure.

Each sensor has a layer of its own and clears that alone. A scanner looks under a table and would clear the plate that
the depth camera has seen.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from robot_client.navigation.grid import Bools, Floats, GridGeometry

OCCUPIED, INSCRIBED, FREE, UNKNOWN = 100, 99, 0, -1
"""Costs as Nav2 publishes them: an obstacle, a position at which the robot touches one, free, not known."""

MAP_OCCUPIED = 65
"""Occupancies of a map from which a cell counts as an obstacle (the default of Nav2's map server)."""

SENSOR_RANGE = 3.0
"""Metres within which sensors mark and clear."""

_DECAY = 6.0
"""Slope of costs beyond the robot's radius, per metre."""
_MOST_NEAR = 98

_Area = tuple[slice, slice]
"""Rows and columns."""


class OccupancyMap(NamedTuple):
    """A map as it came.

    :ivar frame: its coordinate frame
    :ivar occupancy: 0 to 100, -1 not known, shape (rows, columns)
    """

    frame: str
    geometry: GridGeometry
    occupancy: npt.NDArray[np.int8]


class SensorView(NamedTuple):
    """What a sensor sees along rays from one point.

    :ivar origin: metres, in the map
    :ivar directions: absolute, radians, shape (n,)
    :ivar distances: metres to the nearest obstacle; ``inf`` where there is none; NaN: not measured
    :ivar clear_from: metres from which each ray is known to be free, shape (n,) or one for all
    :ivar clear_to: metres to which it is known to be free, at most the distance
    """

    origin: tuple[float, float]
    directions: Floats
    distances: Floats
    clear_from: Floats | float = 0.0
    clear_to: Floats | float = math.inf


class Costmap:
    """A map with layers of obstacles.

    :param occupancy: 0 to 100, -1 not known, shape (rows, columns)
    :param layers: names of the sensors
    :param radius: of the robot, metres
    :param inflation: metres from an obstacle within which positions cost
    """

    def __init__(
        self,
        geometry: GridGeometry,
        occupancy: npt.NDArray[np.int8],
        layers: tuple[str, ...],
        radius: float,
        inflation: float,
    ) -> None:
        self.geometry = geometry
        self.radius = radius
        self._inflation = inflation
        self._walls: Bools = occupancy >= MAP_OCCUPIED
        self._unknown: Bools = occupancy < 0
        self._layers: dict[str, Bools] = {name: np.zeros_like(self._walls) for name in layers}
        self.clearance = np.zeros(occupancy.shape, dtype=np.float32)
        """Metres from the middle of each cell to that of the nearest obstacle's."""
        self.costs = np.zeros(occupancy.shape, dtype=np.int8)
        """0 to 100, -1 not known."""
        self.update()

    def set_occupancy(self, occupancy: npt.NDArray[np.int8]) -> bool:
        """Replace the map by another of the same geometry; the layers stay. Whether it differs."""
        walls, unknown = occupancy >= MAP_OCCUPIED, occupancy < 0
        changed = (walls != self._walls) | (unknown != self._unknown)
        rows, columns = (np.flatnonzero(changed.any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return False
        self._walls, self._unknown = walls, unknown
        self._compute((slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)))
        return True

    def take_obstacles(self, other: Costmap) -> None:
        """Mark what the layers of a costmap of another geometry hold, as far as it is inside."""
        ratio = other.geometry.resolution / self.geometry.resolution
        parts = math.ceil(ratio - 1e-6)
        """A cell becomes several where this grid is finer: obstacles get no gaps."""
        aside = ((np.arange(parts) + 0.5) / parts - 0.5) * other.geometry.resolution
        shifts = np.stack(np.meshgrid(aside, aside), axis=-1).reshape(-1, 2)
        for name, marks in self._layers.items():
            centres = other.geometry.centres(*np.nonzero(other._layers[name]))
            for shift in shifts:
                marks[self.geometry.cells(centres + shift)] = True
        self.update()

    def observe(self, layer: str, view: SensorView) -> None:
        """Clear what a sensor sees through, and mark what it sees; :meth:`update` counts it in."""
        marks, step = self._layers[layer], self.geometry.resolution
        unit = np.stack((np.cos(view.directions), np.sin(view.directions)), axis=1)
        measured = ~np.isnan(view.distances)
        farthest = np.minimum(np.minimum(view.distances, view.clear_to), SENSOR_RANGE)
        end = np.where(measured, farthest, 0.0) - 1.5 * step
        begin = np.where(np.asarray(view.clear_from) > 0, np.add(view.clear_from, 1.5 * step), 0.0)
        begin = np.broadcast_to(begin, end.shape)
        reach = np.arange(0.0, SENSOR_RANGE, step / 2)
        rays, steps = np.nonzero((reach >= begin[:, None]) & (reach < end[:, None]))
        marks[self.geometry.cells(view.origin + unit[rays] * reach[steps, None])] = False
        with np.errstate(invalid="ignore"):
            hit = view.distances <= SENSOR_RANGE
        marks[self.geometry.cells(view.origin + unit[hit] * view.distances[hit, None])] = True

    def update(self, near: tuple[float, float] | None = None) -> None:
        """Compute costs and clearance from map and layers.

        :param near: a point, metres; only what a sensor there can have changed is computed. Clearances of more than
            inflation and radius may be too great then
        """
        self._compute(self._around(near, SENSOR_RANGE))

    def _compute(self, changed: _Area) -> None:
        """Compute what an area in which map or layers changed has an effect on."""
        inner = self._grown(changed, self._inflation)
        outer = self._grown(inner, self._inflation + self.radius)
        occupied = self._walls[outer].copy()
        if not occupied.size:
            return
        for layer in self._layers.values():
            occupied |= layer[outer]
        cells = cv2.distanceTransform((~occupied).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        part = tuple(
            slice(within.start - whole.start, within.stop - whole.start)
            for within, whole in zip(inner, outer, strict=True)
        )
        clearance = np.asarray(cells, dtype=np.float32)[part] * np.float32(self.geometry.resolution)
        self.clearance[inner] = clearance
        self.costs[inner] = self._costs_of(clearance, occupied[part], self._unknown[inner])

    def _grown(self, area: _Area, distance: float) -> _Area:
        """An area with what is within a distance of it, metres."""
        cells = math.ceil(distance / self.geometry.resolution)
        row, column = (
            slice(max(part.start - cells, 0), min(part.stop + cells, most))
            for part, most in zip(area, (self.geometry.rows, self.geometry.columns), strict=True)
        )
        return row, column

    def _around(self, near: tuple[float, float] | None, reach: float) -> _Area:
        """Rows and columns within a distance of a point; all without one."""
        geometry = self.geometry
        if near is None:
            return slice(0, geometry.rows), slice(0, geometry.columns)
        cells = round(reach / geometry.resolution)
        sides = zip(geometry.cell(*near), (geometry.rows, geometry.columns), strict=True)
        row, column = (
            slice(min(max(at - cells, 0), most), min(max(at + cells + 1, 0), most)) for at, most in sides
        )
        return row, column

    def _costs_of(
        self, clearance: npt.NDArray[np.float32], occupied: Bools, unknown: Bools
    ) -> npt.NDArray[np.int8]:
        beyond = clearance - np.float32(self.radius)
        costs = _MOST_NEAR * np.exp(-_DECAY * np.maximum(beyond, 0))
        costs[clearance > self._inflation] = FREE
        costs[beyond <= 0] = INSCRIBED
        costs[occupied] = OCCUPIED
        costs[unknown & (costs < INSCRIBED)] = UNKNOWN
        found: npt.NDArray[np.int8] = costs.astype(np.int8)
        return found

    def is_occupied(self, row: int, column: int) -> bool:
        """Whether an obstacle is in a cell."""
        return bool(self.costs[row, column] == OCCUPIED)

    def clearance_at(self, points: Floats) -> Floats:
        """Clearance at points, metres, shape (n,); 0 outside."""
        geometry = self.geometry
        columns = np.floor((points[:, 0] - geometry.x) / geometry.resolution).astype(np.int64)
        rows = np.floor((points[:, 1] - geometry.y) / geometry.resolution).astype(np.int64)
        inside = (rows >= 0) & (rows < geometry.rows) & (columns >= 0) & (columns < geometry.columns)
        found = np.zeros(len(points))
        found[inside] = self.clearance[rows[inside], columns[inside]]
        return found

    def window(self, x: float, y: float, side: float) -> tuple[GridGeometry, npt.NDArray[np.int8]]:
        """The part around a point, cut at the edges; ``side`` in metres."""
        geometry = self.geometry
        row, column = geometry.cell(x, y)
        half = round(side / 2 / geometry.resolution)
        top, left = (
            int(np.clip(at - half, 0, most))
            for at, most in ((row, geometry.rows), (column, geometry.columns))
        )
        costs = self.costs[top : max(row + half, top), left : max(column + half, left)]
        x, y = geometry.x + left * geometry.resolution, geometry.y + top * geometry.resolution
        return GridGeometry(x, y, geometry.resolution, costs.shape[0], costs.shape[1]), costs
