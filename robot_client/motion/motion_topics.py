"""The state of each topic that moves the robot, and the bounded set of topics that the guard covers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

from relay_protocol.errors import Unavailable
from robot_client.motion.authority import NO_SOURCE
from robot_client.motion.guard_port import GuardPort
from robot_client.motion.ramp import Ramp
from robot_client.motion.typed_topic import TypedTopic
from robot_client.platforms.base import PublisherHandle
from robot_client.twisted_types import DelayedCall

MAX_TOPICS = 64
"""Most topics that the guard covers at a time."""


class MotionPublication(NamedTuple):
    """A client's publication that may move the robot: its topic, and the platform's publisher for it."""

    topic: TypedTopic
    publisher: PublisherHandle


class MotionTopic:
    """The state of one motion topic.

    :ivar publication_ids: ids of publications that may command it
    :ivar ended_publishers: publishers of ended publications, to close after the last zero
    :ivar last_publisher: of the last command; zero goes out on it too, as DDS keeps the order only within one publisher
    :ivar moved_by: connection that sent the last command to move
    :ivar latest_stop: when zero must be published after that command at the latest, nanoseconds
    :ivar last_command: that command; empty where ramps are off
    :ivar used_at: when an allowed connection last commanded it, nanoseconds
    :ivar zero_template: see ``Platform.zero_template``
    :ivar ramp: the ramp to a standstill that is under way
    :ivar zeros_left: how many zeros are still to be published
    :ivar timer: for the next zero or step of a ramp; on an idle topic, for forgetting it
    """

    def __init__(self) -> None:
        self.publication_ids: set[str] = set()
        self.ended_publishers: list[PublisherHandle] = []
        self.last_publisher: PublisherHandle | None = None
        self.moved_by = NO_SOURCE
        self.latest_stop = 0
        self.last_command = b""
        self.used_at = 0
        self.zero_template = b""
        self.ramp: Ramp | None = None
        self.zeros_left = 0
        self.timer: DelayedCall | None = None

    @property
    def is_stopping(self) -> bool:
        """Whether a ramp or zeros are under way."""
        return bool(self.zeros_left) or self.ramp is not None

    @property
    def is_idle(self) -> bool:
        """Whether it has no publications, and no stop is under way."""
        return not self.publication_ids and not self.is_stopping

    def cancel_timers(self) -> None:
        """Cancel the ramp, the zeros, and forgetting an idle topic."""
        self.zeros_left = 0
        self.ramp = None
        if self.timer is not None and self.timer.active():
            self.timer.cancel()
        self.timer = None


class MotionTopics(dict[TypedTopic, MotionTopic]):
    """The topics that the guard covers, at most :data:`MAX_TOPICS`, as each costs the guard a publisher.

    A full set evicts the topic least needed, so that clients that only advertise topics can't displace commanded ones.

    :param moves: whether a topic moves now
    """

    def __init__(self, guard: GuardPort, moves: Callable[[TypedTopic], bool]) -> None:
        super().__init__()
        self.on_forgotten: Callable[[TypedTopic], None] = lambda topic: None
        """Called when a topic was evicted or forgotten."""
        self._guard = guard
        self._moves = moves

    def acquire(self, topic: TypedTopic, publication_ids: Iterable[str]) -> MotionTopic:
        """Return the state of a topic; add the topic where it is missing, which may evict another.

        :param publication_ids: ids of publications that may command it; used only when it is added
        :raises Unavailable: the set is full and all its topics move
        """
        if topic not in self:
            for other in [each for each, state in self.items() if each.name == topic.name and state.is_idle]:
                self.forget(other)  # some middleware allows only one type per topic in a process
            self._make_room()
            self[topic] = MotionTopic()
            self[topic].publication_ids.update(publication_ids)
            self._guard.add_topic(topic)
        return self[topic]

    def forget(self, topic: TypedTopic) -> None:
        """Remove a topic."""
        self.pop(topic).cancel_timers()
        self.on_forgotten(topic)
        self._guard.forget(topic)

    def _make_room(self) -> None:
        """Evict an idle topic, else the still one whose last command is the oldest."""
        if len(self) < MAX_TOPICS:
            return
        still = [topic for topic, state in self.items() if not state.is_stopping and not self._moves(topic)]
        if not still:
            raise Unavailable(
                f"{MAX_TOPICS} topics move the robot at this moment, the most there may be; "
                "stop commanding one of them first"
            )
        self.forget(min(still, key=lambda topic: (not self[topic].is_idle, self[topic].used_at)))
