"""Costs around walls, and what sensors mark and clear."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.navigation.costmap import FREE, INSCRIBED, OCCUPIED, UNKNOWN, Costmap, SensorView
from robot_client.navigation.grid import GridGeometry

GEOMETRY = GridGeometry(-1.0, -1.0, 0.1, 40, 60)
"""From (-1, -1) to (5, 3)."""


def costmap(*walls: tuple[float, float], unknown: tuple[float, float] | None = None) -> Costmap:
    occupancy = np.zeros((40, 60), dtype=np.int8)
    for wall in walls:
        occupancy[GEOMETRY.cell(*wall)] = 100
    if unknown:
        occupancy[GEOMETRY.cell(*unknown)] = -1
    return Costmap(GEOMETRY, occupancy, ("scan", "depth"), radius=0.25, inflation=0.6)


def cost(of: Costmap, x: float, y: float) -> int:
    of.update()
    return int(of.costs[GEOMETRY.cell(x, y)])


def ray(distance: float, bearing: float = 0.0) -> SensorView:
    return SensorView((0.05, 0.05), np.array([bearing]), np.array([distance]))


def test_costs_fall_with_the_distance_from_a_wall() -> None:
    made = costmap((2.05, 1.05), unknown=(4.55, 2.55))
    costs = [cost(made, 2.05 + 0.1 * step, 1.05) for step in range(8)]
    assert costs[0] == OCCUPIED
    assert costs[1:3] == [INSCRIBED, INSCRIBED]
    assert costs[3:7] == sorted(costs[3:7], reverse=True) and 0 < costs[6] < costs[3] < INSCRIBED
    assert costs[7] == FREE
    assert cost(made, 4.55, 2.55) == UNKNOWN


def test_a_sensor_marks_what_it_sees_and_clears_what_it_sees_through() -> None:
    made = costmap()
    made.observe("scan", ray(2.0))
    assert cost(made, 2.05, 0.05) == OCCUPIED
    made.observe("scan", ray(math.nan))
    assert cost(made, 2.05, 0.05) == OCCUPIED
    made.observe("scan", ray(math.inf))
    assert cost(made, 2.05, 0.05) == FREE


def test_a_ray_clears_only_where_it_is_known_to_be_free() -> None:
    made = costmap()
    for distance in (0.4, 1.0, 2.0):
        made.observe("depth", ray(distance)._replace(clear_to=0.0))
    made.observe("depth", ray(math.inf)._replace(clear_from=0.5, clear_to=1.6))
    assert [cost(made, 0.05 + distance, 0.05) == OCCUPIED for distance in (0.4, 1.0, 2.0)] == [
        True,
        False,
        True,
    ]


def test_the_scanner_does_not_clear_what_the_depth_camera_has_seen() -> None:
    made = costmap()
    made.observe("depth", ray(1.5))
    made.observe("scan", ray(math.inf))
    assert cost(made, 1.55, 0.05) == OCCUPIED
    made.observe("depth", ray(math.inf))
    assert cost(made, 1.55, 0.05) == FREE


def test_another_map_of_the_same_geometry_leaves_the_layers() -> None:
    made = costmap((1.05, 1.05))
    made.observe("depth", ray(2.0))
    occupancy = np.zeros((40, 60), dtype=np.int8)
    assert made.set_occupancy(occupancy)
    assert (cost(made, 2.05, 0.05), cost(made, 1.05, 1.05)) == (OCCUPIED, FREE)
    assert not made.set_occupancy(occupancy)


@pytest.mark.parametrize(
    "geometry",
    [
        GridGeometry(-2.0, -1.5, 0.1, 50, 80),
        GridGeometry(-1.0, -1.0, 0.04, 100, 150),
        GridGeometry(-1.02, -1.03, 0.25, 16, 24),
        GridGeometry(1.5, -0.2, 0.1, 10, 20),
    ],
    ids=["moved", "finer", "coarser", "smaller"],
)
def test_obstacles_are_taken_into_another_geometry(geometry: GridGeometry) -> None:
    old, new = (
        Costmap(each, np.zeros((each.rows, each.columns), dtype=np.int8), ("scan", "depth"), 0.25, 0.6)
        for each in (GEOMETRY, geometry)
    )
    old.observe("depth", SensorView((0.05, 0.05), np.array([0.0, 2.0]), np.array([2.0, 0.4])))
    new.take_obstacles(old)
    x = np.arange(2.01, 2.1, geometry.resolution)
    hit = np.unique(np.stack(geometry.cells(np.stack((x, np.full_like(x, 0.05)), axis=1))), axis=1)
    assert (new.costs[tuple(hit)] == OCCUPIED).all()
    # Each layer stays its sensor's: the scanner does not clear what the depth camera saw.
    new.observe("scan", ray(math.inf))
    new.update()
    assert new.is_occupied(*geometry.cell(2.05, 0.05))
    new.observe("depth", SensorView((1.55, 0.05), np.linspace(-0.2, 0.2, 60), np.full(60, math.inf)))
    new.update()
    assert not new.is_occupied(*geometry.cell(2.05, 0.05))


def test_sensors_do_not_clear_the_map() -> None:
    made = costmap((1.05, 0.05))
    made.observe("scan", ray(math.inf))
    assert cost(made, 1.05, 0.05) == OCCUPIED


def test_far_and_outside_hits_are_left_out() -> None:
    made = costmap()
    made.observe("scan", ray(3.5))
    made.observe("scan", ray(2.0, math.pi))
    made.update()
    assert not (made.costs == OCCUPIED).any()


@pytest.mark.parametrize(
    ("x", "y", "shape", "corner"), [(2.0, 1.0, (10, 10), (1.5, 0.5)), (-0.85, 2.85, (7, 6), (-1.0, 2.3))]
)
def test_window_is_cut_at_the_edges(
    x: float, y: float, shape: tuple[int, int], corner: tuple[float, float]
) -> None:
    geometry, costs = costmap().window(x, y, 1.0)
    assert costs.shape == shape == (geometry.rows, geometry.columns)
    assert (geometry.x, geometry.y) == pytest.approx(corner)


@pytest.mark.parametrize("origin", [(2.05, 1.05), (-0.95, -0.95), (4.5, 2.5), (20.0, 20.0)])
def test_costs_near_a_sensor_are_those_of_the_whole_map(origin: tuple[float, float]) -> None:
    large = GridGeometry(-10.0, -10.0, 0.1, 240, 240)
    occupancy = np.zeros((240, 240), dtype=np.int8)
    occupancy[np.random.default_rng(3).random((240, 240)) < 0.002] = 100
    near, whole = (Costmap(large, occupancy, ("scan",), 0.25, 0.6) for _ in range(2))
    bearings = np.linspace(-3.0, 3.0, 40)
    view = SensorView(origin, bearings, 1.5 + np.sin(5 * bearings))
    for each in (near, whole):
        each.observe("scan", view)
    near.update(origin)
    whole.update()
    assert (near.costs == whole.costs).all()
    close = whole.clearance < 0.6
    assert near.clearance[close].tolist() == whole.clearance[close].tolist()


@given(
    changes=st.dictionaries(
        st.tuples(st.integers(0, 39), st.integers(0, 59)),
        st.sampled_from([-1, 0, 100]),
        min_size=1,
        max_size=5,
    )
)
def test_costs_of_a_changed_map_are_those_of_a_new_one(changes: dict[tuple[int, int], int]) -> None:
    random = np.random.default_rng(3)
    before = random.choice(np.array([-1, 0, 100], dtype=np.int8), (40, 60), p=[0.1, 0.88, 0.02])
    after = before.copy()
    for cell, occupancy in changes.items():
        after[cell] = occupancy
    changed, new = (Costmap(GEOMETRY, each, (), 0.25, 0.6) for each in (before, after))
    assert changed.set_occupancy(after) == (before != after).any()
    assert (changed.costs == new.costs).all()
    close = new.clearance < 0.6
    assert changed.clearance[close].tolist() == new.clearance[close].tolist()


def test_only_what_a_changed_map_has_an_effect_on_is_computed() -> None:
    """It takes few bytes a cell; computing the whole takes many."""
    side = 1000
    geometry = GridGeometry(0.0, 0.0, 0.05, side, side)
    occupancy = np.zeros((side, side), dtype=np.int8)
    made = Costmap(geometry, occupancy, (), 0.25, 0.6)
    occupancy = occupancy.copy()
    occupancy[500, 500] = 100
    tracemalloc.start()
    try:
        assert made.set_occupancy(occupancy)
        assert tracemalloc.get_traced_memory()[1] < 6 * side * side
    finally:
        tracemalloc.stop()


def test_clearance_outside_is_zero() -> None:
    assert costmap((2.05, 1.05)).clearance_at(np.array([(9.0, 0.0), (2.05, 2.05)])).tolist() == pytest.approx(
        [0.0, 1.0]
    )
