"""What is known of one topic that moves the robot."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

from relay_protocol.errors import Unavailable
from robot_client.motion.authority import NOBODY
from robot_client.motion.guard_port import GuardPort
from robot_client.motion.ramp import Ramp
from robot_client.motion.typed_topic import TypedTopic
from robot_client.platforms.base import PublisherHandle
from robot_client.twisted_types import DelayedCall

MAX_TOPICS = 64


class MotionPublisher(NamedTuple):
    """Where the commands of one publication go."""

    on: TypedTopic
    sink: PublisherHandle


class MotionTopic:
    """One motion topic.

    :attr sources: publications that may command it
    :attr leaving: sinks to close when the last zero is said
    :attr speaker: sink of the last command; what it says arrives after that command, what another says may not
    :attr mover: who gave the last command to move
    :attr latest: by when zero must be said after it, nanoseconds
    :attr body: that command; empty where nobody will want to know
    :attr used: when somebody who might commanded it last, nanoseconds
    :attr rest: what its zero looks like, see ``Platform.resting``
    :attr ramp: on the way to a standstill
    :attr zeros: how often zero is still to be said
    :attr timer: for the next zero or step of a ramp; without sources and those, for being forgotten
    """

    def __init__(self) -> None:
        self.sources: set[str] = set()
        self.leaving: list[PublisherHandle] = []
        self.speaker: PublisherHandle | None = None
        self.mover = NOBODY
        self.latest = 0
        self.body = b""
        self.used = 0
        self.rest = b""
        self.ramp: Ramp | None = None
        self.zeros = 0
        self.timer: DelayedCall | None = None

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


class MotionTopics(dict[TypedTopic, MotionTopic]):
    """The topics for which the guard has places.

    The guard has few, as each costs it a publisher: who only advertises topics must take none from who commands one.

    :param moves: whether a topic is to move now
    """

    def __init__(self, guard: GuardPort, moves: Callable[[TypedTopic], bool]) -> None:
        super().__init__()
        self.forgotten: Callable[[TypedTopic], None] = lambda on: None
        """Called when one has no place any more."""
        self._guard = guard
        self._moves = moves

    def take(self, on: TypedTopic, sources: Iterable[str]) -> MotionTopic:
        """What is known of a topic that has a place, or gets that of the one least needed.

        :param sources: publications that may command it, where it had none
        :raises Unavailable: all topics that have places move
        """
        if on not in self:
            for other in [each for each, track in self.items() if each.topic == on.topic and track.idle]:
                self.forget(other)  # some middleware allows one type of a topic in a process
            self._make_room()
            self[on] = MotionTopic()
            self[on].sources.update(sources)
            self._guard.topic(on)
        return self[on]

    def forget(self, on: TypedTopic) -> None:
        """Take its place away."""
        self.pop(on).settle()
        self.forgotten(on)
        self._guard.forget(on)

    def _make_room(self) -> None:
        """Give up one that nobody needs, else the one that was commanded longest ago, or never."""
        if len(self) < MAX_TOPICS:
            return
        still = [on for on, track in self.items() if not track.busy and not self._moves(on)]
        if not still:
            raise Unavailable(f"{MAX_TOPICS} topics move the robot at this moment; let go of one first")
        self.forget(min(still, key=lambda on: (not self[on].idle, self[on].used)))
