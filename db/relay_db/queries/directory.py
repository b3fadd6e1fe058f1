"""The directory: what services and applications say of themselves, each as long as its lease lasts.

A lease is over at its ``expires`` whether or not anybody has looked: no query tells of it any more from then on.
"""

from __future__ import annotations

from collections.abc import Collection
from fnmatch import fnmatchcase
from typing import Any

from sqlalchemy import ColumnElement, delete, func, insert, select, update
from sqlalchemy.orm import Session

from relay_db.models import DirectoryEntry, Realm, Robot, User
from relay_db.names import findable_hex, normalise
from relay_db.queries.directory_records import EntryCursor, EntryRecord, EntrySearch, LeaseTimes, NewEntry
from relay_db.queries.realms import robot_is_of
from relay_db.queries.state import bump
from relay_protocol.errors import NotFound, Refused

_BATCH = 500
"""Rows looked up, or let go, in one statement."""


class AlreadyExists(Refused):
    """Somebody else has registered something by this name."""

    code = "taken"


class QuotaExceeded(Refused):
    """The user or the realm has as many entries as it may have."""

    code = "no_room"


def register_entry(
    s: Session, new: NewEntry, entry_id: str, now: float, *, of_user: int, of_realm: int
) -> tuple[EntryRecord, EntryRecord | None]:
    """Enter something, or renew what the same user has entered by this kind, name and robot; it as it is kept.

    :param entry_id: for a new one, unguessable and never used before: up to 32 hex digits
    :param now: Unix seconds
    :param of_user: entries that a user may have; ``of_realm``: and a realm
    :returns: the entry, and the one it was before, ``None`` for a new one
    :raises Taken: somebody else has it
    :raises NoRoom: the user or the realm has too many
    :raises NotFound: no such realm
    """
    # On PostgreSQL all who register in a realm do so one after the other from here on.
    realm = s.scalar(select(Realm.id).where(Realm.name == normalise(new.realm)).with_for_update())
    if realm is None:
        raise NotFound("there is no such realm")
    if new.robot_id is not None and not robot_is_of(s, new.robot_id, realm):
        raise NotFound("there is no such robot")
    live = (DirectoryEntry.realm_id == realm, DirectoryEntry.expires > now)
    about = (
        DirectoryEntry.robot_id.is_(None) if new.robot_id is None else DirectoryEntry.robot_id == new.robot_id
    )
    row = s.execute(
        _entries().where(*live, about, DirectoryEntry.kind == new.kind, DirectoryEntry.name == new.name)
    ).first()
    before = None if row is None else EntryRecord(*row)
    values = {
        "address": new.address,
        "description": new.description,
        "data": new.data,
        "ttl": new.ttl,
        "expires": now + new.ttl,
    }
    if before is not None:
        if before.user_id != new.user_id:
            raise AlreadyExists(f"{before.user} has registered the {before.kind} '{before.name}' already")
        s.execute(update(DirectoryEntry).where(DirectoryEntry.id == before.id).values(**values))
        return _kept(s, before.id), before
    if _count(s, *live, DirectoryEntry.user_id == new.user_id) >= of_user:
        raise QuotaExceeded(f"a user has {of_user} entries in the directory at most; remove one first")
    if _count(s, *live) >= of_realm:
        raise QuotaExceeded(f"the directory is full: it holds {of_realm} entries at most")
    fixed = {
        "id": entry_id,
        "realm_id": realm,
        "user_id": new.user_id,
        "robot_id": new.robot_id,
        "kind": new.kind,
        "name": new.name,
        "registered": now,
    }
    s.execute(insert(DirectoryEntry).values(**fixed, **values))
    return _kept(s, entry_id), None


def get_entry(s: Session, realm: str, entry_id: str, now: float) -> EntryRecord | None:
    """One entry whose lease lasts."""
    row = s.execute(
        _entries().where(
            DirectoryEntry.id == findable_hex(entry_id),
            Realm.name == normalise(realm),
            DirectoryEntry.expires > now,
        )
    ).one_or_none()
    return None if row is None else EntryRecord(*row)


def all_entries(s: Session, now: float) -> list[EntryRecord]:
    """All whose leases last, of all realms."""
    return [EntryRecord(*row) for row in s.execute(_entries().where(DirectoryEntry.expires > now))]


def list_entries(s: Session, ask: EntrySearch, now: float, limit: int) -> list[EntryRecord]:
    """Entries whose leases last, in the order of their places.

    :param now: Unix seconds
    :param limit: most entries
    """
    query = (
        select(
            DirectoryEntry.id,
            DirectoryEntry.robot_id,
            Robot.name.label("robot"),
            DirectoryEntry.kind,
            DirectoryEntry.name,
        )
        .join(Realm, Realm.id == DirectoryEntry.realm_id)
        .outerjoin(Robot, Robot.id == DirectoryEntry.robot_id)
        .where(Realm.name == normalise(ask.realm), DirectoryEntry.expires > now)
    )
    if ask.kind is not None:
        query = query.where(DirectoryEntry.kind == ask.kind)
    # Sorted here: databases order texts by rules of their own.
    places = sorted(
        EntryCursor(row.robot or "", row.kind, row.name, row.id)
        for row in s.execute(query)
        if _wanted(ask, row.robot_id) and fnmatchcase(row.name, ask.name)
    )
    wanted = [each.id for each in places if ask.after is None or each > ask.after][:limit]
    found: dict[str, EntryRecord] = {}
    for first in range(0, len(wanted), _BATCH):
        ids = wanted[first : first + _BATCH]
        found |= {
            row.id: EntryRecord(*row) for row in s.execute(_entries().where(DirectoryEntry.id.in_(ids)))
        }
    return [found[each] for each in wanted if each in found]


def _wanted(ask: EntrySearch, robot_id: int | None) -> bool:
    if robot_id is None:
        return ask.general
    return ask.robots is None or robot_id in ask.robots


def renew_entry(s: Session, entry_id: str, now: float) -> EntryRecord | None:
    """Have a lease that lasts begin anew; the entry, ``None`` when there is none.

    :param now: Unix seconds
    """
    mine = (DirectoryEntry.id == findable_hex(entry_id), DirectoryEntry.expires > now)
    renewed = update(DirectoryEntry).where(*mine).values(expires=now + DirectoryEntry.ttl)
    found = s.scalar(renewed.returning(DirectoryEntry.id))
    return None if found is None else _kept(s, found)


def change_entry(
    s: Session, before: EntryRecord, *, address: str, description: str, data: str, ttl: float, now: float
) -> EntryRecord | None:
    """Have an entry say something else, and its lease begin anew; ``None`` when it is not as it was any more.

    :param now: Unix seconds
    """
    same = (
        DirectoryEntry.id == before.id,
        DirectoryEntry.expires == before.expires,
        DirectoryEntry.expires > now,
        DirectoryEntry.address == before.address,
        DirectoryEntry.description == before.description,
        DirectoryEntry.data == before.data,
        DirectoryEntry.ttl == before.ttl,
    )
    values = {"address": address, "description": description, "data": data, "ttl": ttl, "expires": now + ttl}
    changed = update(DirectoryEntry).where(*same).values(**values)
    found = s.scalar(changed.returning(DirectoryEntry.id))
    return None if found is None else _kept(s, found)


def remove_entry(s: Session, entry_id: str, now: float, *, counts: bool = False) -> EntryRecord | None:
    """Take an entry out; as it was, ``None`` when there is none whose lease lasts.

    :param now: Unix seconds
    :param counts: whether it counts as a change that a relay which runs has to take up
    """
    mine = (DirectoryEntry.id == findable_hex(entry_id), DirectoryEntry.expires > now)
    row = s.execute(_entries().where(*mine)).one_or_none()
    if row is None or s.scalar(delete(DirectoryEntry).where(*mine).returning(DirectoryEntry.id)) is None:
        return None
    if counts:
        bump(s)
    return EntryRecord(*row)


# --- leases -----------------------------------------------------------------------------------------------


def leases(s: Session, now: float) -> LeaseTimes:
    """How the leases stand.

    :param now: Unix seconds
    """
    rows = s.execute(select(DirectoryEntry.id, DirectoryEntry.ttl, DirectoryEntry.expires)).all()
    return LeaseTimes(
        frozenset(row.id for row in rows),
        min((row.expires for row in rows), default=None),
        any(row.expires > now + row.ttl for row in rows),
    )


def bound_leases(s: Session, now: float) -> None:
    """Have no lease last longer from now on than it was given: a clock that was set back would prolong them all.

    :param now: Unix seconds
    """
    longest = now + DirectoryEntry.ttl
    s.execute(update(DirectoryEntry).where(DirectoryEntry.expires > longest).values(expires=longest))


def expire_entries(s: Session, now: float) -> list[EntryRecord]:
    """Let some of those go whose leases are over; call again until there are none.

    :param now: Unix seconds
    """
    over = _entries().where(DirectoryEntry.expires <= now).order_by(DirectoryEntry.expires).limit(_BATCH)
    found = [EntryRecord(*row) for row in s.execute(over)]
    gone = _delete(s, [each.id for each in found], now)
    return [each for each in found if each.id in gone]


def _delete(s: Session, ids: Collection[str], now: float) -> set[str]:
    """Those of these that are over by now, and gone: one may have been renewed a moment ago."""
    over = DirectoryEntry.id.in_(list(ids)), DirectoryEntry.expires <= now
    return set(s.scalars(delete(DirectoryEntry).where(*over).returning(DirectoryEntry.id))) if ids else set()


def _entries() -> Any:
    query: Any = (
        select(
            DirectoryEntry.id,
            Realm.name.label("realm"),
            DirectoryEntry.kind,
            DirectoryEntry.name,
            DirectoryEntry.address,
            DirectoryEntry.description,
            DirectoryEntry.robot_id,
            Robot.name.label("robot"),
            DirectoryEntry.user_id,
            User.name.label("user"),
            DirectoryEntry.data,
            DirectoryEntry.ttl,
            DirectoryEntry.registered,
            DirectoryEntry.expires,
        )
        .join(Realm, Realm.id == DirectoryEntry.realm_id)
        .join(User, User.id == DirectoryEntry.user_id)
        .outerjoin(Robot, Robot.id == DirectoryEntry.robot_id)
    )
    return query


def _kept(s: Session, entry_id: str) -> EntryRecord:
    return EntryRecord(*s.execute(_entries().where(DirectoryEntry.id == entry_id)).one())


def _count(s: Session, *conditions: ColumnElement[bool]) -> int:
    return s.scalar(select(func.count()).select_from(DirectoryEntry).where(*conditions)) or 0
