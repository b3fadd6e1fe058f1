"""What came and went of late, for those who follow the directory; they hear of it without asking the database."""

from __future__ import annotations

from collections import deque
from itertools import islice
from typing import NamedTuple

from relay_db.queries import EntryRecord
from relay_server.events.service import EventFollower
from relay_server.registry.limits import KEPT

AT_ONCE = 100
"""Changes that are handed to a follower at a time."""


class EntryChange(NamedTuple):
    """Something became of an entry.

    :param number: within its realm, in the order in which they happened
    :param what: ``registered``, ``changed``, ``expired`` or ``removed``
    """

    number: int
    what: str
    entry: EntryRecord


class News(NamedTuple):
    """What a follower has not heard yet.

    :param missed: whether some before these is not known here any more
    :param more: whether there may be further ones
    """

    changes: list[EntryChange]
    missed: bool = False
    more: bool = False


class Changes:
    """See the module's text.

    :param era: names this run of the relay: numbers of another mean nothing here
    :param size: changes of each realm that are kept
    """

    def __init__(self, era: str, size: int = KEPT) -> None:
        self._era = era
        self._size = size
        self._kept: dict[str, deque[EntryChange]] = {}
        self._followers: dict[EventFollower, str] = {}

    def tell(self, what: str, entry: EntryRecord) -> None:
        """Something became of an entry."""
        kept = self._kept.setdefault(entry.realm, deque(maxlen=self._size))
        kept.append(EntryChange(self._latest(entry.realm) + 1, what, entry))
        for follower, realm in list(self._followers.items()):
            if realm == entry.realm:
                follower.wake()

    def forget(self, realm: str) -> None:
        """A realm is gone; one of its name is another, of which those who follow this one hear nothing."""
        self._kept.pop(realm, None)
        self._followers = {follower: of for follower, of in self._followers.items() if of != realm}

    def follow(self, realm: str, last: str | None) -> tuple[EventFollower, bool]:
        """Begin to follow, until :meth:`leave`; and whether what the follower knows is not known here.

        :param last: what :meth:`mark` gave with the last that is known already; ``None`` for whatever there is
        """
        latest = self._latest(realm)
        era, _, number = (last or "").partition("-")
        known = era == self._era and number.isascii() and number.isdigit() and len(number) <= 18
        follower = EventFollower(min(int(number), latest) if known else latest)
        self._followers[follower] = realm
        return follower, last is not None and not known

    def leave(self, follower: EventFollower) -> None:
        """He follows no more."""
        self._followers.pop(follower, None)

    def mark(self, number: int) -> str:
        """What a follower gives back to hear what came behind it."""
        return f"{self._era}-{number}"

    def news(self, realm: str, follower: EventFollower) -> News:
        """What he has not heard yet, some of it."""
        follower.fresh = False
        kept = self._kept.get(realm)
        if follower not in self._followers or not kept or kept[-1].number <= follower.number:
            return News([])
        begin = follower.number + 1 - kept[0].number
        found = list(islice(kept, max(0, begin), max(0, begin) + AT_ONCE))
        follower.number = found[-1].number
        return News(found, begin < 0, kept[-1].number > follower.number)

    def _latest(self, realm: str) -> int:
        kept = self._kept.get(realm)
        return kept[-1].number if kept else 0
