"""When a topic that moves must be stopped, and how often zero is published then. No I/O: times in, topics to stop out.

The daemon and the guard run the same :class:`Watchdog`; the guard's acts a little later.
"""

from __future__ import annotations

from typing import NamedTuple

from robot_client.motion.command_age import MILLI
from robot_client.motion.typed_topic import TypedTopic

DAEMON_SHARE = 0.8
GUARD_SHARE = 0.9
"""Shares of ``stop_within_ms`` after which each watchdog acts; the rest is left for scheduling and delivery."""

STOP_ZEROS = 5
STOP_ZERO_EVERY = 40 * MILLI
"""Zero is published five times, 40 ms apart (here in nanoseconds), as a best-effort subscriber may miss the first."""


class CommandTimes(NamedTuple):
    """Times of the commands on a topic, milliseconds.

    :ivar stop_within_ms: from the last command to the stop
    :ivar deadline_ms: greatest age of a command
    """

    stop_within_ms: int
    deadline_ms: int


class _MovingTopic(NamedTuple):
    publication_id: str
    until: int


class Watchdog:
    """Tracks which topics move, by which publication and until when.

    :param within_ms: time from the last command to the stop, milliseconds
    :param share: share of it after which this watchdog acts
    :param earlier_ms: milliseconds it acts earlier, as long as a ramp takes
    """

    def __init__(self, within_ms: int, share: float, earlier_ms: int = 0) -> None:
        self._within_ms = within_ms
        self._share = share
        self._lead = earlier_ms * MILLI
        self._within_by_topic: dict[str, int] = {}
        self._moving: dict[TypedTopic, _MovingTopic] = {}

    def set_time_to_stop(self, topic: str, within_ms: int) -> None:
        """Set the time to stop of a single topic, milliseconds."""
        self._within_by_topic[topic] = within_ms

    def latest_stop(self, topic: TypedTopic, now: int) -> int:
        """When zero must be published at the latest on a topic that is commanded now, nanoseconds."""
        return now + int(self._within_by_topic.get(topic.name, self._within_ms) * self._share * MILLI)

    def moves(self, topic: TypedTopic) -> bool:
        """Whether the last command on this topic was to move."""
        return topic in self._moving

    def note_command(
        self, topic: TypedTopic, publication_id: str, moving: bool, now: int, expiry: int | None = None
    ) -> None:
        """Note a published command.

        :param publication_id: id of the publication it came on
        :param moving: whether it was other than zero
        :param now: nanoseconds
        :param expiry: when it no longer counts, nanoseconds; ``None``: only the time to stop ends it
        """
        if moving:
            until = self.latest_stop(topic, now) - self._lead
            self._moving[topic] = _MovingTopic(
                publication_id, until if expiry is None else min(until, expiry)
            )
        else:
            self._moving.pop(topic, None)

    def due(self) -> int | None:
        """When :meth:`take_expired` will next return a topic, nanoseconds; ``None``: no topic moves."""
        if not self._moving:
            return None
        return min(each.until for each in self._moving.values())

    def take_expired(self, now: int) -> list[TypedTopic]:
        """Topics whose commands have ended; each is returned once."""
        return self._mark_still([topic for topic, each in self._moving.items() if now >= each.until])

    def remove_publication(self, topic: TypedTopic, publication_id: str) -> bool:
        """Remove a publication; return whether its topic must be stopped, as this publication moved it."""
        moving = self._moving.get(topic)
        return (
            moving is not None and moving.publication_id == publication_id and bool(self._mark_still([topic]))
        )

    def take_all(self) -> list[TypedTopic]:
        """All topics that move, to be stopped now; each is returned once."""
        return self._mark_still(list(self._moving))

    def _mark_still(self, topics: list[TypedTopic]) -> list[TypedTopic]:
        for topic in topics:
            del self._moving[topic]
        return topics
