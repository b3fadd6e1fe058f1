"""Realms: worlds of their own, in each of which names are unique."""

from __future__ import annotations

from sqlalchemy import delete, exists, insert, select, update
from sqlalchemy.orm import Session

from relay_db.models import (
    DirectoryEntry,
    Group,
    Realm,
    RobotGroup,
    RobotRealm,
    StoredEvent,
    StoredEventCount,
    User,
)
from relay_db.names import normal_name, normalise
from relay_db.queries.records import RealmRecord
from relay_db.queries.state import bump
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_protocol.realms import DEFAULT_REALM

MOST_DAYS = 3650
"""The longest that events are kept."""


def add_realm(s: Session, name: str) -> RealmRecord:
    """:raises Invalid: the name can't be, or is taken"""
    name = normal_name(name, "name of a realm")
    if s.scalar(select(Realm.id).where(Realm.name == name)) is not None:
        raise Invalid(f"there is a realm '{name}' already")
    bump(s)
    realm_id = s.scalars(insert(Realm).values(name=name).returning(Realm.id)).one()
    return RealmRecord(realm_id, name, None)


def remove_realm(s: Session, name: str) -> None:
    """Remove a realm in which nobody and nothing is left, with what its memory and its directory hold.

    :raises NotFound: no such realm
    :raises Refused: users, groups or robots are in it, or it is the one that every relay has
    """
    bump(s)
    # On PostgreSQL who writes to the realm's memory is done by now, or finds it gone.
    gone = s.scalar(select(Realm.id).where(Realm.name == normalise(name)).with_for_update())
    if gone is None:
        raise NotFound("there is no such realm")
    if normalise(name) == DEFAULT_REALM:
        raise Refused(f"the realm '{DEFAULT_REALM}' stays: names without a realm are of it")
    left = [
        what
        for what, kind in (
            ("users", User),
            ("groups", Group),
            ("robots", RobotRealm),
            ("groups of robots", RobotGroup),
        )
        if s.scalar(select(exists().where(kind.realm_id == gone)))
    ]
    if left:
        raise Refused(f"there are {' and '.join(left)} in the realm '{normalise(name)}'; remove them first")
    for kept in (DirectoryEntry, StoredEvent, StoredEventCount):
        s.execute(delete(kept).where(kept.realm_id == gone))
    s.execute(delete(Realm).where(Realm.id == gone))


def list_realms(s: Session) -> list[RealmRecord]:
    """All realms, by name."""
    query = select(Realm.id, Realm.name, Realm.events_days).order_by(Realm.name)
    return [RealmRecord(*row) for row in s.execute(query)]


def find_realm(s: Session, name: str) -> RealmRecord | None:
    """The realm of that name."""
    query = select(Realm.id, Realm.name, Realm.events_days).where(Realm.name == normalise(name))
    row = s.execute(query).one_or_none()
    return None if row is None else RealmRecord(*row)


def realm_id(s: Session, name: str) -> int:
    """:raises NotFound: no such realm"""
    found = s.scalar(select(Realm.id).where(Realm.name == normalise(name)))
    if found is None:
        raise NotFound("there is no such realm")
    return found


def robot_is_of(s: Session, robot_id: int, realm_id: int) -> bool:
    """Whether a robot is of a realm: it is its own, or it is shared with that."""
    of = (RobotRealm.robot_id == robot_id) & (RobotRealm.realm_id == realm_id)
    return bool(s.scalar(select(exists().where(of))))


def keep_events(s: Session, name: str, days: float | None) -> None:
    """Say how long a realm's memory keeps events.

    :param days: ``None``: as long as that of the whole relay
    :raises Invalid: not more than 0 days, or more than :data:`MOST_DAYS`
    :raises NotFound: no such realm
    """
    if days is not None and not 0 < days <= MOST_DAYS:
        raise Invalid(f"events are kept for more than 0 days, and for {MOST_DAYS} at most")
    s.execute(update(Realm).where(Realm.id == realm_id(s, name)).values(events_days=days))
