"""Finds paths over a costmap by A*, in slices, so that a large map does not hold up what moves the robot. Pure."""

from __future__ import annotations

import heapq
import math

import numpy as np

from robot_client.navigation.costmap import INSCRIBED, OCCUPIED, Costmap
from robot_client.navigation.grid import Floats, Pose2D
from robot_client.navigation.outcome import ErrorCode, NavigationError

SLICE = 3000
"""Cells that are expanded at a time; about 15 ms."""

GOAL_TOLERANCE = 0.3
"""Metres: a goal that is not free is replaced by the nearest position that is, within this distance."""

ESCAPE = 0.4
"""Metres around the start within which positions that touch an obstacle may be crossed, to get away from it."""

_COST_WEIGHT = 4.0
"""A position at an obstacle is so many times as long as a free one, beside its own length."""
_ESCAPE_WEIGHT = 30.0
_ESCAPED = OCCUPIED + 1
"""Stands for a cost where the robot touches an obstacle, within :data:`ESCAPE` of the start."""


def _weight(cost: int) -> float:
    if cost == _ESCAPED:
        return _ESCAPE_WEIGHT
    return math.inf if cost >= INSCRIBED else 1.0 + _COST_WEIGHT * max(cost, 0) / INSCRIBED


_WEIGHTS = tuple(_weight(cost - 256 if cost > 127 else cost) for cost in range(256))
"""Factor of the length of a step into a cell, by the byte of its cost; infinite where the robot can't be."""

_DIAGONAL = math.sqrt(2.0)
_SMOOTHING = np.array((1.0, 2.0, 3.0, 2.0, 1.0)) / 9.0
_SMOOTHING_ROUNDS = 2


class PathSearch:
    """One search.

    :raises NavigationError: the start or the goal is outside the map, or not free
    """

    def __init__(self, costmap: Costmap, start: Pose2D, goal: Pose2D) -> None:
        self._geometry = costmap.geometry
        self._costmap = costmap
        self._ends = np.array((start[:2], goal[:2]))
        begin, end = self._start_cell(start), self._goal_cell(goal)
        self._width = self._geometry.columns + 2
        self._cells = self._copy_costs(begin)
        self._begin, self._end = (self._number(*each) for each in (begin, end))
        self._distances: dict[int, float] = {self._begin: 0.0}
        self._parents: dict[int, int] = {}
        self._closed: set[int] = set()
        self._open: list[tuple[float, int]] = [(0.0, self._begin)]

    def advance(self, expansions: int = SLICE) -> Floats | None:
        """Continue, and return the path when it is found, shape (n, 2), else ``None``.

        :raises NavigationError: there is no path
        """
        steps, cells = self._steps(), self._cells
        end_row, end_column = divmod(self._end, self._width)
        for _ in range(expansions):
            cell = self._next()
            if cell == self._end:
                return self._smoothed(self._trace())
            base = self._distances[cell]
            for offset, length in steps:
                other = cell + offset
                distance = base + length * _WEIGHTS[cells[other]]
                if distance < self._distances.get(other, math.inf):
                    self._distances[other], self._parents[other] = distance, cell
                    row, column = divmod(other, self._width)
                    along, across = abs(row - end_row), abs(column - end_column)
                    rest = max(along, across) + (_DIAGONAL - 1) * min(along, across)
                    heapq.heappush(self._open, (distance + rest, other))
        return None

    def _next(self) -> int:
        while self._open:
            cell = heapq.heappop(self._open)[1]
            if cell not in self._closed:
                self._closed.add(cell)
                return cell
        raise NavigationError(ErrorCode.NO_VALID_PATH, "no path leads to the goal")

    def _steps(self) -> list[tuple[int, float]]:
        width = self._width
        straight = [(offset, 1.0) for offset in (1, -1, width, -width)]
        return straight + [(offset, _DIAGONAL) for offset in (width + 1, width - 1, -width + 1, -width - 1)]

    def _number(self, row: int, column: int) -> int:
        return (row + 1) * self._width + column + 1

    def _start_cell(self, start: Pose2D) -> tuple[int, int]:
        cell = self._geometry.cell(start.x, start.y)
        if not self._geometry.contains(*cell):
            raise NavigationError(ErrorCode.START_OUTSIDE_MAP, "the robot is outside the map")
        return cell

    def _goal_cell(self, goal: Pose2D) -> tuple[int, int]:
        row, column = self._geometry.cell(goal.x, goal.y)
        if not self._geometry.contains(row, column):
            raise NavigationError(
                ErrorCode.GOAL_OUTSIDE_MAP, f"the goal ({goal.x:.2f}, {goal.y:.2f}) is outside the map"
            )
        if self._costmap.costs[row, column] < INSCRIBED:
            return row, column
        near = self._around((row, column), GOAL_TOLERANCE)
        rows, columns = np.nonzero(self._costmap.costs[near] < INSCRIBED)
        rows, columns = rows + near[0].start, columns + near[1].start
        distance = np.hypot(rows - row, columns - column) * self._geometry.resolution
        nearest = int(np.argmin(distance)) if len(distance) else -1
        if nearest < 0 or distance[nearest] > GOAL_TOLERANCE:
            raise NavigationError(
                ErrorCode.GOAL_OCCUPIED, f"the goal ({goal.x:.2f}, {goal.y:.2f}) is too near to an obstacle"
            )
        self._ends[1] = self._geometry.centres(rows[[nearest]], columns[[nearest]])[0]
        return int(rows[nearest]), int(columns[nearest])

    def _copy_costs(self, begin: tuple[int, int]) -> bytes:
        """Costs by cell, as indexes of :data:`_WEIGHTS`; sensors change the costmap while the search goes on.

        A border of blocked cells spares a check of each neighbour's row and column.
        """
        near = self._around(begin, ESCAPE)
        costs = np.pad(self._costmap.costs, 1, constant_values=OCCUPIED)
        around = costs[1:-1, 1:-1][near]
        around[(around >= INSCRIBED) & (around < OCCUPIED)] = _ESCAPED
        return costs.tobytes()

    def _around(self, cell: tuple[int, int], distance: float) -> tuple[slice, slice]:
        """Rows and columns within a distance, metres, of a cell in the map."""
        reach = math.ceil(distance / self._geometry.resolution)
        row, column = (slice(max(0, at - reach), at + reach + 1) for at in cell)
        return row, column

    def _trace(self) -> Floats:
        cells = [self._end]
        while cells[-1] != self._begin:
            cells.append(self._parents[cells[-1]])
        rows, columns = np.divmod(np.array(cells[::-1]), self._width)
        points = self._geometry.centres(rows - 1, columns - 1)
        points[0], points[-1] = self._ends
        return points

    def _smoothed(self, path: Floats) -> Floats:
        """Round the corners of a grid's path, except where that leads to an obstacle."""
        edge = len(_SMOOTHING) // 2
        if len(path) <= 2 * edge + 1:
            return path
        for _ in range(_SMOOTHING_ROUNDS):
            middle = np.stack([np.convolve(path[:, axis], _SMOOTHING, "valid") for axis in (0, 1)], axis=1)
            free = self._costmap.clearance_at(middle) > self._costmap.radius
            path[edge:-edge][free] = middle[free]
        return path
