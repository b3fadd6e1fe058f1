"""The lifecycle of a channel as a table of states, events and following states."""

from __future__ import annotations

import enum


class ChannelState(enum.Enum):
    """State of a channel."""

    NEW = "new"
    WAITING = "waiting for the robot"
    OPENING = "opening"
    OPEN = "open"
    CLOSED = "closed"


class ChannelEvent(enum.Enum):
    """Event of a channel; the values are written to the log."""

    ATTACHED = "a session is attached"
    ROBOT_ONLINE = "the robot registered"
    ROBOT_OFFLINE = "the robot is gone"
    JOINED = "the robot joined"
    LINK_LOST = "the channel's link broke"
    JOIN_TIMEOUT = "the robot did not join in time"
    CLOSE = "no session needs it any more"


NEXT: dict[tuple[ChannelState, ChannelEvent], ChannelState] = {
    (ChannelState.NEW, ChannelEvent.ATTACHED): ChannelState.WAITING,
    (ChannelState.WAITING, ChannelEvent.ROBOT_ONLINE): ChannelState.OPENING,
    (ChannelState.WAITING, ChannelEvent.CLOSE): ChannelState.CLOSED,
    (ChannelState.OPENING, ChannelEvent.JOINED): ChannelState.OPEN,
    (ChannelState.OPENING, ChannelEvent.ROBOT_ONLINE): ChannelState.OPENING,
    (ChannelState.OPENING, ChannelEvent.ROBOT_OFFLINE): ChannelState.WAITING,
    (ChannelState.OPENING, ChannelEvent.JOIN_TIMEOUT): ChannelState.OPENING,
    (ChannelState.OPENING, ChannelEvent.CLOSE): ChannelState.CLOSED,
    (ChannelState.OPEN, ChannelEvent.LINK_LOST): ChannelState.OPENING,
    (ChannelState.OPEN, ChannelEvent.ROBOT_OFFLINE): ChannelState.WAITING,
    (ChannelState.OPEN, ChannelEvent.CLOSE): ChannelState.CLOSED,
}
"""An event that is not listed for a state changes nothing."""
