"""Finds stored events.

A query scans a bounded number of rows, from the newest back, and returns a cursor for the rest, so that no search
occupies a reading thread for long. The rows are found by the index of the most selective condition; the other
conditions are tested on these rows.
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
from relay_db.models import LastEventNumber, Realm, StoredEvent
from relay_db.queries.records import (
    EventCursor,
    EventSearch,
    FoundEvents,
    StoredEventCounts,
    StoredEventRecord,
    fetch_all,
    record_of,
)

RELAY_SOURCE = "relay"
"""Prefix of the relay's own sources of events."""

LOGIN_KIND = "login"
"""Prefix of kinds that only administrators may see, if the event is about no robot."""

MAX_SCANNED = 10_000
MAX_SCANNED_SCATTERED = 5_000
"""Most rows that one call scans: by time, and by another index, whose rows are scattered and take longer."""

_SLICES = (256, 2048, MAX_SCANNED)
"""Rows of successive scans. The first is small, because most searches are for the newest events."""

_COLUMNS = (
    StoredEvent.number,
    StoredEvent.at,
    StoredEvent.source,
    StoredEvent.kind,
    StoredEvent.robot_id,
    StoredEvent.user_name.label("user"),
    StoredEvent.data,
    StoredEvent.use_count,
)


def search_events(s: Session, search: EventSearch, cursor: EventCursor | None, limit: int) -> FoundEvents:
    """The events found among :data:`MAX_SCANNED` or :data:`MAX_SCANNED_SCATTERED` rows, the newest first.

    :param cursor: the position after which the search begins
    :param limit: most events
    """
    found: list[StoredEventRecord] = []
    values, max_rows, scanned = _values(s, search), _max_rows(search), 0
    for size in _SLICES:
        size = min(size, max_rows - scanned)
        scanned += size
        left = limit - len(found)
        statements = _statements(_shape(s, search, cursor))
        parameters = {**values, **_cursor_values(cursor), "size": size, "limit": left}
        rows = s.execute(statements.rows, parameters).all()
        found += [_record(search, row) for row in rows if _matches(search, row.data)]
        # If the limit was reached, the next search begins within this slice.
        full = len(rows) == left
        cursor = (
            EventCursor(rows[-1].at, rows[-1].number) if full else _next_cursor(s, statements, parameters)
        )
        if cursor is None or len(found) == limit:
            break
    return FoundEvents(found, cursor)


def count_events(
    s: Session, search: EventSearch, cursor: EventCursor | None, max_numbers: int
) -> StoredEventCounts:
    """Count events among as many rows as :func:`search_events` scans.

    :param cursor: the position after which the count begins
    :param max_numbers: the numbers of the events are returned if there are at most so many
    """
    statements = _statements(_shape(s, search, cursor))
    parameters = {
        **_values(s, search),
        **_cursor_values(cursor),
        "size": _max_rows(search),
        "limit": max_numbers + 1,
    }
    if search.data:
        numbers = [row.number for row in s.execute(statements.data, parameters) if _matches(search, row.data)]
    else:
        numbers = list(s.scalars(statements.numbers, parameters))
    count = len(numbers)
    if count > max_numbers:
        count, numbers = count if search.data else s.scalar(statements.size, parameters) or 0, []
    return StoredEventCounts(count, numbers, _next_cursor(s, statements, parameters))


def _max_rows(search: EventSearch) -> int:
    return MAX_SCANNED_SCATTERED if _index(search) else MAX_SCANNED


def events_since(s: Session, realm: str, number: int, limit: int) -> list[StoredEventRecord]:
    """The events of a realm with greater numbers, in their order.

    :param limit: most events
    """
    query = (
        select(*_COLUMNS)
        .where(StoredEvent.realm_id == realm_id_or_zero(s, realm), StoredEvent.number > number)
        .order_by(StoredEvent.number)
        .limit(limit)
    )
    return fetch_all(s, StoredEventRecord, query, realm=realm)


def latest_event_number(s: Session, realm: str) -> int:
    """The number of the latest event of a realm; 0 if there never was one."""
    query = (
        select(LastEventNumber.number)
        .join(Realm, Realm.id == LastEventNumber.realm_id)
        .where(Realm.name == realm)
    )
    return s.scalar(query) or 0


class StatementShape(NamedTuple):
    """All that statements depend on beside the values of parameters. Statements are cached by it.

    :param by: the condition whose index finds the rows, see :func:`_index`
    :param prefixes: of source and kind: whether the condition is a prefix; ``None`` without a condition
    :param fields: number of conditions on fields of the data
    """

    postgresql: bool
    by: str
    since: bool
    until: bool
    after_cursor: bool
    prefixes: tuple[bool | None, bool | None]
    user: bool
    fields: int
    without_robot: bool
    admin: bool


class Statements(NamedTuple):
    """Statements of one shape, for one slice of rows.

    :param rows: events that match, up to a limit; ``numbers`` only their numbers
    :param data: number and data of all events that match
    :param size: the number of events that match
    :param end: the last row of the slice, and the row after it
    """

    rows: Select[Any]
    numbers: Select[Any]
    data: Select[Any]
    size: Select[Any]
    end: Select[Any]


def _shape(s: Session, search: EventSearch, cursor: EventCursor | None) -> StatementShape:
    names = (search.source, search.kind)
    return StatementShape(
        s.get_bind().dialect.name == "postgresql",
        _index(search),
        search.since is not None,
        search.until is not None,
        cursor is not None,
        (names[0] and names[0].prefix, names[1] and names[1].prefix),
        search.user is not None,
        len(search.data),
        search.without_robot,
        search.admin,
    )


def _index(search: EventSearch) -> str:
    """The condition whose index finds the rows: robot, source, kind or user; empty for the realm and time alone."""
    if len(search.robots) == 1 and not search.without_robot:
        return "robot"
    if search.source is not None and not search.source.prefix:
        return "source"
    if search.kind is not None and not search.kind.prefix:
        return "kind"
    return "user" if search.user is not None else ""


def _values(s: Session, search: EventSearch) -> dict[str, Any]:
    """Parameters of the statements."""
    values: dict[str, Any] = {
        "realm": realm_id_or_zero(s, search.realm),
        "robots": sorted(search.robots),
        "robot": next(iter(search.robots), 0),
        "user": search.user,
        "since": search.since,
        "until": search.until,
    }
    for what, name in (("source", search.source), ("kind", search.kind)):
        if name is not None:
            values |= {what: name.text, f"{what}_length": len(name.text)}
    for number, (field, value) in enumerate(search.data):
        key = canonical_json(field)
        text = f"{key}:{canonical_json(value)}"
        values |= {f"text_{number}": text, f"bare_{number}": f"{key}:{value}" if value.isascii() else text}
    return values


def _cursor_values(cursor: EventCursor | None) -> dict[str, Any]:
    return {} if cursor is None else {"cursor_at": cursor.at, "cursor_number": cursor.number}


@lru_cache(maxsize=1024)
def _statements(shape: StatementShape) -> Statements:
    part, size = _slice(shape), bindparam("size", type_=Integer)
    wanted, order = _conditions(shape, part), (part.c.at.desc(), part.c.number.desc())
    limit = bindparam("limit", type_=Integer)
    return Statements(
        select(part).where(*wanted).order_by(*order).limit(limit),
        select(part.c.number).where(*wanted).limit(limit),
        select(part.c.number, part.c.data).where(*wanted),
        select(func.count()).select_from(part).where(*wanted),
        # Read from the index alone: reading scattered rows of a source takes far longer.
        _rows(shape, StoredEvent.at, StoredEvent.number).limit(2).offset(size - 1),
    )


def _slice(shape: StatementShape) -> Subquery:
    return _rows(shape, *_COLUMNS).limit(bindparam("size", type_=Integer)).subquery()


def _rows(shape: StatementShape, *columns: Any) -> Select[Any]:
    """Rows by the index of :func:`_index`, the newest first."""
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
    if shape.after_cursor:
        at, number = bindparam("cursor_at", type_=Double), bindparam("cursor_number", type_=BigInteger)
        # Both: not all databases use the index for the second condition.
        conditions.append(StoredEvent.at <= at)
        conditions.append(tuple_(StoredEvent.at, StoredEvent.number) < tuple_(at, number))
    return select(*columns).where(*conditions).order_by(StoredEvent.at.desc(), StoredEvent.number.desc())


def _conditions(shape: StatementShape, part: Subquery) -> list[ColumnElement[bool]]:
    columns = part.c
    conditions = [_visible(shape, part)]
    for column, what, prefix in zip(
        (columns.source, columns.kind), ("source", "kind"), shape.prefixes, strict=True
    ):
        if prefix is not None:
            length = bindparam(f"{what}_length", type_=Integer)
            # Not LIKE, which ignores case in SQLite.
            conditions.append((func.substr(column, 1, length) if prefix else column) == bindparam(what))
    if shape.user:
        conditions.append(columns.user == bindparam("user"))
    holds = func.strpos if shape.postgresql else func.instr
    for number in range(shape.fields):
        # Rows without either text cannot match; the others are decoded and compared in _matches.
        texts = (bindparam(f"{each}_{number}", type_=Text) for each in ("text", "bare"))
        conditions.append(or_(*(holds(columns.data, each) > 0 for each in texts)))
    return conditions


def _visible(shape: StatementShape, part: Subquery) -> ColumnElement[bool]:
    columns = part.c
    about = columns.robot_id.in_(bindparam("robots", expanding=True))
    if not shape.without_robot:
        return about
    if shape.admin:
        return or_(about, columns.robot_id.is_(None))
    source, kind = (
        func.substr(columns.source, 1, len(RELAY_SOURCE)),
        func.substr(columns.kind, 1, len(LOGIN_KIND)),
    )
    return or_(about, and_(columns.robot_id.is_(None), source != RELAY_SOURCE, kind != LOGIN_KIND))


def _next_cursor(s: Session, statements: Statements, parameters: dict[str, Any]) -> EventCursor | None:
    """The cursor at the end of a slice; ``None`` if there is no row after it."""
    last = s.execute(statements.end, parameters).all()
    return EventCursor(last[0].at, last[0].number) if len(last) == 2 else None


def realm_id_or_zero(s: Session, name: str) -> int:
    """The number of a realm; 0 if it does not exist."""
    return s.scalar(select(Realm.id).where(Realm.name == name)) or 0


def _matches(search: EventSearch, data: str) -> bool:
    return not search.data or data_matches(search.data, json.loads(data))


def data_matches(wanted: Iterable[tuple[str, str]], data: Mapping[str, Any]) -> bool:
    """Whether fields have these values. Values other than text are compared as JSON."""
    return all(
        field in data
        and value == (data[field] if isinstance(data[field], str) else canonical_json(data[field]))
        for field, value in wanted
    )


def _record(search: EventSearch, row: Any) -> StoredEventRecord:
    return record_of(StoredEventRecord, row, realm=search.realm)
