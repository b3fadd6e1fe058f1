"""Goals around the table of the navigation's measurement."""

from __future__ import annotations

import math
from itertools import pairwise

from bench.navigation import GOALS, around_the_table
from robot_client.sim.world import default


def test_each_straight_path_to_a_goal_leads_under_the_plate() -> None:
    (table,) = default().tables
    assert table.turn == 0.0
    goals = around_the_table()
    for begin, goal in pairwise([goals[-1], *goals]):
        path = [
            (begin.x + part / 100 * (goal.x - begin.x), begin.y + part / 100 * (goal.y - begin.y))
            for part in range(101)
        ]
        assert any(
            abs(x - table.x) < table.length / 2 and abs(y - table.y) < table.width / 2 for x, y in path
        )


def test_goals_differ_and_lie_in_both_directions_around_the_table() -> None:
    (table,) = default().tables
    goals = around_the_table()
    assert len({(goal.x, goal.y) for goal in goals}) == GOALS == len(goals)
    bearings = [math.atan2(goal.y - table.y, goal.x - table.x) for goal in goals]
    turns = [math.remainder(now - before, math.tau) for before, now in pairwise([bearings[-1], *bearings])]
    assert sum(turn > 0 for turn in turns) >= 8
    assert sum(turn < 0 for turn in turns) >= 8
