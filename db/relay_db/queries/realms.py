"""Realms: names are unique within one, and users of one realm do not see others."""

from __future__ import annotations

from sqlalchemy import Select, delete, exists, insert, select, update
from sqlalchemy.orm import Session

from relay_db.models import (
    Group,
    LastEventNumber,
    Realm,
    RobotGroup,
    RobotRealm,
    ServiceRegistryEntry,
    StoredEvent,
    User,
)
from relay_db.names import normal_name, normalise
from relay_db.queries.records import RealmRecord, fetch_all, fetch_one
from relay_db.queries.revision import bump
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_protocol.realms import DEFAULT_REALM

MAX_EVENT_DAYS = 3650
"""Most days that events are stored."""


def add_realm(s: Session, name: str) -> RealmRecord:
    """:raises Invalid: the name is not valid, or is taken"""
    name = normal_name(name, "name of a realm")
    if s.scalar(select(Realm.id).where(Realm.name == name)) is not None:
        raise Invalid(f"there is a realm '{name}' already")
    bump(s)
    realm_id = s.scalars(insert(Realm).values(name=name).returning(Realm.id)).one()
    return RealmRecord(realm_id, name, None)


def remove_realm(s: Session, name: str) -> None:
    """Remove a realm without users, groups and robots, with its stored events and registry entries.

    :raises NotFound: no such realm
    :raises Refused: it has users, groups or robots, or it is the default realm
    """
    bump(s)
    # On PostgreSQL writers of its events have committed by now, or will find the realm removed.
    number = s.scalar(select(Realm.id).where(Realm.name == normalise(name)).with_for_update())
    if number is None:
        raise NotFound("there is no such realm")
    if normalise(name) == DEFAULT_REALM:
        raise Refused(f"the realm '{DEFAULT_REALM}' cannot be removed: names without a realm belong to it")
    remaining = [
        what
        for what, kind in (
            ("users", User),
            ("groups", Group),
            ("robots", RobotRealm),
            ("groups of robots", RobotGroup),
        )
        if s.scalar(select(exists().where(kind.realm_id == number)))
    ]
    if remaining:
        raise Refused(
            f"there are {' and '.join(remaining)} in the realm '{normalise(name)}'; remove them first"
        )
    for table in (ServiceRegistryEntry, StoredEvent, LastEventNumber):
        s.execute(delete(table).where(table.realm_id == number))
    s.execute(delete(Realm).where(Realm.id == number))


def list_realms(s: Session) -> list[RealmRecord]:
    """All realms, by name."""
    query = select(Realm.id, Realm.name, Realm.events_days).order_by(Realm.name)
    return fetch_all(s, RealmRecord, query)


def find_realm(s: Session, name: str) -> RealmRecord | None:
    """The realm of that name."""
    query = select(Realm.id, Realm.name, Realm.events_days).where(Realm.name == normalise(name))
    return fetch_one(s, RealmRecord, query)


def realm_id(s: Session, name: str) -> int:
    """:raises NotFound: no such realm"""
    found = s.scalar(select(Realm.id).where(Realm.name == normalise(name)))
    if found is None:
        raise NotFound("there is no such realm")
    return found


def robot_in_realm(s: Session, robot_id: int, realm_id: int) -> bool:
    """Whether a robot belongs to a realm: its own, or one that it is shared with."""
    of = (RobotRealm.robot_id == robot_id) & (RobotRealm.realm_id == realm_id)
    return bool(s.scalar(select(exists().where(of))))


def set_event_retention(s: Session, name: str, days: float | None) -> None:
    """Set how long events of a realm are stored.

    :param days: ``None`` for the setting of the relay
    :raises Invalid: not more than 0 days, or more than :data:`MAX_EVENT_DAYS`
    :raises NotFound: no such realm
    """
    if days is not None and not 0 < days <= MAX_EVENT_DAYS:
        raise Invalid(
            f"the days for which events are stored must be more than 0 and at most {MAX_EVENT_DAYS}"
        )
    s.execute(update(Realm).where(Realm.id == realm_id(s, name)).values(events_days=days))


# --- groups of users and of robots ------------------------------------------------------------------------


def groups_with_realm(table: type[Group] | type[RobotGroup]) -> Select[int, str, str]:
    """Groups of users or of robots: number, name and name of the realm."""
    return select(table.id, table.name, Realm.name.label("realm")).join(Realm, Realm.id == table.realm_id)


def numbers_by_name(s: Session, table: type[Group] | type[RobotGroup], realm: str) -> dict[str, int]:
    """The numbers of the groups of a realm, by name."""
    rows = s.execute(groups_with_realm(table).where(Realm.name == normalise(realm)))
    return {row.name: row.id for row in rows}
