"""Changes of the service registry: each with its audit entry in one transaction, and the recent ones in memory."""

from __future__ import annotations

from collections import deque
from itertools import islice
from typing import Any, NamedTuple

from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.queries import EntryRecord
from relay_protocol.realms import full_name
from relay_server.access import Principal
from relay_server.events.bus import EventFollower
from relay_server.service_registry.entries import HISTORY


def change(
    s: Session, principal: Principal, before: EntryRecord, values: dict[str, Any], now: float, address: str
) -> EntryRecord | None:
    """Change an entry; see :func:`relay_db.queries.service_registry.change_entry`.

    :param address: of the client
    """
    kept = queries.change_entry(s, before, now=now, **values)
    if kept is not None:
        _audit(s, "directory.change", principal, kept, now, address)
    return kept


def remove(
    s: Session, principal: Principal, before: EntryRecord, now: float, address: str
) -> EntryRecord | None:
    """Remove an entry; see :func:`relay_db.queries.service_registry.remove_entry`."""
    gone = queries.remove_entry(s, before.id, now)
    if gone is not None:
        _audit(s, "directory.remove", principal, gone, now, address)
    return gone


def _audit(
    s: Session, action: str, principal: Principal, record: EntryRecord, now: float, address: str
) -> None:
    """Append an audit entry if a user changes what another has registered. Of their own entries events are enough."""
    if record.user_id == principal.user_id:
        return
    queries.append_audit(
        s,
        at=now,
        actor=f"user:{principal.full}",
        action=action,
        target=record.id,
        origin=address,
        data=audited(record),
    )


def audited(record: EntryRecord) -> dict[str, Any]:
    """The data of an audit entry about an entry."""
    return {
        "kind": record.kind,
        "name": record.name,
        "robot": record.robot and full_name(record.robot, record.realm),
        "registrant": full_name(record.user, record.realm),
        "address": record.address,
    }


FOLLOWED_AT_ONCE = 100
"""Changes that a follower gets at a time."""


class EntryChange(NamedTuple):
    """A change of an entry.

    :param number: within its realm, in the order in which they happened
    :param what: ``registered``, ``changed``, ``expired`` or ``removed``
    """

    number: int
    what: str
    entry: EntryRecord


class NewChanges(NamedTuple):
    """Changes that a follower does not have yet.

    :param missed: whether earlier ones are not in memory any more
    :param more: whether there may be further ones
    """

    changes: list[EntryChange]
    missed: bool = False
    more: bool = False


class RecentEntryChanges:
    """The newest changes of each realm, and their followers.

    :param era: names this run of the relay; numbers of other runs mean nothing here
    :param size: changes of each realm that are kept
    """

    def __init__(self, era: str, size: int = HISTORY) -> None:
        self._era = era
        self._size = size
        self._kept: dict[str, deque[EntryChange]] = {}
        self._followers: dict[EventFollower, str] = {}

    def publish(self, what: str, entry: EntryRecord) -> None:
        """Add a change, and wake the followers of its realm."""
        kept = self._kept.setdefault(entry.realm, deque(maxlen=self._size))
        kept.append(EntryChange(self._latest(entry.realm) + 1, what, entry))
        for follower, realm in list(self._followers.items()):
            if realm == entry.realm:
                follower.wake()

    def forget_realm(self, realm: str) -> None:
        """Drop the changes and followers of a realm that was removed; a new one of its name is another."""
        self._kept.pop(realm, None)
        self._followers = {follower: of for follower, of in self._followers.items() if of != realm}

    def follow(self, realm: str, last: str | None) -> tuple[EventFollower, bool]:
        """A follower of changes, until :meth:`unfollow`; and whether it may have missed some.

        :param last: the event id of the last change that the reader has; ``None`` for the latest
        """
        latest = self._latest(realm)
        era, _, number = (last or "").partition("-")
        known = era == self._era and number.isascii() and number.isdigit() and len(number) <= 18
        follower = EventFollower(min(int(number), latest) if known else latest)
        self._followers[follower] = realm
        return follower, last is not None and not known

    def unfollow(self, follower: EventFollower) -> None:
        """Stop waking a follower."""
        self._followers.pop(follower, None)

    def event_id(self, number: int) -> str:
        """The id of a change in a stream; as ``last`` of :meth:`follow` it continues behind the change."""
        return f"{self._era}-{number}"

    def news(self, realm: str, follower: EventFollower) -> NewChanges:
        """The next changes for a follower."""
        follower.fresh = False
        kept = self._kept.get(realm)
        if follower not in self._followers or not kept or kept[-1].number <= follower.number:
            return NewChanges([])
        begin = follower.number + 1 - kept[0].number
        found = list(islice(kept, max(0, begin), max(0, begin) + FOLLOWED_AT_ONCE))
        follower.number = found[-1].number
        return NewChanges(found, begin < 0, kept[-1].number > follower.number)

    def _latest(self, realm: str) -> int:
        kept = self._kept.get(realm)
        return kept[-1].number if kept else 0
