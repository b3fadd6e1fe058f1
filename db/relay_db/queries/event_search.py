"""Finds events of the short-term memory.

A query looks at a bounded part of the rows, from the newest back, and says where to go on: however little of a
memory is asked for, nobody waits long for the thread that looks. Rows are found by the index on what is most exact;
everything else is judged on what that yields.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

from sqlalchemy import (
    BigInteger,
    ColumnElement,
    Double,
    Integer,
    Select,
    Subquery,
    Text,
    and_,
    bindparam,
    func,
    or_,
    select,
    tuple_,
)
from sqlalchemy.orm import Session

from relay_db.base import canonical_json
from relay_db.models import Realm, StoredEvent, StoredEventCount
from relay_db.queries.records import (
    EventCursor,
    EventSearch,
    MemoryPage,
    StoredEventCounts,
    StoredEventRecord,
)

OURS = "relay"
"""Sources that begin so are the relay's own."""

LOGIN = "login"
"""Kinds that begin so are for administrators, where they are about no robot."""

LOOKED_AT = 10_000
SCATTERED = 5_000
"""Rows one call looks at, at most: by time alone, and by an index whose rows lie apart, so that each takes longer."""

_SLICES = (256, 2048, LOOKED_AT)
"""Rows of one look: small first, since most askers want what came last."""

_COLUMNS = (
    StoredEvent.number,
    StoredEvent.at,
    StoredEvent.source,
    StoredEvent.kind,
    StoredEvent.robot_id,
    StoredEvent.user_name,
    StoredEvent.data,
    StoredEvent.used,
)


def recall(s: Session, ask: EventSearch, place: EventCursor | None, limit: int) -> MemoryPage:
    """Events, the newest first: as many as were found among :data:`LOOKED_AT` or :data:`SCATTERED` rows.

    :param place: only those that come after this one
    :param limit: most events
    """
    found: list[StoredEventRecord] = []
    values, most, looked = _values(s, ask), _most(ask), 0
    for size in _SLICES:
        size = min(size, most - looked)
        looked += size
        room = limit - len(found)
        asked = _asked(_shape(s, ask, place))
        now = {**values, **_place_values(place), "size": size, "room": room}
        rows = s.execute(asked.rows, now).all()
        found += [_record(ask, row) for row in rows if _fits(ask, row.data)]
        # Where there was no room for more of this part, the next one begins within it.
        place = EventCursor(rows[-1].at, rows[-1].number) if len(rows) == room else _end(s, asked, now)
        if place is None or len(found) == limit:
            break
    return MemoryPage(found, place)


def count_memories(s: Session, ask: EventSearch, place: EventCursor | None, few: int) -> StoredEventCounts:
    """How many there are among as many rows as :func:`recall` looks at, and where to go on.

    :param place: only those that come after this one
    :param few: of so many, and of no more, the numbers are told
    """
    asked = _asked(_shape(s, ask, place))
    now = {**_values(s, ask), **_place_values(place), "size": _most(ask), "room": few + 1}
    if ask.data:
        numbers = [row.number for row in s.execute(asked.data, now) if _fits(ask, row.data)]
    else:
        numbers = list(s.scalars(asked.numbers, now))
    count = len(numbers)
    if count > few:
        count, numbers = count if ask.data else s.scalar(asked.size, now) or 0, []
    return StoredEventCounts(count, numbers, _end(s, asked, now))


def _most(ask: EventSearch) -> int:
    return SCATTERED if _index(ask) else LOOKED_AT


def memories_since(s: Session, realm: str, number: int, limit: int) -> list[StoredEventRecord]:
    """All events of a realm with greater numbers, in their order.

    :param limit: most events
    """
    query = (
        select(*_COLUMNS)
        .where(StoredEvent.realm_id == realm_number(s, realm), StoredEvent.number > number)
        .order_by(StoredEvent.number)
        .limit(limit)
    )
    return [StoredEventRecord(row.number, realm, *row[1:]) for row in s.execute(query)]


def latest_memory(s: Session, realm: str) -> int:
    """The number of the event that was written last; 0 when there never was one."""
    query = (
        select(StoredEventCount.last)
        .join(Realm, Realm.id == StoredEventCount.realm_id)
        .where(Realm.name == realm)
    )
    return s.scalar(query) or 0


class StatementShape(NamedTuple):
    """What a statement is made of, whatever the values are. To make one takes longer than the database does.

    :param by: what rows are found by, see :func:`_index`
    :param prefixes: of source and kind, whether it is asked for by its beginning; ``None`` where it is not asked for
    :param fields: of the data, how many are asked for
    """

    postgresql: bool
    by: str
    since: bool
    until: bool
    placed: bool
    prefixes: tuple[bool | None, bool | None]
    user: bool
    fields: int
    general: bool
    insider: bool


class Statements(NamedTuple):
    """Statements of one shape.

    :param rows: of a part, some; ``numbers`` are those of some
    :param data: what all of them hold, with their numbers
    :param size: how many there are
    :param end: the last row that was looked at, and the one behind it
    """

    rows: Select[Any]
    numbers: Select[Any]
    data: Select[Any]
    size: Select[Any]
    end: Select[Any]


def _shape(s: Session, ask: EventSearch, place: EventCursor | None) -> StatementShape:
    names = (ask.source, ask.kind)
    return StatementShape(
        s.get_bind().dialect.name == "postgresql",
        _index(ask),
        ask.since is not None,
        ask.until is not None,
        place is not None,
        (names[0] and names[0].prefix, names[1] and names[1].prefix),
        ask.user is not None,
        len(ask.data),
        ask.general,
        ask.insider,
    )


def _index(ask: EventSearch) -> str:
    """What rows are found by: one robot, a source (which has a bounded number), a kind or a user; else the realm."""
    if len(ask.robots) == 1 and not ask.general:
        return "robot"
    if ask.source is not None and not ask.source.prefix:
        return "source"
    if ask.kind is not None and not ask.kind.prefix:
        return "kind"
    return "user" if ask.user is not None else ""


def _values(s: Session, ask: EventSearch) -> dict[str, Any]:
    """What a statement is given."""
    values: dict[str, Any] = {
        "realm": realm_number(s, ask.realm),
        "robots": sorted(ask.robots),
        "robot": next(iter(ask.robots), 0),
        "user": ask.user,
        "since": ask.since,
        "until": ask.until,
    }
    for what, name in (("source", ask.source), ("kind", ask.kind)):
        if name is not None:
            values |= {what: name.text, f"{what}_length": len(name.text)}
    for number, (field, value) in enumerate(ask.data):
        key = canonical_json(field)
        text = f"{key}:{canonical_json(value)}"
        values |= {f"text_{number}": text, f"bare_{number}": f"{key}:{value}" if value.isascii() else text}
    return values


def _place_values(place: EventCursor | None) -> dict[str, Any]:
    return {} if place is None else {"place_at": place.at, "place_number": place.number}


@lru_cache(maxsize=1024)
def _asked(shape: StatementShape) -> Statements:
    part, size = _part(shape), bindparam("size", type_=Integer)
    wanted, order = _wanted(shape, part), (part.c.at.desc(), part.c.number.desc())
    room = bindparam("room", type_=Integer)
    return Statements(
        select(part).where(*wanted).order_by(*order).limit(room),
        select(part.c.number).where(*wanted).limit(room),
        select(part.c.number, part.c.data).where(*wanted),
        select(func.count()).select_from(part).where(*wanted),
        # Of the index alone: to read the rows of a source that is spread over a large memory takes far longer.
        _rows(shape, StoredEvent.at, StoredEvent.number).limit(2).offset(size - 1),
    )


def _part(shape: StatementShape) -> Subquery:
    """So many rows."""
    return _rows(shape, *_COLUMNS).limit(bindparam("size", type_=Integer)).subquery()


def _rows(shape: StatementShape, *columns: Any) -> Select[Any]:
    """Rows by the index on what is most exact, the newest first."""
    conditions: list[ColumnElement[bool]] = [StoredEvent.realm_id == bindparam("realm")]
    column = {
        "robot": StoredEvent.robot_id,
        "source": StoredEvent.source,
        "kind": StoredEvent.kind,
        "user": StoredEvent.user_name,
    }.get(shape.by)
    if column is not None:
        conditions.append(column == bindparam(shape.by))
    if shape.since:
        conditions.append(StoredEvent.at >= bindparam("since"))
    if shape.until:
        conditions.append(StoredEvent.at < bindparam("until"))
    if shape.placed:
        at, number = bindparam("place_at", type_=Double), bindparam("place_number", type_=BigInteger)
        # Twice: databases find the first by the index, of the second not all do.
        conditions.append(StoredEvent.at <= at)
        conditions.append(tuple_(StoredEvent.at, StoredEvent.number) < tuple_(at, number))
    return select(*columns).where(*conditions).order_by(StoredEvent.at.desc(), StoredEvent.number.desc())


def _wanted(shape: StatementShape, part: Subquery) -> list[ColumnElement[bool]]:
    """What has to be true of the rows of a part."""
    columns = part.c
    conditions = [_visible(shape, part)]
    for column, what, prefix in zip(
        (columns.source, columns.kind), ("source", "kind"), shape.prefixes, strict=True
    ):
        if prefix is not None:
            length = bindparam(f"{what}_length", type_=Integer)
            # Not LIKE: SQLite's takes great letters for small ones.
            conditions.append((func.substr(column, 1, length) if prefix else column) == bindparam(what))
    if shape.user:
        conditions.append(columns.user_name == bindparam("user"))
    holds = func.strpos if shape.postgresql else func.instr
    for number in range(shape.fields):
        # What holds none of these can't fit. What does is looked at more closely.
        texts = (bindparam(f"{each}_{number}", type_=Text) for each in ("text", "bare"))
        conditions.append(or_(*(holds(columns.data, each) > 0 for each in texts)))
    return conditions


def _visible(shape: StatementShape, part: Subquery) -> ColumnElement[bool]:
    columns = part.c
    about = columns.robot_id.in_(bindparam("robots", expanding=True))
    if not shape.general:
        return about
    if shape.insider:
        return or_(about, columns.robot_id.is_(None))
    source, kind = func.substr(columns.source, 1, len(OURS)), func.substr(columns.kind, 1, len(LOGIN))
    return or_(about, and_(columns.robot_id.is_(None), source != OURS, kind != LOGIN))


def _end(s: Session, asked: Statements, values: dict[str, Any]) -> EventCursor | None:
    """Where a part ends; ``None`` when there is nothing behind it."""
    last = s.execute(asked.end, values).all()
    return EventCursor(*last[0]) if len(last) == 2 else None


def realm_number(s: Session, name: str) -> int:
    """The number of a realm; 0 when there is none."""
    return s.scalar(select(Realm.id).where(Realm.name == name)) or 0


def _fits(ask: EventSearch, data: str) -> bool:
    return not ask.data or data_fits(ask.data, json.loads(data))


def data_fits(wanted: Iterable[tuple[str, str]], data: Mapping[str, Any]) -> bool:
    """Whether fields have these values: as text, or as what JSON writes for anything else."""
    return all(
        field in data
        and value == (data[field] if isinstance(data[field], str) else canonical_json(data[field]))
        for field, value in wanted
    )


def _record(ask: EventSearch, row: Any) -> StoredEventRecord:
    return StoredEventRecord(row.number, ask.realm, *row[1:])
