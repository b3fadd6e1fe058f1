"""A channel's life as a table: where it can be, what can happen, and what follows."""

from __future__ import annotations

import enum


class State(enum.Enum):
    """Where a channel is in its life."""

    NEW = "new"
    WAITING = "waiting for the robot"
    OPENING = "opening"
    OPEN = "open"
    CLOSED = "closed"


class Event(enum.Enum):
    """What happens to a channel."""

    WANTED = "somebody is here"
    ROBOT_ONLINE = "the robot registered"
    ROBOT_OFFLINE = "the robot is gone"
    JOINED = "the robot joined"
    LINK_LOST = "the channel's link broke"
    LATE = "the robot did not join in time"
    SHUT = "nobody needs it any more"


NEXT: dict[tuple[State, Event], State] = {
    (State.NEW, Event.WANTED): State.WAITING,
    (State.WAITING, Event.ROBOT_ONLINE): State.OPENING,
    (State.WAITING, Event.SHUT): State.CLOSED,
    (State.OPENING, Event.JOINED): State.OPEN,
    (State.OPENING, Event.ROBOT_ONLINE): State.OPENING,
    (State.OPENING, Event.ROBOT_OFFLINE): State.WAITING,
    (State.OPENING, Event.LATE): State.OPENING,
    (State.OPENING, Event.SHUT): State.CLOSED,
    (State.OPEN, Event.LINK_LOST): State.OPENING,
    (State.OPEN, Event.ROBOT_OFFLINE): State.WAITING,
    (State.OPEN, Event.SHUT): State.CLOSED,
}
"""An event that is not listed for a state changes nothing."""
