"""Notices that wait, in the order they came, and which of them give way where there are too many. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

from relay_server.alerts import kinds
from relay_server.alerts.message import Notice

Key = tuple[str, str]
"""The alert's id and the event: the same news waits once."""


class Waiting(NamedTuple):
    """A notice that waits.

    :param since: when it came first, monotonic seconds
    """

    notice: Notice
    since: float


class Heap:
    """So many notices at most.

    :param most: places
    :param fair: one robot's many give way before another's few, whatever they tell
    """

    def __init__(self, most: int, *, fair: bool = False) -> None:
        self._most = most
        self._fair = fair
        self._waiting: dict[Key, Waiting] = {}

    def __len__(self) -> int:
        return len(self._waiting)

    def __iter__(self) -> Iterator[Waiting]:
        return iter(list(self._waiting.values()))

    def put(self, notice: Notice, since: float) -> int:
        """Put a notice where its place in time is; how many gave way."""
        key = _key(notice)
        before = self._waiting.pop(key, None)
        self._waiting[key] = Waiting(notice, since if before is None else before.since)
        if len(self._waiting) <= self._most:
            return 0
        del self._waiting[self._least()]
        return 1

    def drop(self, notice: Notice) -> Waiting | None:
        """It waits no more; the latest of the same news, if there was any."""
        return self._waiting.pop(_key(notice), None)

    def take(self) -> list[Notice]:
        """All, in their order; none is left."""
        taken, self._waiting = self._waiting, {}
        return [each.notice for each in taken.values()]

    def clear(self) -> None:
        """None is left."""
        self._waiting.clear()

    def _least(self) -> Key:
        """Which one matters least: the mildest, among those an end, among those the oldest."""
        crowd = 0
        robots: Counter[int] = Counter()
        if self._fair:
            robots.update(each.notice.alert.robot_id for each in self._waiting.values())
            crowd = max(robots.values())
        there = ((key, each.notice) for key, each in self._waiting.items())
        found = ((key, it) for key, it in there if robots[it.alert.robot_id] == crowd)
        key, _ = min(found, key=lambda each: _weight(each[1]))
        return key


def _key(notice: Notice) -> Key:
    return notice.alert.id, notice.event


def _weight(notice: Notice) -> tuple[int, bool]:
    return kinds.severity(notice.alert.level), not notice.ends
