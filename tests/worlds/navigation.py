"""A simulated robot that navigates, in one process and on simulated time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from robot_client.navigation.costmap import OccupancyMap
from robot_client.navigation.grid import GridGeometry, Pose2D
from robot_client.navigation.navigator import Navigator, NavigatorSettings
from robot_client.navigation.outcome import GoalEnd, NavigationOutcome
from robot_client.navigation.pursuit import STANDSTILL, DriveCommand
from robot_client.navigation.sensors import view_of_depth, view_of_scan
from robot_client.services.camera_model import CameraModel
from robot_client.sim.depth_camera import FOCAL, HEIGHT, WIDTH, SimDepthCamera
from robot_client.sim.floor_plan import floor_plan
from robot_client.sim.robot import SCAN_BEGIN, SCAN_FARTHEST, SCAN_STEP, MotionRecorder, SimRobot
from robot_client.sim.world import Pose, World

STEP = 0.02
"""Seconds."""
STEPS_PER_TICK = 2
TICKS_PER_MAP = 25
TICKS_PER_IMAGE = 3
"""Scans and depth images come eight times a second."""

MODEL = CameraModel(FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)


class Trip(NamedTuple):
    """One goal and how it was driven.

    :ivar seconds: simulated
    :ivar metres: driven
    :ivar collisions: contacts of the body
    """

    goal: Pose2D
    outcome: NavigationOutcome | None
    seconds: float
    metres: float
    collisions: int
    recoveries: int

    @property
    def arrived(self) -> bool:
        return self.outcome is not None and self.outcome.end is GoalEnd.SUCCEEDED


class SimulatedNavigation:
    """A robot in a world with its navigator.

    :param sensors: of ``scan`` and ``depth``
    """

    def __init__(self, world: World, sensors: tuple[str, ...] = ("scan", "depth"), seed: int = 1) -> None:
        self.now = 0.0
        self.robot = SimRobot(world, MotionRecorder(None), seed, lambda: self.now)
        self.robot.command_timeout = 0.4
        self.depth = SimDepthCamera(world, seed)
        self.navigator = Navigator(NavigatorSettings(sensors=sensors))
        plan = floor_plan(world)
        self.map = OccupancyMap(
            "map", GridGeometry(plan.x, plan.y, plan.resolution, *plan.cells.shape), plan.cells
        )
        self.navigator.set_map(self.map)
        self.next_map: Callable[[OccupancyMap], OccupancyMap] | None = None
        """Makes the map that comes each second from the one before, as of SLAM; ``None``: none comes."""
        self.silent: set[str] = set()
        """Sensors that send nothing."""
        self.odometry_at: float | None = None
        """When the odometry fell silent; ``None``: it has not."""
        self.localiser_at = math.inf
        """When the localiser fell silent."""
        self.collisions = 0
        self.commands: list[DriveCommand] = []
        self._touching = False
        self._ticks = 0

    @property
    def pose(self) -> Pose2D:
        return Pose2D(*self.robot.body.pose)

    def place(self, pose: Pose2D) -> None:
        """Places the robot somewhere."""
        self.robot.body.reset(Pose(*pose))

    def sense(self) -> None:
        """One scan and one depth image."""
        pose, settings = self.pose, self.navigator.settings
        if "scan" in settings.sensors and "scan" not in self.silent:
            ranges = self.robot.scan().astype(np.float64)
            angles = SCAN_BEGIN + SCAN_STEP * np.arange(len(ranges))
            self.navigator.observe("scan", view_of_scan(pose, ranges, angles, SCAN_FARTHEST), self.now)
        if "depth" in settings.sensors and "depth" not in self.silent:
            metres = self.depth.render(self.robot.body.pose).astype(np.float32) / 1000
            metres[metres == 0] = np.nan
            self.navigator.observe("depth", view_of_depth(pose, metres, MODEL, 0.38), self.now)

    def tick(self) -> NavigationOutcome | None:
        """Senses, decides and moves once."""
        if self._ticks % TICKS_PER_IMAGE == 0:
            self.sense()
        if self.next_map is not None and self._ticks % TICKS_PER_MAP == 0:
            self.map = self.next_map(self.map)
            self.navigator.set_map(self.map)
        self._ticks += 1
        odometry_at = self.now if self.odometry_at is None else self.odometry_at
        self.navigator.set_pose(self.pose, odometry_at, self.localiser_at)
        command, outcome = self.navigator.tick(self.now)
        self.commands.append(command)
        self.robot.command(*command)
        for _ in range(STEPS_PER_TICK):
            self.robot.step(STEP)
            self.now += STEP
            touching = self.robot.body.touching
            self.collisions += touching and not self._touching
            self._touching = touching
        return outcome

    def drive(self, goal: Pose2D, most_seconds: float = 180.0) -> Trip:
        """Goes to a goal until it ends or the time is over."""
        began, metres, collisions = self.now, self.robot.body.travelled, self.collisions
        self.navigator.start(goal, self.now)
        outcome, recoveries = None, 0
        while outcome is None and self.now - began < most_seconds:
            progress = self.navigator.progress(self.now)
            recoveries = progress.recoveries if progress else recoveries
            outcome = self.tick()
        self.navigator.cancel()
        self.robot.command(*STANDSTILL)
        return Trip(
            goal,
            outcome,
            self.now - began,
            self.robot.body.travelled - metres,
            self.collisions - collisions,
            recoveries,
        )
