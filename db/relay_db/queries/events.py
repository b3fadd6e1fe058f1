"""The short-term memory: events are written many at once, their use is counted, and what is too much goes."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from sqlalchemy import bindparam, delete, func, insert, select, tuple_, update
from sqlalchemy.orm import Session

from relay_db.models import Realm, StoredEvent, StoredEventCount
from relay_db.queries.event_search import realm_number
from relay_db.queries.records import NewStoredEvent, StoredEventRecord

SPARED = 10
"""One in so many of a source's events, the newest, is kept however little it was used."""

_TABLE: Any = StoredEvent.__table__


def remember(s: Session, events: Sequence[NewStoredEvent]) -> list[StoredEventRecord | None]:
    """Write events, numbered in this order within each realm; each as it is kept, ``None`` where its realm is gone."""
    realms = _lasting(s, {each.realm for each in events})
    following: dict[str, int] = {}
    for realm in sorted(realms):
        count = sum(each.realm == realm for each in events)
        following[realm] = _take_numbers(s, realms[realm], count)
    kept: list[StoredEventRecord | None] = []
    for each in events:
        if each.realm not in realms:
            kept.append(None)
            continue
        kept.append(StoredEventRecord(following[each.realm], *each, used=0))
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
            "used": 0,
        }
        for each in kept
        if each is not None
    ]
    if rows:
        s.execute(insert(_TABLE), rows)
    return kept


def _take_numbers(s: Session, realm_id: int, count: int) -> int:
    """The first of so many numbers that nobody else gets."""
    mine = StoredEventCount.realm_id == realm_id
    last = s.scalar(
        update(StoredEventCount)
        .where(mine)
        .values(last=StoredEventCount.last + count)
        .returning(StoredEventCount.last)
    )
    if last is None:
        s.execute(insert(StoredEventCount).values(realm_id=realm_id, last=count))
        last = count
    return int(last) - count + 1


def _lasting(s: Session, names: Collection[str]) -> dict[str, int]:
    """Those of these realms that there are; on PostgreSQL none is removed until the end of the transaction."""
    # Names from strangers are compared here: the database fails on some texts.
    used = {name: number for name, number in _realms(s).items() if name in names}
    lock = select(Realm.id).where(Realm.id.in_(used.values())).with_for_update(read=True, key_share=True)
    there = set(s.scalars(lock))
    return {name: number for name, number in used.items() if number in there}


def _realms(s: Session) -> dict[str, int]:
    return {row.name: row.id for row in s.execute(select(Realm.name, Realm.id))}


# --- what goes --------------------------------------------------------------------------------------------


def use_memories(s: Session, uses: Mapping[tuple[str, int], int]) -> None:
    """Events, by realm and number, were used so many times more."""
    realms = _realms(s)
    rows = [
        {"its_realm": realms[realm], "its_number": number, "more": times}
        for (realm, number), times in uses.items()
        if realm in realms
    ]
    query = (
        update(_TABLE)
        .where(_TABLE.c.realm_id == bindparam("its_realm"), _TABLE.c.number == bindparam("its_number"))
        .values(used=_TABLE.c.used + bindparam("more"))
    )
    if rows:
        s.connection().execute(query, rows)


def memory_sizes(s: Session) -> dict[str, int]:
    """How many events each realm's memory holds."""
    size = func.count().label("size")
    query = select(Realm.name, size).join(StoredEvent, StoredEvent.realm_id == Realm.id).group_by(Realm.name)
    return {row.name: row.size for row in s.execute(query)}


def crowded_sources(s: Session, most: int) -> list[tuple[str, str]]:
    """Realms and sources with more than so many events."""
    query = (
        select(Realm.name, StoredEvent.source)
        .join(Realm, Realm.id == StoredEvent.realm_id)
        .group_by(StoredEvent.realm_id, Realm.name, StoredEvent.source)
        .having(func.count() > most)
    )
    return [(realm, source) for realm, source in s.execute(query)]


def surplus_memories(s: Session, realm: str, source: str, most: int, limit: int) -> list[int]:
    """Numbers of those that a source has too many of: the least used, of these the oldest; the newest are spared.

    :param most: events it may have
    :param limit: numbers at a time
    """
    own = [StoredEvent.realm_id == realm_number(s, realm), StoredEvent.source == source]
    count = s.scalar(select(func.count()).where(*own)) or 0
    if count <= most:
        return []
    newest = (
        select(StoredEvent.at, StoredEvent.number)
        .where(*own)
        .order_by(StoredEvent.at.desc(), StoredEvent.number.desc())
        .limit(1)
        .offset(most // SPARED)
    )
    at, number = s.execute(newest).one()
    query = (
        select(StoredEvent.number)
        .where(*own, tuple_(StoredEvent.at, StoredEvent.number) <= tuple_(at, number))
        .order_by(StoredEvent.used, StoredEvent.at, StoredEvent.number)
        .limit(min(count - most, limit))
    )
    return list(s.scalars(query))


def old_memories(s: Session, realm: str, before: float | None, limit: int) -> list[int]:
    """Numbers of a realm's oldest events.

    :param before: only of those that are older, Unix seconds
    :param limit: numbers at a time
    """
    query = select(StoredEvent.number).where(StoredEvent.realm_id == realm_number(s, realm))
    if before is not None:
        query = query.where(StoredEvent.at < before)
    return list(s.scalars(query.order_by(StoredEvent.at, StoredEvent.number).limit(limit)))


def forget_memories(s: Session, realm: str, numbers: Collection[int]) -> int:
    """Let events go; how many there were."""
    gone = delete(_TABLE).where(_TABLE.c.realm_id == realm_number(s, realm), _TABLE.c.number.in_(numbers))
    return int(s.connection().execute(gone).rowcount)
