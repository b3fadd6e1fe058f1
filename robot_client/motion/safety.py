"""Which topics move the robot, and when it must be stopped. Pure: times go in, topics to stop come out.

The daemon and the guard run the same :class:`Watchdog`, the guard a little later.
"""

from __future__ import annotations

import enum
from typing import NamedTuple

from relay_protocol.link import MotionPolicy
from robot_client.link.clock_offset import ClockOffset
from robot_client.motion.typed_topic import TypedTopic

MILLI = 1_000_000
DAEMON_SHARE = 0.8
GUARD_SHARE = 0.9
"""Shares of ``stop_within_ms`` after which each watchdog acts; the rest is for scheduling and delivery."""

VOID_SHARE = 0.9
"""Share of the deadline after which a command that was followed counts no more."""

PROOF_EVERY = 0.1
"""Seconds between pings that prove the link both ways, while somebody may command the robot."""


REPEATS = 5
REPEAT_EVERY = 40 * MILLI
"""A stop is said five times within 200 ms: the first may be lost on its way to a best-effort subscriber."""


class Times(NamedTuple):
    """How long the last command on a topic counts, and how old one may be, milliseconds."""

    stop_within_ms: int
    deadline_ms: int


class CommandAge(enum.Enum):
    """What the age of a command says about it."""

    FRESH = "fresh"
    STALE = "stale"
    AHEAD = "ahead"


def freshness(stamp: int, now: int, offset: ClockOffset, deadline_ms: int) -> CommandAge:
    """Judge a command by the greatest age it can have.

    :param stamp: the relay's monotonic clock, nanoseconds, see :class:`relay_protocol.frames.SampleFrame`
    :param now: own monotonic clock, nanoseconds
    """
    oldest = offset.oldest(stamp, now)
    if oldest is None or oldest > deadline_ms * MILLI:
        return CommandAge.STALE
    return CommandAge.AHEAD if oldest < 0 else CommandAge.FRESH


def earliest(stamp: int, now: int, offset: ClockOffset) -> int:
    """The moment before which a command can't have been sent, own clock, nanoseconds; no later than ``now``.

    :param stamp: as of :func:`freshness`, like ``now``
    :return: 0 while nobody knows how old it can be
    """
    oldest = offset.oldest(stamp, now)
    return 0 if oldest is None else now - max(oldest, 0)


def void_at(stamp: int, now: int, offset: ClockOffset, proof: int, deadline_ms: int, within_ms: int) -> int:
    """When a command counts no more: by its age, or because the link is not known to work both ways, nanoseconds.

    Whoever drives a robot that he hears nothing of any more must not go on.

    :param stamp: as of :func:`freshness`, which has found the command fresh
    :param proof: when the latest ping that the relay has answered was sent
    """
    age = offset.oldest(stamp, now) or 0
    by_age = now - age + int(deadline_ms * VOID_SHARE * MILLI)
    return min(by_age, proof + int(max(deadline_ms, within_ms) * VOID_SHARE * MILLI))


def is_motion(policy: MotionPolicy, on: TypedTopic) -> bool:
    """Whether commands on this topic move the robot; ``on`` as the platform resolved it."""
    return policy.moves_by_topic(on.topic, on.type)


class _Moving(NamedTuple):
    source: str
    until: int


class Watchdog:
    """Knows which topics were last told to move, by whom and when.

    :param within_ms: time from the last command to the stop, milliseconds
    :param share: share of it after which this watchdog acts
    :param earlier_ms: how much earlier it acts, for what the stop takes
    """

    def __init__(self, within_ms: int, share: float, earlier_ms: int = 0) -> None:
        self._within_ms = within_ms
        self._share = share
        self._earlier = earlier_ms * MILLI
        self._own: dict[str, int] = {}
        self._moving: dict[TypedTopic, _Moving] = {}

    def within(self, topic: str, within_ms: int) -> None:
        """A time of its own for a topic, milliseconds."""
        self._own[topic] = within_ms

    def latest(self, topic: TypedTopic, now: int) -> int:
        """By when zero must be said on a topic that gets a command now, nanoseconds."""
        return now + int(self._own.get(topic.topic, self._within_ms) * self._share * MILLI)

    def moves(self, topic: TypedTopic) -> bool:
        """Whether the last command on this topic was to move."""
        return topic in self._moving

    def command(
        self, topic: TypedTopic, source: str, moving: bool, now: int, void: int | None = None
    ) -> None:
        """A valid command went out on a topic.

        :param now: nanoseconds
        :param void: when it counts no more, however soon after this; ``None``: nothing but silence ends it
        """
        if moving:
            until = self.latest(topic, now) - self._earlier
            self._moving[topic] = _Moving(source, until if void is None else min(until, void))
        else:
            self._moving.pop(topic, None)

    def due(self) -> int | None:
        """When :meth:`expired` will next name a topic, nanoseconds; ``None`` while all stand still."""
        if not self._moving:
            return None
        return min(each.until for each in self._moving.values())

    def expired(self, now: int) -> list[TypedTopic]:
        """Topics whose commands ceased; each is named once."""
        return self._settle([topic for topic, each in self._moving.items() if now >= each.until])

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
