"""Zero on the topics that move the robot, for a while after a stop: other nodes of the robot may go on commanding them.

The motion desk has said it on those that clients command, but is done with that sooner.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from twisted.logger import Logger

from relay_protocol.link import MotionPolicy
from robot_client.motion.motion import MOTION_QOS
from robot_client.platforms.base import Platform, PublisherHandle
from robot_client.platforms.ros2.motion import SHAPED
from robot_client.twisted_types import DelayedCall, ReactorClock

EVERY = 0.05
"""Seconds between two zeros."""

TIMES = 20
"""How often zero is said: a subscriber needs some time to find a new publisher."""

MAX_TOPICS = 16


class _Open(NamedTuple):
    topic: str
    type: str
    sink: PublisherHandle


class ZeroPublisher:
    """Says zero for a while, and leaves.

    :param policy: what counts as motion
    :param commanded: whether clients may command a topic; those come first
    """

    def __init__(
        self, policy: MotionPolicy, platform: Platform, clock: ReactorClock, commanded: Callable[[str], bool]
    ) -> None:
        self._policy = policy
        self._platform = platform
        self._clock = clock
        self._commanded = commanded
        self._open: list[_Open] = []
        self._left = 0
        self._timer: DelayedCall | None = None
        self._log = Logger("zeros")

    def say(self) -> None:
        """Begin, or go on for longer."""
        self._left = TIMES
        if self._timer is not None:
            return
        for topic, type in self._topics()[:MAX_TOPICS]:
            try:
                sink = self._platform.advertise(topic, type, False, MOTION_QOS)
            except Exception as error:  # one topic that fails must not keep the next from its zero
                self._failed(topic, error)
            else:
                self._open.append(_Open(topic, type, sink))
        self._again()

    def end(self) -> None:
        """Say no more."""
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._timer = None
        self._left = 0
        leaving, self._open = self._open, []
        for each in leaving:
            self._close(each)

    def _again(self) -> None:
        self._timer = None
        if not self._left or not self._open:
            self.end()
            return
        self._left -= 1
        for each in list(self._open):
            try:
                each.sink.publish(self._platform.zero(each.type))
            except Exception as error:
                self._failed(each.topic, error)
                self._open.remove(each)
                self._close(each)
        self._timer = self._clock.callLater(EVERY, self._again)

    def _close(self, open: _Open) -> None:
        try:
            open.sink.close()
        except Exception:  # the platform may have gone meanwhile
            self._log.failure("a publisher could not be taken away")

    def _topics(self) -> list[tuple[str, str]]:
        """Topics that somebody listens to, and their types; not those whose zero depends on the command before."""
        try:
            topics = self._platform.graph().topics
        except Exception:  # the rest of the stop must not hang on it
            self._log.failure("the graph could not be read")
            return []
        found = []
        for name, topic in sorted(topics.items()):
            type = next((each for each in topic.types if self._policy.moves_by_topic(name, each)), "")
            if type and type not in SHAPED and topic.subscribers:
                found.append((name, type))
        return sorted(found, key=lambda each: not self._commanded(each[0]))

    def _failed(self, topic: str, error: Exception) -> None:
        self._log.warn("zero could not be said on {topic}: {error}", topic=topic, error=str(error))
