"""A channel's life as a table: where it can be, what can happen, and what follows."""

from __future__ import annotations

import enum


class ChannelState(enum.Enum):
    """Where a channel is in its life."""

    NEW = "new"
    WAITING = "waiting for the robot"
    OPENING = "opening"
    OPEN = "open"
    CLOSED = "closed"


class ChannelEvent(enum.Enum):
    """What happens to a channel."""

    WANTED = "somebody is here"
    ROBOT_ONLINE = "the robot registered"
    ROBOT_OFFLINE = "the robot is gone"
    JOINED = "the robot joined"
    LINK_LOST = "the channel's link broke"
    LATE = "the robot did not join in time"
    SHUT = "nobody needs it any more"


NEXT: dict[tuple[ChannelState, ChannelEvent], ChannelState] = {
    (ChannelState.NEW, ChannelEvent.WANTED): ChannelState.WAITING,
    (ChannelState.WAITING, ChannelEvent.ROBOT_ONLINE): ChannelState.OPENING,
    (ChannelState.WAITING, ChannelEvent.SHUT): ChannelState.CLOSED,
    (ChannelState.OPENING, ChannelEvent.JOINED): ChannelState.OPEN,
    (ChannelState.OPENING, ChannelEvent.ROBOT_ONLINE): ChannelState.OPENING,
    (ChannelState.OPENING, ChannelEvent.ROBOT_OFFLINE): ChannelState.WAITING,
    (ChannelState.OPENING, ChannelEvent.LATE): ChannelState.OPENING,
    (ChannelState.OPENING, ChannelEvent.SHUT): ChannelState.CLOSED,
    (ChannelState.OPEN, ChannelEvent.LINK_LOST): ChannelState.OPENING,
    (ChannelState.OPEN, ChannelEvent.ROBOT_OFFLINE): ChannelState.WAITING,
    (ChannelState.OPEN, ChannelEvent.SHUT): ChannelState.CLOSED,
}
"""An event that is not listed for a state changes nothing."""
