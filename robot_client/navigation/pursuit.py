"""Follows a path by regulated pure pursuit: slower in curves, near obstacles and before the goal. Pure.

Source: Macenski, Singh, Martín, Ginés, "Regulated pure pursuit for robot path tracking" (2023), simplified.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from robot_client.navigation.costmap import Costmap
from robot_client.navigation.grid import Floats, Pose2D, angle_between


class DriveLimits(NamedTuple):
    """Limits of a robot's motion.

    :ivar speed: m/s
    :ivar turn: rad/s
    :ivar acceleration: m/s²
    :ivar turn_acceleration: rad/s²
    """

    speed: float = 0.4
    turn: float = 1.2
    acceleration: float = 0.8
    turn_acceleration: float = 4.0


class DriveCommand(NamedTuple):
    """Speed ahead (m/s) and turning counter-clockwise (rad/s)."""

    speed: float
    turn: float

    def step(self, pose: Pose2D, seconds: float) -> Pose2D:
        """The pose after driving so for a while."""
        heading = pose.heading + self.turn * seconds
        middle = pose.heading + self.turn * seconds / 2
        length = self.speed * seconds
        return Pose2D(pose.x + length * math.cos(middle), pose.y + length * math.sin(middle), heading)


STANDSTILL = DriveCommand(0.0, 0.0)

POSITION_TOLERANCE, HEADING_TOLERANCE = 0.12, 0.12
"""Metres and radians within which a goal is reached."""

_SLOWEST = 0.08
"""m/s near an obstacle and before the goal."""
_LOOKAHEAD = (0.25, 0.6)
"""Metres to the point that is driven at, standing and at most."""
_LOOKAHEAD_SECONDS = 0.8
_TURN_FIRST, _TURN_ENOUGH = 0.9, 0.3
"""Radians to that point from which the robot turns on the spot, and to which it does."""
_TURN_GAIN = 2.5
_SLOW_CLEARANCE = 0.35
"""Metres beyond the robot's radius within which it drives slower."""
_BRAKING_GAIN = 1.2
"""Speed before the goal: so many m/s for each metre left."""
_LOOK_SECONDS = 0.7
"""A command is checked for so long ahead."""
_LOOK_STEPS = 8


class PathFollower:
    """Follows one path.

    :param path: points, shape (n, 2)
    :param goal: the pose at its end
    """

    def __init__(self, path: Floats, goal: Pose2D, limits: DriveLimits) -> None:
        self.path = path
        self._goal = goal
        self._limits = limits
        lengths = np.hypot(*np.diff(path, axis=0).T) if len(path) > 1 else np.zeros(0)
        self._rest = np.concatenate((np.cumsum(lengths[::-1])[::-1], (0.0,)))
        self._next = 0
        self._turning = False
        self._arrived = False
        """Whether the position is reached, so that only the heading is left."""

    @property
    def distance_left(self) -> float:
        """Metres along the path."""
        return float(self._rest[self._next])

    def is_blocked(self, costmap: Costmap) -> bool:
        """Whether an obstacle is on what is left of the path."""
        return bool((costmap.clearance_at(self.path[self._next + 1 :]) <= costmap.radius).any())

    def command(
        self, pose: Pose2D, last: DriveCommand, costmap: Costmap, seconds: float
    ) -> DriveCommand | None:
        """What to drive now; ``None``: the goal is reached.

        :param last: the command before this, ``seconds`` ago
        """
        self._advance(pose)
        end = self.path[-1]
        if self._arrived or pose.distance(*end) < POSITION_TOLERANCE:
            self._arrived = True
            error = angle_between(self._goal.heading, pose.heading)
            return None if abs(error) < HEADING_TOLERANCE else self._turn(pose, error, last, costmap, seconds)
        carrot = self._carrot(pose, last.speed)
        bearing = pose.bearing(*carrot)
        self._turning = abs(bearing) > (_TURN_ENOUGH if self._turning else _TURN_FIRST)
        if self._turning:
            return self._turn(pose, bearing, last, costmap, seconds)
        return self._drive(pose, carrot, last, costmap, seconds)

    def _advance(self, pose: Pose2D) -> None:
        """Go on to the point of the path that is nearest, among the next ones."""
        ahead = self.path[self._next : self._next + 40]
        self._next += int(np.argmin(np.hypot(ahead[:, 0] - pose.x, ahead[:, 1] - pose.y)))

    def _carrot(self, pose: Pose2D, speed: float) -> Floats:
        least, most = _LOOKAHEAD
        reach = min(least + _LOOKAHEAD_SECONDS * max(speed, 0.0), most)
        ahead = self.path[self._next :]
        beyond = np.hypot(ahead[:, 0] - pose.x, ahead[:, 1] - pose.y) >= reach
        carrot: Floats = ahead[int(np.argmax(beyond))] if beyond.any() else ahead[-1]
        return carrot

    def _turn(
        self, pose: Pose2D, error: float, last: DriveCommand, costmap: Costmap, seconds: float
    ) -> DriveCommand:
        """Turn on the spot; brake meanwhile, at once where the robot would touch an obstacle."""
        limits = self._limits
        wanted = float(np.clip(_TURN_GAIN * error, -limits.turn, limits.turn))
        if abs(wanted) < 0.2:
            wanted = math.copysign(0.2, error)
        speed = _approach(last.speed, 0.0, 3 * limits.acceleration * seconds)
        braking = DriveCommand(speed, _approach(last.turn, wanted, limits.turn_acceleration * seconds))
        return braking if is_free(pose, braking, costmap) else braking._replace(speed=0.0)

    def _drive(
        self, pose: Pose2D, carrot: Floats, last: DriveCommand, costmap: Costmap, seconds: float
    ) -> DriveCommand:
        limits = self._limits
        bearing, distance = pose.bearing(*carrot), max(pose.distance(*carrot), 0.05)
        curvature = 2 * math.sin(bearing) / distance
        speed = min(limits.speed, 0.8 * limits.turn / max(abs(curvature), 1e-6))
        near = costmap.clearance_at(np.array([pose[:2], pose.ahead(0.3)[:2], carrot])).min() - costmap.radius
        speed *= min(max(near / _SLOW_CLEARANCE, 0.25), 1.0)
        speed = max(min(speed, _BRAKING_GAIN * self.distance_left), _SLOWEST)
        speed = _approach(last.speed, speed, (limits.acceleration if speed > last.speed else 2.0) * seconds)
        for share in (1.0, 0.5, 0.25):
            turn = _approach(last.turn, speed * share * curvature, limits.turn_acceleration * seconds)
            command = DriveCommand(speed * share, turn)
            if is_free(pose, command, costmap):
                return command
        return STANDSTILL


def is_free(pose: Pose2D, command: DriveCommand, costmap: Costmap) -> bool:
    """Whether a command keeps the robot off obstacles for a while.

    Where it touches one already, the command must lead away.
    """
    times = np.linspace(0.0, _LOOK_SECONDS, _LOOK_STEPS)
    points = np.array([command.step(pose, float(each))[:2] for each in times])
    clearance = costmap.clearance_at(points)
    if clearance[0] <= costmap.radius:
        return bool(clearance[-1] >= clearance[0] and clearance.min() >= clearance[0] - 0.01)
    return bool((clearance > costmap.radius).all())


def _approach(value: float, target: float, most: float) -> float:
    return value + min(max(target - value, -most), most)
