"""What a robot does that is stuck: back up, turn, and look again. Pure."""

from __future__ import annotations

import math

from robot_client.navigation.costmap import Costmap
from robot_client.navigation.grid import Pose2D, angle_between
from robot_client.navigation.pursuit import DriveCommand, is_free

MOST_RECOVERIES = 6
"""A goal is given up after so many."""

_BACK_DISTANCE, _BACK_SPEED, _BACK_SECONDS = 0.3, 0.12, 4.0
_TURN_ANGLE, _TURN_SPEED, _TURN_SECONDS = math.radians(100), 0.8, 4.0


class BackUp:
    """Back up a little, as far as the way back is free.

    :param pose: at its beginning
    """

    def __init__(self, pose: Pose2D, now: float) -> None:
        self._start, self._until = pose, now + _BACK_SECONDS

    def command(self, pose: Pose2D, costmap: Costmap, now: float) -> DriveCommand | None:
        """What to drive now; ``None``: it has ended."""
        if now >= self._until or pose.distance(self._start.x, self._start.y) >= _BACK_DISTANCE:
            return None
        back = DriveCommand(-_BACK_SPEED, 0.0)
        return back if is_free(pose, back, costmap) else None


class TurnAround:
    """Turn on the spot, so that the sensors see what is around.

    :param pose: at its beginning
    :param left: counter-clockwise
    """

    def __init__(self, pose: Pose2D, now: float, left: bool) -> None:
        self._last, self._until = pose.heading, now + _TURN_SECONDS
        self._side = 1.0 if left else -1.0
        self._turned = 0.0

    def command(self, pose: Pose2D, costmap: Costmap, now: float) -> DriveCommand | None:
        """What to drive now; ``None``: it has ended."""
        self._turned += self._side * angle_between(pose.heading, self._last)
        self._last = pose.heading
        if now >= self._until or self._turned >= _TURN_ANGLE:
            return None
        return DriveCommand(0.0, self._side * _TURN_SPEED)


Recovery = BackUp | TurnAround


def recovery(number: int, pose: Pose2D, now: float) -> Recovery:
    """The recovery of a number, from 1: back up, turn left, back up, turn right, …"""
    if number % 2:
        return BackUp(pose, now)
    return TurnAround(pose, now, left=number % 4 == 2)
