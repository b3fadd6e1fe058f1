"""A simulated robot navigates, on simulated time."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from robot_client.navigation.costmap import OccupancyMap
from robot_client.navigation.grid import GridGeometry, Pose2D
from robot_client.navigation.navigator import TRANSITIONS, NavigatorEvent, NavigatorState
from robot_client.navigation.outcome import ErrorCode, GoalEnd
from robot_client.navigation.pursuit import STANDSTILL
from robot_client.sim.world import Colour, Pose, Segment, Table, Texture, WallTexture, World, box
from tests.worlds.navigation import SimulatedNavigation

GREY = WallTexture(Colour(128, 128, 128), Texture.BRICK)
TABLE = Table(0.0, 0.0, 1.4, 0.8, 0.0, GREY)
WEST, SOUTH = Pose(-2.0, 0.0, 0.0), Pose(0.0, -1.4, math.pi / 2)


def room(*segments: Segment, start: Pose = WEST, tables: tuple[Table, ...] = ()) -> World:
    return World([*box(0.0, 0.0, 6.0, 4.0, 0.0, GREY), *segments], [], start, tables=tables)


def until_moving(scene: SimulatedNavigation) -> None:
    while scene.robot.body.velocity.speed < 0.2:
        assert scene.tick() is None


def test_around_the_table_with_the_depth_camera() -> None:
    scene = SimulatedNavigation(room(start=SOUTH, tables=(TABLE,)))
    trips = [scene.drive(goal) for goal in (Pose2D(0.0, 1.4, 0.0), Pose2D(0.0, -1.4, 0.0))]
    assert [(trip.arrived, trip.collisions) for trip in trips] == [(True, 0)] * 2


def same(known: OccupancyMap) -> OccupancyMap:
    return known


def grown(known: OccupancyMap) -> OccupancyMap:
    """A map with unknown cells added on all sides, as SLAM's grows."""
    step = known.geometry.resolution
    occupancy = np.pad(known.occupancy, 1, constant_values=-1)
    place = known.geometry.x - step, known.geometry.y - step
    return OccupancyMap(known.frame, GridGeometry(*place, step, *occupancy.shape), occupancy)


@pytest.mark.parametrize("next_map", [same, grown])
def test_maps_that_come_on_the_way_leave_what_the_sensors_saw(
    next_map: Callable[[OccupancyMap], OccupancyMap],
) -> None:
    scene = SimulatedNavigation(room(start=SOUTH, tables=(TABLE,)))
    scene.next_map = next_map
    trip = scene.drive(Pose2D(0.0, 1.4, 0.0), most_seconds=30.0)
    assert (trip.arrived, trip.collisions) == (True, 0)


def test_a_search_goes_on_in_the_map_of_now() -> None:
    scene = SimulatedNavigation(room())
    # The first map has no way to the goal: a wall from side to side.
    walled = scene.map.occupancy.copy()
    walled[:, walled.shape[1] // 2] = 100
    scene.navigator.set_map(scene.map._replace(occupancy=walled))
    scene.navigator.start(Pose2D(2.0, 0.0, 0.0), scene.now)
    scene.tick()
    assert scene.navigator.state is NavigatorState.PLANNING
    scene.navigator.set_map(grown(scene.map))
    while scene.navigator.state is NavigatorState.PLANNING:
        scene.tick()
    assert scene.navigator.state is NavigatorState.FOLLOWING


def test_a_map_in_another_frame_ends_the_goal() -> None:
    scene = SimulatedNavigation(room())
    scene.navigator.start(Pose2D(2.0, 0.0, 0.0), scene.now)
    until_moving(scene)
    scene.navigator.set_map(scene.map._replace(frame="other"))
    outcome = scene.tick()
    assert outcome is not None and "'other'" in outcome.message
    assert (outcome.end, scene.commands[-1]) == (GoalEnd.ABORTED, STANDSTILL)


def test_into_the_table_with_the_scanner_alone() -> None:
    scene = SimulatedNavigation(room(start=SOUTH, tables=(TABLE,)), sensors=("scan",))
    assert scene.drive(Pose2D(0.0, 1.4, 0.0), most_seconds=20.0).collisions > 0


def test_goal_has_position_and_heading() -> None:
    scene = SimulatedNavigation(room())
    trip = scene.drive(Pose2D(1.5, 1.0, math.pi / 2))
    assert trip.arrived
    assert scene.pose.distance(1.5, 1.0) < 0.15
    assert scene.pose.heading == pytest.approx(math.pi / 2, abs=0.15)


def test_cancelled_goal_ends_in_standstill() -> None:
    scene = SimulatedNavigation(room())
    scene.navigator.start(Pose2D(2.0, 0.0, 0.0), scene.now)
    until_moving(scene)
    scene.navigator.cancel()
    scene.tick()
    assert (scene.commands[-1], scene.robot.body.moving, scene.navigator.goal) == (STANDSTILL, False, None)


@pytest.mark.parametrize("sensor", ["scan", "depth"])
def test_a_silent_sensor_stops_the_robot_and_ends_the_goal(sensor: str) -> None:
    scene = SimulatedNavigation(room())
    scene.navigator.start(Pose2D(2.0, 0.0, 0.0), scene.now)
    until_moving(scene)
    scene.silent.add(sensor)
    began = scene.now
    while scene.robot.body.moving:
        scene.tick()
    assert scene.now - began < 0.8
    while (outcome := scene.tick()) is None:
        assert not scene.robot.body.moving
    assert outcome.end is GoalEnd.ABORTED
    assert sensor in outcome.message


def test_a_refused_sensor_ends_the_goal_with_the_reason() -> None:
    scene = SimulatedNavigation(room())
    scene.navigator.start(Pose2D(2.0, 0.0, 0.0), scene.now)
    until_moving(scene)
    scene.silent.add("depth")
    while True:
        scene.navigator.refuse("depth", "it is not level", scene.now)
        if (outcome := scene.tick()) is not None:
            break
    assert (outcome.end, outcome.code) == (GoalEnd.ABORTED, ErrorCode.FOLLOW_UNKNOWN)
    assert "'depth'" in outcome.message and "it is not level" in outcome.message


def test_inputs_that_are_refused_now_and_then_are_no_problem() -> None:
    scene = SimulatedNavigation(room())
    for _ in range(50):
        scene.navigator.refuse("depth", "it is not level", scene.now)
        scene.tick()
        assert not scene.navigator.refused()


def test_a_single_refused_input_stays_no_problem() -> None:
    scene = SimulatedNavigation(room())
    scene.silent.add("depth")
    scene.navigator.refuse("depth", "it is not level", scene.now)
    for _ in range(50):
        scene.tick()
    assert not scene.navigator.refused()


@pytest.mark.parametrize(("silent", "within"), [("odometry", 0.3), ("localiser", 3.0)])
def test_a_silent_source_of_the_pose_stops_the_robot_and_ends_the_goal(silent: str, within: float) -> None:
    scene = SimulatedNavigation(room())
    scene.navigator.start(Pose2D(2.0, 0.0, 0.0), scene.now)
    until_moving(scene)
    setattr(scene, f"{silent}_at", scene.now)
    began = scene.now
    while scene.robot.body.moving:
        scene.tick()
    assert within < scene.now - began < within + 0.3
    missing = scene.navigator.missing(scene.now)
    assert missing is not None and silent in str(missing)
    while (outcome := scene.tick()) is None:
        assert not scene.robot.body.moving
    assert (outcome.end, outcome.code) == (GoalEnd.ABORTED, ErrorCode.FOLLOW_TF_ERROR)
    assert silent in outcome.message


def test_the_goal_goes_on_when_the_localiser_is_back() -> None:
    scene = SimulatedNavigation(room())
    scene.navigator.start(Pose2D(2.0, 0.0, 0.0), scene.now)
    until_moving(scene)
    scene.localiser_at = scene.now - 10.0
    scene.tick()
    assert scene.commands[-1] == STANDSTILL
    scene.localiser_at = scene.now
    scene.tick()
    assert scene.commands[-1] != STANDSTILL


def test_after_a_pause_of_the_process_the_first_command_is_zero() -> None:
    scene = SimulatedNavigation(room())
    scene.navigator.start(Pose2D(2.0, 0.0, 0.0), scene.now)
    until_moving(scene)
    scene.now += 0.3
    scene.sense()
    scene.tick()
    assert scene.commands[-1] == STANDSTILL
    scene.tick()
    assert scene.commands[-1] != STANDSTILL


def test_robot_in_a_dead_end_recovers_and_gives_up() -> None:
    # Closed in, at the moment the goal comes.
    scene = SimulatedNavigation(room(*box(-2.0, 0.0, 1.2, 1.2, 0.0, GREY)))
    trip = scene.drive(Pose2D(2.0, 0.0, 0.0))
    assert trip.outcome is not None
    assert (trip.outcome.end, trip.outcome.code) == (GoalEnd.ABORTED, ErrorCode.NO_VALID_PATH)
    assert trip.recoveries == 6
    assert trip.collisions == 0


def test_an_obstacle_that_is_on_no_map_is_driven_around() -> None:
    scene = SimulatedNavigation(room())
    crate = room(*box(0.0, 0.0, 0.5, 0.5, 0.3, GREY))
    scene.robot.world = scene.robot.body.world = crate
    scene.depth = type(scene.depth)(crate, 1)
    trip = scene.drive(Pose2D(2.0, 0.0, 0.0))
    assert (trip.arrived, trip.collisions) == (True, 0)


def test_progress_counts_down() -> None:
    scene = SimulatedNavigation(room())
    assert scene.navigator.progress(scene.now) is None
    scene.navigator.start(Pose2D(2.0, 0.0, 0.0), scene.now)
    left = []
    while scene.tick() is None:
        progress = scene.navigator.progress(scene.now)
        assert progress is not None
        left.append(progress.distance_left)
    assert left[0] == pytest.approx(4.0, abs=0.1)
    assert left[-1] < 0.3
    assert np.diff(left).max() < 0.3


def test_every_state_ends_by_its_event() -> None:
    active = set(NavigatorState) - {NavigatorState.IDLE}
    assert {state for state, event in TRANSITIONS if event is NavigatorEvent.END} == active
