"""Stored events: written in batches, their uses counted, deleted when they are over the limits."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from sqlalchemy import bindparam, delete, func, insert, select, tuple_, update
from sqlalchemy.orm import Session

from relay_db.models import LastEventNumber, Realm, StoredEvent
from relay_db.queries.event_search import realm_id_or_zero
from relay_db.queries.records import NewStoredEvent, StoredEventRecord

PROTECTED_SHARE = 10
"""The newest events of a source, one in this many, are not deleted as surplus."""

_TABLE: Any = StoredEvent.__table__


def store_events(s: Session, events: Sequence[NewStoredEvent]) -> list[StoredEventRecord | None]:
    """Write events, numbered in this order within each realm; returns the records, ``None`` for a removed realm."""
    realms = _locked_realms(s, {each.realm for each in events})
    following: dict[str, int] = {}
    for realm in sorted(realms):
        count = sum(each.realm == realm for each in events)
        following[realm] = _reserve_numbers(s, realms[realm], count)
    records: list[StoredEventRecord | None] = []
    for each in events:
        if each.realm not in realms:
            records.append(None)
            continue
        records.append(StoredEventRecord(number=following[each.realm], use_count=0, **each._asdict()))
        following[each.realm] += 1
    rows = [
        {
            "realm_id": realms[each.realm],
            "number": each.number,
            "at": each.at,
            "source": each.source,
            "kind": each.kind,
            "robot_id": each.robot_id,
            "user_name": each.user,
            "data": each.data,
            "use_count": 0,
        }
        for each in records
        if each is not None
    ]
    if rows:
        s.execute(insert(_TABLE), rows)
    return records


def _reserve_numbers(s: Session, realm_id: int, count: int) -> int:
    """Reserve numbers for events; returns the first."""
    own = LastEventNumber.realm_id == realm_id
    last = s.scalar(
        update(LastEventNumber)
        .where(own)
        .values(number=LastEventNumber.number + count)
        .returning(LastEventNumber.number)
    )
    if last is None:
        s.execute(insert(LastEventNumber).values(realm_id=realm_id, number=count))
        last = count
    return int(last) - count + 1


def _locked_realms(s: Session, names: Collection[str]) -> dict[str, int]:
    """The realms that exist; on PostgreSQL none is removed until the transaction ends."""
    # Names come from the network and are compared here: the database fails on some texts.
    used = {name: number for name, number in _realms(s).items() if name in names}
    lock = select(Realm.id).where(Realm.id.in_(used.values())).with_for_update(read=True, key_share=True)
    locked = set(s.scalars(lock))
    return {name: number for name, number in used.items() if number in locked}


def _realms(s: Session) -> dict[str, int]:
    return {row.name: row.id for row in s.execute(select(Realm.name, Realm.id))}


# --- deletion ---------------------------------------------------------------------------------------------


def add_event_uses(s: Session, uses: Mapping[tuple[str, int], int]) -> None:
    """Add to the number of uses of events, by realm and number."""
    realms = _realms(s)
    rows = [
        {"of_realm": realms[realm], "of_number": number, "more": times}
        for (realm, number), times in uses.items()
        if realm in realms
    ]
    query = (
        update(_TABLE)
        .where(_TABLE.c.realm_id == bindparam("of_realm"), _TABLE.c.number == bindparam("of_number"))
        .values(use_count=_TABLE.c.use_count + bindparam("more"))
    )
    if rows:
        s.connection().execute(query, rows)


def event_counts(s: Session) -> dict[str, int]:
    """The number of stored events of each realm."""
    size = func.count().label("size")
    query = select(Realm.name, size).join(StoredEvent, StoredEvent.realm_id == Realm.id).group_by(Realm.name)
    return {row.name: row.size for row in s.execute(query)}


def sources_over_quota(s: Session, quota: int) -> list[tuple[str, str]]:
    """Realms and sources with more events than the quota."""
    query = (
        select(Realm.name, StoredEvent.source)
        .join(Realm, Realm.id == StoredEvent.realm_id)
        .group_by(StoredEvent.realm_id, Realm.name, StoredEvent.source)
        .having(func.count() > quota)
    )
    return [(realm, source) for realm, source in s.execute(query)]


def surplus_events(s: Session, realm: str, source: str, quota: int, limit: int) -> list[int]:
    """Numbers of events to delete of a source over its quota: the least used, of these the oldest; not the newest.

    :param quota: events that it may have
    :param limit: most numbers
    """
    own = [StoredEvent.realm_id == realm_id_or_zero(s, realm), StoredEvent.source == source]
    count = s.scalar(select(func.count()).where(*own)) or 0
    if count <= quota:
        return []
    newest = (
        select(StoredEvent.at, StoredEvent.number)
        .where(*own)
        .order_by(StoredEvent.at.desc(), StoredEvent.number.desc())
        .limit(1)
        .offset(quota // PROTECTED_SHARE)
    )
    at, number = s.execute(newest).one()
    query = (
        select(StoredEvent.number)
        .where(*own, tuple_(StoredEvent.at, StoredEvent.number) <= tuple_(at, number))
        .order_by(StoredEvent.use_count, StoredEvent.at, StoredEvent.number)
        .limit(min(count - quota, limit))
    )
    return list(s.scalars(query))


def oldest_events(s: Session, realm: str, before: float | None, limit: int) -> list[int]:
    """Numbers of a realm's oldest events.

    :param before: only events that are older, Unix seconds
    :param limit: most numbers
    """
    query = select(StoredEvent.number).where(StoredEvent.realm_id == realm_id_or_zero(s, realm))
    if before is not None:
        query = query.where(StoredEvent.at < before)
    return list(s.scalars(query.order_by(StoredEvent.at, StoredEvent.number).limit(limit)))


def delete_events(s: Session, realm: str, numbers: Collection[int]) -> int:
    """Delete events; returns how many."""
    statement = delete(_TABLE).where(
        _TABLE.c.realm_id == realm_id_or_zero(s, realm), _TABLE.c.number.in_(numbers)
    )
    return int(s.connection().execute(statement).rowcount)
