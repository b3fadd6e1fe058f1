"""Goals around a table that the scanner sees as four thin legs: with the depth camera and without.

Simulator, daemon, navigator and relay are processes, goals come by rosbridge, and time is real. Then the robot is
stopped in the middle of goals, and its navigator is killed or frozen: from there to standstill, by the base's own
record.
"""

from __future__ import annotations

import contextlib
import importlib.util
import math
import os
import signal
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from bench.cpu import measured
from bench.report import Options, Row, Unavailable
from robot_client.navigation.grid import Pose2D
from robot_client.sim.world import default
from tests.worlds.navigating_robot import ACTION, NavigatingRobot, press_stop
from tests.worlds.processes import running
from tests.worlds.sync_client import Client
from tests.worlds.waiting import freeze, wait_for

GOALS = 20
GOAL_SECONDS = 60.0
"""A goal that is not reached by then is cancelled, and counts as not reached."""
STOP_BAR_MS, FAULT_BAR_MS = 100, 520

STATUS_SUCCEEDED = 4
"""Of action_msgs/msg/GoalStatus."""

BEARINGS = (9, 18, 7, 16, 5, 14, 3, 12, 1, 10, 2, 13, 4, 15, 6, 17, 8, 19, 11, 0)
"""Of the goals from the table's middle, in twentieths of a turn: each once. From one to the next it is nearly half a
turn, to the left for the first ten, mostly to the right for the others; the last is also where the first drive starts.
"""
DISTANCES = (0.5, 0.35, 0.6)
"""Metres from the table's edge to the middle of the robot at a goal, in turn. Its body has a radius of 0.2 m."""


def around_the_table() -> list[Pose2D]:
    """Goals on all sides of the default world's table. Straight paths between them lead under its plate.

    At some the robot faces the table, at others the room or along the table.
    """
    (table,) = default().tables
    goals = []
    for number, bearing in enumerate(BEARINGS):
        angle = math.tau * bearing / len(BEARINGS)
        distance = DISTANCES[number % len(DISTANCES)]
        length, width = table.length / 2 + distance, table.width / 2 + distance
        out = 1 / max(abs(math.cos(angle)) / length, abs(math.sin(angle)) / width)
        heading = math.remainder(angle + number * math.pi / 2, math.tau)
        goals.append(Pose2D(table.x + out * math.cos(angle), table.y + out * math.sin(angle), heading))
    return goals


class GoalDrive(NamedTuple):
    """One goal and how it was driven.

    :ivar end: how it ended, in words
    :ivar seconds: from sending it to its result
    :ivar metres: driven, by the poses of its feedback
    :ivar collisions: contacts of the body, by the simulator's record
    """

    goal: Pose2D
    arrived: bool
    end: str
    seconds: float
    metres: float
    collisions: int


class GoalDriver:
    """Drives a robot to goals, one after another, as an operator at the relay."""

    def __init__(self, robot: NavigatingRobot, client: Client) -> None:
        self._robot = robot
        self._client = client

    def drive(self, goal: Pose2D, number: int, most_seconds: float) -> GoalDrive:
        """Send a goal and wait for its end; after ``most_seconds`` it is cancelled."""
        began_ns, began, id = time.monotonic_ns(), time.monotonic(), f"goal-{number}"
        came = self._robot.give(self._client, (goal.x, goal.y), id, goal.heading)
        metres, last, cancelled = 0.0, _place(came[-1]), False
        while True:
            message = self._client.receive()
            late = time.monotonic() - began > most_seconds
            if late and not cancelled:
                self._client.send(op="cancel_action_goal", action=ACTION, id=id)
                cancelled = True
            if message.get("id") != id:
                continue
            if message["op"] == "action_result":
                break
            place = _place(message)
            metres, last = metres + math.dist(last, place), place
        seconds = time.monotonic() - began
        wait_for("the robot stands", lambda: not self._robot.robot.moving())
        arrived = message.get("status") == STATUS_SUCCEEDED
        end = "arrived" if arrived else "not there in time" if cancelled else str(message["values"])
        collisions = len(self._robot.robot.events("bump", began_ns))
        return GoalDrive(goal, arrived, end, seconds, metres, collisions)


def _place(feedback: dict[str, Any]) -> tuple[float, float]:
    position = feedback["values"]["current_pose"]["pose"]["position"]
    return position["x"], position["y"]


def drives(count: int, navigator: tuple[str, ...], most_seconds: float) -> tuple[list[GoalDrive], float]:
    """Drive to so many goals around the table, in a simulator with relay, daemon and navigator.

    :param navigator: its options
    :param most_seconds: for each goal
    :returns: the drives; processor time of the navigator for each second of them, milliseconds
    """
    goals = around_the_table()
    made = []
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        robot = NavigatingRobot(Path(name), navigator=navigator)
        with running(robot), robot.connect() as client:
            robot.take_control(client)
            driver = GoalDriver(robot, client)
            driver.drive(goals[-1], 0, most_seconds)  # to where the first one starts
            with measured(robot.navigator().pid) as watch:
                for number, goal in enumerate(goals[:count], 1):
                    made.append(driver.drive(goal, number, most_seconds))
                    print(f"    {' '.join(navigator)} {number}: {described(made[-1])}", flush=True)
    return made, 1000 * watch.seconds / sum(drive.seconds for drive in made)


def described(drive: GoalDrive) -> str:
    """One drive in words."""
    x, y, heading = drive.goal
    return (
        f"({x:.2f}, {y:.2f}, {math.degrees(heading):.0f}°) {drive.metres:.2f} m, {drive.seconds:.1f} s, "
        f"{drive.collisions} collisions, {drive.end}"
    )


def table(options: Options) -> list[Row]:
    """The experiment with the table."""
    count = int(options.pick(1, GOALS))
    most_seconds = options.pick(3, GOAL_SECONDS)
    seeing, cost = drives(count, (), most_seconds)
    blind, _ = drives(count, ("--depth", ""), most_seconds)

    def row(what: str, unit: str, value: float, bar: float | None = None, note: str = "") -> Row:
        return Row("navigation", f"{count} goals around a table{what}", unit, value, bar=bar, note=note)

    hits, arrived = sum(drive.collisions for drive in blind), sum(drive.arrived for drive in blind)
    beside = f"with the scanner alone {hits} collisions, and {arrived} of {count} goals reached"
    metres, seconds = [drive.metres for drive in seeing], [drive.seconds for drive in seeing]
    return [
        row(
            ", scanner and depth: collisions",
            "collisions",
            sum(drive.collisions for drive in seeing),
            0,
            beside,
        ),
        row(", scanner and depth: goals not reached", "goals", sum(not drive.arrived for drive in seeing), 0),
        row(
            ", scanner alone: goals without a collision",
            "goals",
            sum(not drive.collisions for drive in blind),
            count - 1,
        ),
        row(", path, median", "m", statistics.median(metres), note=by_goal("path", metres, "m")),
        row(", time, median", "s", statistics.median(seconds), note=by_goal("time", seconds, "s")),
        row(", processor time of the navigator", "ms for each second", cost),
    ]


def by_goal(what: str, values: list[float], unit: str) -> str:
    """The figures of all goals, in their order."""
    return f"{what} by goal: {', '.join(f'{each:.1f}' for each in values)} {unit}"


class Standstill:
    """Ends goals of a real robot in different ways."""

    def __init__(self, robot: NavigatingRobot, client: Client, viewer: Client) -> None:
        self._robot = robot
        self._client = client
        self._viewer = viewer

    def stopped(self) -> float:
        """By a stop of a viewer's; milliseconds from there."""
        self._drive()
        return self._robot.standstill_after(press_stop(self._viewer))

    def killed(self) -> float:
        """By the death of the navigator."""
        self._drive()
        return self._robot.standstill_after(self._robot.kill_navigator())

    def frozen(self) -> float:
        """By a stop while the navigator is frozen, as soon as it is."""
        self._drive()
        navigator = self._robot.navigator()
        freeze(navigator.pid)
        try:
            return self._robot.standstill_after(press_stop(self._viewer))
        finally:
            os.kill(navigator.pid, signal.SIGCONT)

    def without_daemon(self) -> float:
        """By the daemon's death; the guard cancels the goal."""
        self._drive()
        began = time.monotonic_ns()
        self._robot.robot.daemon.kill()
        took = self._robot.standstill_after(began)
        self._robot.robot.start_daemon()
        self._robot.robot.wait_online()
        return took

    def _drive(self) -> None:
        self._robot.wait_navigator()
        self._robot.take_control(self._client)
        wait_for("it stands at its start", lambda: not self._robot.robot.moving())
        self._robot.give(self._client, id=str(time.monotonic_ns()))
        self._robot.until_moving()


def standstill(options: Options) -> list[Row]:
    """Stops in the middle of goals."""
    runs = options.runs or int(options.pick(1, 20))
    rows = []
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        robot = NavigatingRobot(Path(name))
        with running(robot):
            with connected(robot) as scene:
                half = max(1, runs // 2)
                rows.append(worst("a stop", [scene.stopped() for _ in range(runs)], STOP_BAR_MS))
                frozen = [scene.frozen() for _ in range(half)]
                rows.append(worst("a stop while the navigator is frozen", frozen, STOP_BAR_MS))
            few = range(max(1, runs // 4))
            deaths = [daemon_death(robot) for _ in few]
            rows.append(worst("the daemon's death", deaths, FAULT_BAR_MS))
            # The last: a goal to an action whose server died waits until DDS forgets that, after 20 s.
            with connected(robot) as scene:
                rows.append(worst("the navigator's death", [scene.killed() for _ in few], FAULT_BAR_MS))
    return rows


@contextlib.contextmanager
def connected(robot: NavigatingRobot) -> Iterator[Standstill]:
    """A driver and a viewer."""
    with robot.connect() as client, robot.relay.connect("rover", robot.viewer) as viewer:
        yield Standstill(robot, client, viewer)


def daemon_death(robot: NavigatingRobot) -> float:
    """The daemon's death; the connections end with it."""
    with connected(robot) as scene:
        return scene.without_daemon()


def worst(what: str, took: list[float], bar: float) -> Row:
    """The slowest standstill, milliseconds."""
    print(f"    {what} during a goal: median {statistics.median(took):.0f} ms", flush=True)
    text = f"{what} during a goal, to standstill, worst of {len(took)}"
    return Row("navigation", text, "ms", max(took), bar=bar)


def run(options: Options) -> list[Row]:
    """The table, then stops."""
    if importlib.util.find_spec("nav2_msgs") is None:
        raise Unavailable("nav2_msgs is not built; 'scripts/setup.sh interfaces' does so")
    return [*table(options), *standstill(options)]
