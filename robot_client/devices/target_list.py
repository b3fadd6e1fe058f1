"""A list of targets that the robot drives to one after another. Pure: no ROS, no clock."""

from __future__ import annotations

import math
import secrets
from collections.abc import Callable
from typing import Any, NamedTuple

from relay_protocol.text import is_printable

MOST_TARGETS = 100
LONGEST_NAME = 60

OWN_GOAL = b"target"
"""First bytes of the ids of own goals, so that a goal that an earlier run left behind is known."""

SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
"""Ends of a goal (action_msgs/msg/GoalStatus)."""
_ENDS = {CANCELED: "it was cancelled", ABORTED: "the navigator gave up"}


class DriveTarget(NamedTuple):
    """A target.

    :ivar x: metres in the map
    :ivar y: metres in the map
    :ivar heading: radians, counter-clockwise from the map's x axis
    :ivar name: for people
    """

    x: float
    y: float
    heading: float = 0.0
    name: str = ""


class TargetList:
    """Drives the targets of one client at a time.

    :param drive: begins a goal, with its id of 16 bytes
    :param cancel: cancels a goal
    :param report: receives each change, for those that listen to the module
    """

    def __init__(
        self,
        drive: Callable[[bytes, DriveTarget], object],
        cancel: Callable[[bytes], object],
        report: Callable[[dict[str, Any]], object],
    ) -> None:
        self._drive = drive
        self._cancel = cancel
        self._report = report
        self._targets: list[DriveTarget] = []
        self._number = 0
        self._sender = 0
        self.goal: bytes | None = None
        """Id of the goal under way."""

    @property
    def target(self) -> DriveTarget:
        """The target of the goal under way."""
        return self._targets[self._number - 1]

    def check_free(self) -> None:
        """:raises ValueError: others are being driven to"""
        if self.goal is not None:
            raise ValueError("other targets are being driven to; send {'cancel': true} first")

    def begin(self, targets: list[DriveTarget], sender: int) -> None:
        """Drive to these targets, in order.

        :raises ValueError: others are being driven to
        """
        self.check_free()
        self._targets, self._number, self._sender = targets, 0, sender
        self._next()

    def cancel(self, why: str) -> None:
        """End the list and the goal under way."""
        if self.goal is not None:
            self._cancel(self.goal)
            self._end(why)

    def sender_left(self, sender: int) -> None:
        """The client has disconnected: its targets are not driven to any further."""
        if sender == self._sender:
            self.cancel("its client has disconnected")

    def goal_ended(self, goal: bytes, status: int) -> None:
        """A goal has ended; any but the one under way changes nothing.

        :param status: of action_msgs/msg/GoalStatus
        """
        if goal != self.goal:
            return
        if status != SUCCEEDED:
            self._end(_ENDS.get(status, f"its goal ended with status {status}"))
            return
        self._report({"state": "arrived", **self._place()})
        self._next()

    def refused(self, goal: bytes, why: str) -> None:
        """The navigator has not taken a goal."""
        if goal == self.goal:
            self._end(why)

    def _next(self) -> None:
        if self._number == len(self._targets):
            self.goal = None
            self._report({"state": "done", "of": len(self._targets)})
            return
        self._number += 1
        self.goal = OWN_GOAL + secrets.token_bytes(16 - len(OWN_GOAL))
        self._report({"state": "driving", **self._place()})
        self._drive(self.goal, self.target)

    def _end(self, why: str) -> None:
        place = self._place()
        self.goal = None
        self._report({"state": "ended", **place, "why": why})

    def _place(self) -> dict[str, Any]:
        return {"target": self.target.name, "number": self._number, "of": len(self._targets)}


def parse_targets(command: Any) -> list[DriveTarget]:
    """The targets of a command.

    :raises ValueError: it has none, too many, or one that is wrong
    """
    if not isinstance(command, list) or not 0 < len(command) <= MOST_TARGETS:
        raise ValueError(f"go needs a list of 1 to {MOST_TARGETS} targets")
    return [_target(number, each) for number, each in enumerate(command, 1)]


def _target(number: int, fields: Any) -> DriveTarget:
    if not isinstance(fields, dict) or not {"x", "y"} <= fields.keys() <= set(DriveTarget._fields):
        raise ValueError(f"target {number} needs x and y, and may have heading and name, nothing else")
    name = fields.get("name", f"target {number}")
    if not (isinstance(name, str) and 0 < len(name) <= LONGEST_NAME and is_printable(name)):
        raise ValueError(f"name of target {number} is not a text of 1 to {LONGEST_NAME} printable characters")
    numbers = [fields["x"], fields["y"], fields.get("heading", 0.0)]
    if not all(isinstance(each, int | float) and not isinstance(each, bool) for each in numbers):
        raise ValueError(f"x, y and heading of target {number} must be numbers")
    try:
        x, y, heading = (float(each) for each in numbers)
    except OverflowError:
        x = y = heading = math.inf
    if not all(math.isfinite(each) for each in (x, y, heading)):
        raise ValueError(f"x, y and heading of target {number} must be finite")
    return DriveTarget(x, y, heading, name)
