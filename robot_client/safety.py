"""Which topics move the robot, and when it must be stopped. Pure: times go in, topics to stop come out.

The daemon and the guard run the same :class:`Watchdog`, the guard a little later.
"""

from __future__ import annotations

import enum
from typing import NamedTuple

from relay_protocol.link import MotionPolicy
from robot_client.offset import Offset
from robot_client.topics import TypedTopic

MILLI = 1_000_000
DAEMON_SHARE = 0.8
GUARD_SHARE = 0.9
"""Shares of ``stop_within_ms`` after which each watchdog acts; the rest is for scheduling and delivery."""


REPEATS = 5
REPEAT_EVERY = 40 * MILLI
"""A stop is said five times within 200 ms: the first may be lost on its way to a best-effort subscriber."""


class Freshness(enum.Enum):
    """What the age of a command says about it."""

    FRESH = "fresh"
    STALE = "stale"
    AHEAD = "ahead"


def freshness(stamp: int, now: int, offset: Offset, deadline_ms: int) -> Freshness:
    """Judge a command by the greatest age it can have.

    :param stamp: the relay's monotonic clock, nanoseconds, see :class:`relay_protocol.frames.SampleFrame`
    :param now: own monotonic clock, nanoseconds
    """
    oldest = offset.oldest(stamp, now)
    if oldest is None or oldest > deadline_ms * MILLI:
        return Freshness.STALE
    return Freshness.AHEAD if oldest < 0 else Freshness.FRESH


def is_motion(policy: MotionPolicy, on: TypedTopic) -> bool:
    """Whether commands on this topic move the robot; ``on`` as the platform resolved it."""
    return on.type in policy.types or on.topic in policy.topics


class _Moving(NamedTuple):
    source: str
    since: int


class Watchdog:
    """Knows which topics were last told to move, by whom and when.

    :param within_ms: time from the last command to the stop, milliseconds
    :param share: share of it after which this watchdog acts
    """

    def __init__(self, within_ms: int, share: float) -> None:
        self._patience = int(within_ms * share * MILLI)
        self._moving: dict[TypedTopic, _Moving] = {}

    def moves(self, topic: TypedTopic) -> bool:
        """Whether the last command on this topic was to move."""
        return topic in self._moving

    def command(self, topic: TypedTopic, source: str, moving: bool, now: int) -> None:
        """A valid command went out on a topic; ``now`` in nanoseconds."""
        if moving:
            self._moving[topic] = _Moving(source, now)
        else:
            self._moving.pop(topic, None)

    def due(self) -> int | None:
        """When :meth:`expired` will next name a topic, nanoseconds; ``None`` while all stand still."""
        if not self._moving:
            return None
        return min(each.since for each in self._moving.values()) + self._patience

    def expired(self, now: int) -> list[TypedTopic]:
        """Topics whose commands ceased; each is named once."""
        return self._settle(
            [topic for topic, each in self._moving.items() if now - each.since >= self._patience]
        )

    def release(self, topic: TypedTopic, source: str) -> bool:
        """A source leaves a topic; whether the topic must be stopped for it."""
        moving = self._moving.get(topic)
        return moving is not None and moving.source == source and bool(self._settle([topic]))

    def everything(self) -> list[TypedTopic]:
        """All topics that move, to be stopped now; each is named once."""
        return self._settle(list(self._moving))

    def _settle(self, topics: list[TypedTopic]) -> list[TypedTopic]:
        for topic in topics:
            del self._moving[topic]
        return topics
