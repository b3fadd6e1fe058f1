"""The service registry: entries of services and applications, each with a lease.

A lease ends at its ``expires``; from then on no query returns the entry, even if it was not deleted yet.
"""

from __future__ import annotations

from collections.abc import Collection
from fnmatch import fnmatchcase
from typing import Any

from sqlalchemy import ColumnElement, delete, func, insert, select, update
from sqlalchemy.orm import Session

from relay_db.models import Realm, Robot, ServiceRegistryEntry, User
from relay_db.names import normalise, normalise_hex
from relay_db.queries.realms import robot_in_realm
from relay_db.queries.records import (
    EntryCursor,
    EntryRecord,
    EntrySearch,
    LeaseTimes,
    NewEntry,
    fetch_all,
    fetch_one,
    record_of,
)
from relay_db.queries.revision import bump
from relay_protocol.errors import NotFound, Refused

_BATCH = 500
"""Most rows that one statement reads or deletes."""


class AlreadyExists(Refused):
    """Another user has registered an entry of this name."""

    code = "taken"


class QuotaExceeded(Refused):
    """The user or the realm has as many entries as allowed."""

    code = "quota"


def register_entry(
    s: Session, new: NewEntry, entry_id: str, now: float, *, of_user: int, of_realm: int
) -> tuple[EntryRecord, EntryRecord | None]:
    """Register an entry, or replace the user's entry of the same kind, name and robot.

    :param entry_id: id of a new entry: random, up to 32 hex digits
    :param now: Unix seconds
    :param of_user: most entries of a user
    :param of_realm: most entries of a realm
    :returns: the entry, and the entry before; ``None`` for a new one
    :raises AlreadyExists: another user has registered it
    :raises QuotaExceeded: the user or the realm has too many
    :raises NotFound: no such realm or robot
    """
    # On PostgreSQL this serialises all registrations in the realm.
    realm_id = s.scalar(select(Realm.id).where(Realm.name == normalise(new.realm)).with_for_update())
    if realm_id is None:
        raise NotFound("there is no such realm")
    if new.robot_id is not None and not robot_in_realm(s, new.robot_id, realm_id):
        raise NotFound("there is no such robot")
    live = (ServiceRegistryEntry.realm_id == realm_id, ServiceRegistryEntry.expires > now)
    before = _same_entry(s, new, *live)
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
        s.execute(update(ServiceRegistryEntry).where(ServiceRegistryEntry.id == before.id).values(**values))
        return _stored(s, before.id), before
    if _count(s, *live, ServiceRegistryEntry.user_id == new.user_id) >= of_user:
        raise QuotaExceeded(
            f"a user may have at most {of_user} entries in the service registry; remove one first"
        )
    if _count(s, *live) >= of_realm:
        raise QuotaExceeded(
            f"the service registry of the realm is full ({of_realm} entries); remove some first"
        )
    fixed = {
        "id": entry_id,
        "realm_id": realm_id,
        "user_id": new.user_id,
        "robot_id": new.robot_id,
        "kind": new.kind,
        "name": new.name,
        "registered": now,
    }
    s.execute(insert(ServiceRegistryEntry).values(**fixed, **values))
    return _stored(s, entry_id), None


def _same_entry(s: Session, new: NewEntry, *live: ColumnElement[bool]) -> EntryRecord | None:
    """The entry of the same kind, name and robot, if there is one."""
    robot = ServiceRegistryEntry.robot_id
    same_robot = robot.is_(None) if new.robot_id is None else robot == new.robot_id
    query = _entries().where(
        *live, same_robot, ServiceRegistryEntry.kind == new.kind, ServiceRegistryEntry.name == new.name
    )
    row = s.execute(query).first()
    return None if row is None else record_of(EntryRecord, row)


def get_entry(s: Session, realm: str, entry_id: str, now: float) -> EntryRecord | None:
    """An entry, ``None`` if there is none or its lease has ended."""
    query = _entries().where(
        ServiceRegistryEntry.id == normalise_hex(entry_id),
        Realm.name == normalise(realm),
        ServiceRegistryEntry.expires > now,
    )
    return fetch_one(s, EntryRecord, query)


def all_entries(s: Session, now: float) -> list[EntryRecord]:
    """All entries with a lease that has not ended, of all realms."""
    return fetch_all(s, EntryRecord, _entries().where(ServiceRegistryEntry.expires > now))


def list_entries(s: Session, search: EntrySearch, now: float, limit: int) -> list[EntryRecord]:
    """Entries with a lease that has not ended, in the order of :class:`EntryCursor`.

    :param now: Unix seconds
    :param limit: most entries
    """
    query = (
        select(
            ServiceRegistryEntry.id,
            ServiceRegistryEntry.robot_id,
            Robot.name.label("robot"),
            ServiceRegistryEntry.kind,
            ServiceRegistryEntry.name,
        )
        .join(Realm, Realm.id == ServiceRegistryEntry.realm_id)
        .outerjoin(Robot, Robot.id == ServiceRegistryEntry.robot_id)
        .where(Realm.name == normalise(search.realm), ServiceRegistryEntry.expires > now)
    )
    if search.kind is not None:
        query = query.where(ServiceRegistryEntry.kind == search.kind)
    # Sorted here, because databases order text differently.
    cursors = sorted(
        EntryCursor(row.robot or "", row.kind, row.name, row.id)
        for row in s.execute(query)
        if _wanted(search, row.robot_id) and fnmatchcase(row.name, search.name)
    )
    wanted = [each.id for each in cursors if search.after is None or each > search.after][:limit]
    found: dict[str, EntryRecord] = {}
    for first in range(0, len(wanted), _BATCH):
        ids = wanted[first : first + _BATCH]
        found |= {
            row.id: record_of(EntryRecord, row)
            for row in s.execute(_entries().where(ServiceRegistryEntry.id.in_(ids)))
        }
    return [found[each] for each in wanted if each in found]


def _wanted(search: EntrySearch, robot_id: int | None) -> bool:
    if robot_id is None:
        return search.without_robot
    return search.robots is None or robot_id in search.robots


def renew_entry(s: Session, entry_id: str, now: float) -> EntryRecord | None:
    """Renew a lease; returns the entry, ``None`` if there is none or its lease has ended.

    :param now: Unix seconds
    """
    own = (ServiceRegistryEntry.id == normalise_hex(entry_id), ServiceRegistryEntry.expires > now)
    renewed = update(ServiceRegistryEntry).where(*own).values(expires=now + ServiceRegistryEntry.ttl)
    found = s.scalar(renewed.returning(ServiceRegistryEntry.id))
    return None if found is None else _stored(s, found)


def change_entry(
    s: Session, before: EntryRecord, *, address: str, description: str, data: str, ttl: float, now: float
) -> EntryRecord | None:
    """Change an entry and renew its lease; ``None`` if it has changed since it was read.

    :param now: Unix seconds
    """
    same = (
        ServiceRegistryEntry.id == before.id,
        ServiceRegistryEntry.expires == before.expires,
        ServiceRegistryEntry.expires > now,
        ServiceRegistryEntry.address == before.address,
        ServiceRegistryEntry.description == before.description,
        ServiceRegistryEntry.data == before.data,
        ServiceRegistryEntry.ttl == before.ttl,
    )
    values = {"address": address, "description": description, "data": data, "ttl": ttl, "expires": now + ttl}
    changed = update(ServiceRegistryEntry).where(*same).values(**values)
    found = s.scalar(changed.returning(ServiceRegistryEntry.id))
    return None if found is None else _stored(s, found)


def remove_entry(s: Session, entry_id: str, now: float, *, announce: bool = False) -> EntryRecord | None:
    """Remove an entry and return it; ``None`` if there is none or its lease has ended.

    :param now: Unix seconds
    :param announce: whether to count up the revision, so that a running relay notices
    """
    own = (ServiceRegistryEntry.id == normalise_hex(entry_id), ServiceRegistryEntry.expires > now)
    row = s.execute(_entries().where(*own)).one_or_none()
    if (
        row is None
        or s.scalar(delete(ServiceRegistryEntry).where(*own).returning(ServiceRegistryEntry.id)) is None
    ):
        return None
    if announce:
        bump(s)
    return record_of(EntryRecord, row)


# --- leases -----------------------------------------------------------------------------------------------


def lease_times(s: Session, now: float) -> LeaseTimes:
    """The state of all leases.

    :param now: Unix seconds
    """
    rows = s.execute(
        select(ServiceRegistryEntry.id, ServiceRegistryEntry.ttl, ServiceRegistryEntry.expires)
    ).all()
    return LeaseTimes(
        frozenset(row.id for row in rows),
        min((row.expires for row in rows), default=None),
        any(row.expires > now + row.ttl for row in rows),
    )


def clamp_leases(s: Session, now: float) -> None:
    """Shorten leases that last longer than they were granted, because the clock was set back.

    :param now: Unix seconds
    """
    longest = now + ServiceRegistryEntry.ttl
    s.execute(
        update(ServiceRegistryEntry).where(ServiceRegistryEntry.expires > longest).values(expires=longest)
    )


def expire_entries(s: Session, now: float) -> list[EntryRecord]:
    """Delete up to :data:`_BATCH` entries with ended leases and return them. Call it until it returns none.

    :param now: Unix seconds
    """
    over = (
        _entries()
        .where(ServiceRegistryEntry.expires <= now)
        .order_by(ServiceRegistryEntry.expires)
        .limit(_BATCH)
    )
    found = [record_of(EntryRecord, row) for row in s.execute(over)]
    deleted = _delete(s, [each.id for each in found], now)
    return [each for each in found if each.id in deleted]


def _delete(s: Session, ids: Collection[str], now: float) -> set[str]:
    """Delete the entries whose leases have ended; returns their ids. Others may have been renewed meanwhile."""
    over = ServiceRegistryEntry.id.in_(list(ids)), ServiceRegistryEntry.expires <= now
    return (
        set(s.scalars(delete(ServiceRegistryEntry).where(*over).returning(ServiceRegistryEntry.id)))
        if ids
        else set()
    )


def _entries() -> Any:
    query: Any = (
        select(
            ServiceRegistryEntry.id,
            Realm.name.label("realm"),
            ServiceRegistryEntry.kind,
            ServiceRegistryEntry.name,
            ServiceRegistryEntry.address,
            ServiceRegistryEntry.description,
            ServiceRegistryEntry.robot_id,
            Robot.name.label("robot"),
            ServiceRegistryEntry.user_id,
            User.name.label("user"),
            ServiceRegistryEntry.data,
            ServiceRegistryEntry.ttl,
            ServiceRegistryEntry.registered,
            ServiceRegistryEntry.expires,
        )
        .join(Realm, Realm.id == ServiceRegistryEntry.realm_id)
        .join(User, User.id == ServiceRegistryEntry.user_id)
        .outerjoin(Robot, Robot.id == ServiceRegistryEntry.robot_id)
    )
    return query


def _stored(s: Session, entry_id: str) -> EntryRecord:
    return record_of(EntryRecord, s.execute(_entries().where(ServiceRegistryEntry.id == entry_id)).one())


def _count(s: Session, *conditions: ColumnElement[bool]) -> int:
    return s.scalar(select(func.count()).select_from(ServiceRegistryEntry).where(*conditions)) or 0
