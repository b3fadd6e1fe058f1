"""Publishes zero on the motion topics in the graph for a while after a stop, as other nodes may still command them.

It leaves out topics whose zero depends on the last command, as a joystick's axes do, and topics beyond
:data:`MAX_TOPICS`. :mod:`robot_client.motion.topic_stopper` publishes zero on topics that clients command, of any type,
but ends that sooner.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from twisted.logger import Logger

from relay_protocol.link import MotionPolicy
from robot_client.motion.motion_control import MOTION_QOS
from robot_client.platforms.base import Platform, PublisherHandle
from robot_client.platforms.ros2.command_classifier import TYPES_WITH_TEMPLATE
from robot_client.twisted_types import DelayedCall, ReactorClock

ZERO_EVERY = 0.05
"""Seconds between two zeros."""

ZEROS = 20
"""Number of zeros per topic: a subscriber needs some time to discover a new publisher."""

MAX_TOPICS = 16
"""Most topics at a time; further ones are left out."""


class _OpenPublisher(NamedTuple):
    type: str
    publisher: PublisherHandle


class GraphZeroPublisher:
    """Publishes :data:`ZEROS` zeros on each motion topic in the graph, then removes its publishers.

    :param policy: what counts as motion
    :param commanded: whether clients may command a topic; those topics come first
    """

    def __init__(
        self, policy: MotionPolicy, platform: Platform, clock: ReactorClock, commanded: Callable[[str], bool]
    ) -> None:
        self._policy = policy
        self._platform = platform
        self._clock = clock
        self._commanded = commanded
        self._publishers: dict[str, _OpenPublisher] = {}
        """By topic."""
        self._zeros_left = 0
        self._timer: DelayedCall | None = None
        self._is_kept_ready = False
        self._log = Logger("motion")

    def keep_ready(self, ready: bool) -> None:
        """Open the publishers before they are needed, or end that.

        While goals move the robot: subscribers have discovered the publishers when a stop comes, so the first zero
        stops a robot whose navigator hangs.
        """
        self._is_kept_ready = ready
        if ready:
            self._open()
        elif self._timer is None:
            self._close()

    @property
    def is_busy(self) -> bool:
        """Whether it has publishers."""
        return bool(self._publishers)

    def start(self) -> None:
        """Begin to publish zeros; while they are under way, restart the count."""
        self._zeros_left = ZEROS
        if self._timer is None:
            self._open()
            self._publish_zeros()

    def end(self) -> None:
        """Stop publishing and remove the publishers, unless they are kept ready."""
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._timer = None
        self._zeros_left = 0
        if not self._is_kept_ready:
            self._close()

    def _open(self) -> None:
        for topic, type in self._find_topics()[:MAX_TOPICS]:
            if topic in self._publishers or len(self._publishers) >= MAX_TOPICS:
                continue
            try:
                publisher = self._platform.advertise(topic, type, False, MOTION_QOS)
            except Exception as error:  # a failure on one topic must not prevent the zero of the next
                self._log_failure(topic, error)
            else:
                self._publishers[topic] = _OpenPublisher(type, publisher)

    def _publish_zeros(self) -> None:
        self._timer = None
        if not self._zeros_left or not self._publishers:
            self.end()
            return
        self._zeros_left -= 1
        for topic, each in list(self._publishers.items()):
            try:
                each.publisher.publish(self._platform.zero_command(each.type))
            except Exception as error:
                self._log_failure(topic, error)
                self._close_one(self._publishers.pop(topic))
        self._timer = self._clock.callLater(ZERO_EVERY, self._publish_zeros)

    def _close(self) -> None:
        ended, self._publishers = self._publishers, {}
        for each in ended.values():
            self._close_one(each)

    def _close_one(self, publisher: _OpenPublisher) -> None:
        try:
            publisher.publisher.close()
        except Exception:  # the platform may be closed already
            self._log.failure("a publisher of zero could not be closed")

    def _find_topics(self) -> list[tuple[str, str]]:
        """Motion topics with subscribers, and their types; without types whose zero depends on the last command."""
        try:
            topics = self._platform.graph().topics
        except Exception:  # the other parts of a stop must not depend on it
            self._log.failure("the graph could not be read")
            return []
        found = []
        for name, topic in sorted(topics.items()):
            type = next((each for each in topic.types if self._policy.moves_by_topic(name, each)), "")
            if type and type not in TYPES_WITH_TEMPLATE and topic.subscribers:
                found.append((name, type))
        return sorted(found, key=lambda each: not self._commanded(each[0]))

    def _log_failure(self, topic: str, error: Exception) -> None:
        self._log.warn("zero could not be published on {topic}: {error}", topic=topic, error=str(error))
