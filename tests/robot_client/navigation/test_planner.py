"""Paths over small maps."""

from __future__ import annotations

import heapq
import itertools
import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.navigation import planner
from robot_client.navigation.costmap import Costmap
from robot_client.navigation.grid import Floats, GridGeometry, Pose2D
from robot_client.navigation.outcome import ErrorCode, NavigationError
from robot_client.navigation.planner import PathSearch

_STEPS = [(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1) if row or column]

GEOMETRY = GridGeometry(0.0, 0.0, 0.1, 50, 50)
"""5 × 5 m."""
START = Pose2D(0.55, 2.55, 0.0)


def costmap(*walls: tuple[slice, slice]) -> Costmap:
    """:param walls: rows and columns that are occupied"""
    occupancy = np.zeros((50, 50), dtype=np.int8)
    for wall in walls:
        occupancy[wall] = 100
    return Costmap(GEOMETRY, occupancy, (), radius=0.25, inflation=0.5)


def plan(costs: Costmap, goal: Pose2D, start: Pose2D = START, expansions: int = 1000) -> Floats:
    search = PathSearch(costs, start, goal)
    while True:
        path = search.advance(expansions)
        if path is not None:
            return path


def length(path: Floats) -> float:
    return float(np.hypot(*np.diff(path, axis=0).T).sum())


def test_free_path_is_straight_and_has_the_very_ends() -> None:
    goal = Pose2D(4.52, 2.58, 0.0)
    path = plan(costmap(), goal)
    assert length(path) == pytest.approx(3.97, abs=0.1)
    assert path[[0, -1]].tolist() == [list(START[:2]), list(goal[:2])]


def test_path_goes_through_the_gap_with_room_on_both_sides() -> None:
    costs = costmap(
        (slice(0, 30), slice(24, 26)), (slice(42, 50), slice(24, 26))
    )  # a gap of 1.2 m at y = 3.6
    path = plan(costs, Pose2D(4.55, 2.55, 0.0))
    assert (costs.clearance_at(path) > 0.25).all()
    at_gap = path[np.argmin(np.abs(path[:, 0] - 2.5))]
    assert at_gap[1] == pytest.approx(3.6, abs=0.25)


@pytest.mark.parametrize("expansions", [1, 7, 100_000])
def test_slices_do_not_change_the_path(expansions: int) -> None:
    costs = costmap((slice(10, 50), slice(24, 26)))
    path = plan(costs, Pose2D(4.55, 4.55, 0.0), expansions=expansions)
    assert path.tolist() == plan(costs, Pose2D(4.55, 4.55, 0.0)).tolist()


@pytest.mark.parametrize(
    ("start", "goal", "code"),
    [
        (START, Pose2D(9.0, 1.0, 0.0), ErrorCode.GOAL_OUTSIDE_MAP),
        (Pose2D(-1.0, 1.0, 0.0), Pose2D(4.5, 1.0, 0.0), ErrorCode.START_OUTSIDE_MAP),
        (START, Pose2D(2.5, 2.5, 0.0), ErrorCode.GOAL_OCCUPIED),
        (START, Pose2D(4.5, 1.0, 0.0), ErrorCode.NO_VALID_PATH),
    ],
)
def test_goals_that_cannot_be_reached(start: Pose2D, goal: Pose2D, code: ErrorCode) -> None:
    costs = costmap((slice(0, 50), slice(20, 30)))  # a wall of 1 m across everything
    with pytest.raises(NavigationError) as raised:
        plan(costs, goal, start)
    assert raised.value.error_code is code


def test_goal_at_a_wall_is_replaced_by_the_nearest_free_place() -> None:
    costs = costmap((slice(0, 50), slice(40, 50)))
    path = plan(costs, Pose2D(3.85, 2.55, 0.0))  # 0.2 m from the wall, which is too near
    assert path[-1].tolist() == pytest.approx([3.75, 2.55], abs=0.06)


def test_robot_that_touches_an_obstacle_gets_away_from_it() -> None:
    costs = costmap((slice(0, 50), slice(0, 4)))
    path = plan(costs, Pose2D(4.55, 2.55, 0.0), start=Pose2D(0.45, 2.55, 0.0))
    assert length(path) == pytest.approx(4.1, abs=0.15)


def weight(costs: Costmap, cell: tuple[int, int], start: tuple[int, int]) -> float:
    """The factor by which a step into a cell is longer."""
    cost = float(costs.costs[cell])
    escape = math.ceil(planner.ESCAPE / costs.geometry.resolution)
    if cost == 99 and max(abs(cell[axis] - start[axis]) for axis in (0, 1)) <= escape:
        return 30.0
    return math.inf if cost >= 99 else 1.0 + 4.0 * max(cost, 0.0) / 99


def cheapest(costs: Costmap, start: tuple[int, int], goal: tuple[int, int]) -> float:
    """The length of the cheapest path by Dijkstra's search; infinite without one."""
    reached, waiting = {start: 0.0}, [(0.0, start)]
    while waiting:
        so_far, cell = heapq.heappop(waiting)
        if cell == goal:
            return so_far
        for row, column in _STEPS:
            other = (cell[0] + row, cell[1] + column)
            if costs.geometry.contains(*other):
                there = so_far + math.hypot(row, column) * weight(costs, other, start)
                if there < reached.get(other, math.inf):
                    reached[other] = there
                    heapq.heappush(waiting, (there, other))
    return math.inf


def price(costs: Costmap, path: Floats) -> float:
    """The length of a path through the middles of cells."""
    cells = [costs.geometry.cell(x, y) for x, y in path.tolist()]
    return sum(
        math.dist(before, after) * weight(costs, after, cells[0])
        for before, after in itertools.pairwise(cells)
    )


@given(
    rows=st.integers(3, 25),
    columns=st.integers(3, 25),
    walls=st.sets(st.tuples(st.integers(0, 24), st.integers(0, 24)), max_size=25),
    unknown=st.sets(st.tuples(st.integers(0, 24), st.integers(0, 24)), max_size=50),
    ends=st.tuples(*[st.floats(0.0, 1.0, exclude_max=True)] * 4),
)
def test_no_path_is_cheaper(
    rows: int,
    columns: int,
    walls: set[tuple[int, int]],
    unknown: set[tuple[int, int]],
    ends: tuple[float, float, float, float],
) -> None:
    occupancy = np.zeros((rows, columns), dtype=np.int8)
    for cells, value in ((unknown, -1), (walls, 100)):
        for row, column in cells:
            if row < rows and column < columns:
                occupancy[row, column] = value
    costs = Costmap(GridGeometry(0.0, 0.0, 0.1, rows, columns), occupancy, (), radius=0.12, inflation=0.3)
    start, goal = (Pose2D(ends[at] * columns * 0.1, ends[at + 1] * rows * 0.1, 0.0) for at in (0, 2))
    from_cell, to_cell = (costs.geometry.cell(each.x, each.y) for each in (start, goal))
    if costs.costs[to_cell] >= 99:
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planner, "_SMOOTHING_ROUNDS", 0)
        try:
            found = price(costs, plan(costs, goal, start))
        except NavigationError:
            found = math.inf
    assert found == pytest.approx(cheapest(costs, from_cell, to_cell))


def test_obstacles_that_come_meanwhile_do_not_change_the_path() -> None:
    goal = Pose2D(4.55, 2.55, 0.0)
    costs = costmap()
    search = PathSearch(costs, START, goal)
    occupancy = np.zeros((50, 50), dtype=np.int8)
    occupancy[10:40, 20:30] = 100
    assert costs.set_occupancy(occupancy)
    while (path := search.advance(10)) is None:
        pass
    assert length(path) == pytest.approx(length(plan(costmap(), goal)), abs=0.05)


@pytest.mark.parametrize("goal", [(40.0, 40.0), (40.0, 49.7)], ids=["free", "at a wall"])
def test_a_search_begins_without_long_work_on_each_cell_of_a_large_map(goal: tuple[float, float]) -> None:
    """It keeps few bytes a cell. What made an object of each cell took a second on the largest maps."""
    side = 1000
    occupancy = np.zeros((side, side), dtype=np.int8)
    occupancy[-1] = 100
    costs = Costmap(GridGeometry(0.0, 0.0, 0.05, side, side), occupancy, (), radius=0.25, inflation=0.5)
    tracemalloc.start()
    try:
        PathSearch(costs, START, Pose2D(*goal, 0.0))
        assert tracemalloc.get_traced_memory()[1] < 4 * side * side
    finally:
        tracemalloc.stop()
