"""What is known of one topic that moves the robot."""

from __future__ import annotations

from typing import NamedTuple

from robot_client.authority import NOBODY
from robot_client.platforms.base import Sink
from robot_client.ramp import Ramp
from robot_client.reactors import Timer
from robot_client.topics import TypedTopic


class Outlet(NamedTuple):
    """Where the commands of one publication go."""

    on: TypedTopic
    sink: Sink


class Track:
    """One motion topic.

    :attr sources: publications that may command it
    :attr leaving: sinks to close when the last zero is said
    :attr speaker: sink of the last command; what it says arrives after that command, what another says may not
    :attr mover: who gave the last command to move
    :attr latest: by when zero must be said after it, nanoseconds
    :attr body: that command; empty where nobody will want to know
    :attr rest: what its zero looks like, see ``Platform.resting``
    :attr ramp: on the way to a standstill
    :attr zeros: how often zero is still to be said
    :attr timer: for the next zero or step of a ramp; without sources and those, for being forgotten
    """

    def __init__(self) -> None:
        self.sources: set[str] = set()
        self.leaving: list[Sink] = []
        self.speaker: Sink | None = None
        self.mover = NOBODY
        self.latest = 0
        self.body = b""
        self.rest = b""
        self.ramp: Ramp | None = None
        self.zeros = 0
        self.timer: Timer | None = None

    @property
    def busy(self) -> bool:
        """Whether it has yet to come to a standstill."""
        return bool(self.zeros) or self.ramp is not None

    @property
    def idle(self) -> bool:
        """Whether nobody needs it."""
        return not self.sources and not self.busy

    def settle(self) -> None:
        """Nothing is to come."""
        self.zeros = 0
        self.ramp = None
        if self.timer is not None and self.timer.active():
            self.timer.cancel()
        self.timer = None
