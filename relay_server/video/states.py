"""A stream's life as a table: where it can be, what can happen, and what follows."""

from __future__ import annotations

import enum


class State(enum.Enum):
    """Where a stream is in its life."""

    NEW = "new"
    WAITING = "waiting for the robot or its camera"
    OPENING = "opening"
    OPEN = "open"
    LINGERING = "open, without viewers"
    CLOSED = "closed"


class Event(enum.Enum):
    """What happens to a stream."""

    WANTED = "somebody watches"
    CAMERA_THERE = "the robot has the camera"
    ROBOT_OFFLINE = "the robot is gone"
    JOINED = "the robot joined"
    LINK_LOST = "the stream's link broke"
    LATE = "the robot did not join in time"
    LEFT = "the last viewer left"
    SHUT = "it is over"


NEXT: dict[tuple[State, Event], State] = {
    (State.NEW, Event.WANTED): State.WAITING,
    (State.WAITING, Event.CAMERA_THERE): State.OPENING,
    (State.WAITING, Event.LEFT): State.CLOSED,
    (State.WAITING, Event.SHUT): State.CLOSED,
    (State.OPENING, Event.JOINED): State.OPEN,
    (State.OPENING, Event.LATE): State.OPENING,
    (State.OPENING, Event.ROBOT_OFFLINE): State.WAITING,
    (State.OPENING, Event.LEFT): State.CLOSED,
    (State.OPENING, Event.SHUT): State.CLOSED,
    (State.OPEN, Event.LINK_LOST): State.OPENING,
    (State.OPEN, Event.ROBOT_OFFLINE): State.WAITING,
    (State.OPEN, Event.LEFT): State.LINGERING,
    (State.OPEN, Event.SHUT): State.CLOSED,
    (State.LINGERING, Event.WANTED): State.OPEN,
    (State.LINGERING, Event.LINK_LOST): State.CLOSED,
    (State.LINGERING, Event.ROBOT_OFFLINE): State.CLOSED,
    (State.LINGERING, Event.SHUT): State.CLOSED,
}
"""An event that is not listed for a state changes nothing."""

LINKED = (State.OPEN, State.LINGERING)
"""States in which pictures come."""
