"""Events, and the audit log: a chain in which each entry's hash covers the one before."""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Collection, Mapping
from typing import Any

from sqlalchemy import Text, delete, func, insert, select, type_coerce, update
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from relay_db.base import canonical_json
from relay_db.models import NAME, AuditEntry, Event, Revision, Robot, User
from relay_db.names import sanitise
from relay_db.queries.records import AuditRecord, EventRecord

_START = hashlib.sha256(b"").hexdigest()
"""What the first entry follows."""

_PAGE = 1000

EVENTS = 1_000_000
"""Most events kept, whatever their age."""


def record_event(
    s: Session,
    *,
    at: float,
    kind: str,
    source: str,
    robot_id: int | None = None,
    user_id: int | None = None,
    data: Mapping[str, Any],
) -> int:
    """Remember something that happened, also to a robot or user that was removed meanwhile.

    :param at: Unix seconds
    :param source: who tells it, e.g. ``relay``
    :raises ValueError: the data holds NaN or Infinity
    """
    values = {
        "at": at,
        "kind": sanitise(kind, NAME),
        "source": sanitise(source),
        "robot_id": select(Robot.id).where(Robot.id == robot_id).scalar_subquery(),
        "user_id": select(User.id).where(User.id == user_id).scalar_subquery(),
        "data": dict(data),
    }
    return s.scalars(insert(Event).values(**values).returning(Event.id)).one()


def list_events(
    s: Session, robot_id: int | None = None, kind: str | None = None, limit: int = 100
) -> list[EventRecord]:
    """The latest events, newest first."""
    query = (
        select(Event.id, Event.at, Event.kind, Event.source, Event.robot_id, Event.user_id, Event.data)
        .order_by(Event.id.desc())
        .limit(limit)
    )
    if robot_id is not None:
        query = query.where(Event.robot_id == robot_id)
    if kind is not None:
        query = query.where(Event.kind == sanitise(kind, NAME))
    return [EventRecord(*row) for row in s.execute(query)]


def purge_events(s: Session, before: float, most: int = EVENTS, batch: int = _PAGE) -> int:
    """Forget one batch of the events that are too old or too many; how many. Call again until it is 0.

    :param before: Unix seconds; older events go
    :param most: rows that may stay, whatever their age
    :param batch: rows of one transaction, so that nobody waits long for the writer
    """
    newest = select(func.coalesce(func.max(Event.id), 0)).scalar_subquery()
    old = select(Event.id).where(Event.at < before).order_by(Event.at).limit(batch)
    surplus = select(Event.id).where(Event.id <= newest - most).order_by(Event.id).limit(batch)
    gone = s.execute(delete(Event).where(Event.id.in_(old))).rowcount  # type: ignore[attr-defined]
    if gone == 0:
        gone = s.execute(delete(Event).where(Event.id.in_(surplus))).rowcount  # type: ignore[attr-defined]
    return int(gone)


def append_audit(
    s: Session,
    *,
    at: float,
    actor: str,
    action: str,
    target: str,
    origin: str = "",
    data: Mapping[str, Any] | None = None,
) -> AuditRecord:
    """Add an entry to the chain. Text may come from anyone: it is made printable and cut to length.

    :param at: Unix seconds
    :param actor: who did it, e.g. ``user:ann`` or ``cli:root``
    :param action: what, e.g. ``right.grant``
    :param target: to whom or what
    :param origin: from which address
    :raises ValueError: the data holds NaN or Infinity
    """
    end = s.execute(select(Revision.audit_id, Revision.audit_hash).with_for_update()).one()
    entry = AuditRecord(
        end.audit_id + 1,
        float(at),
        sanitise(actor),
        sanitise(action, NAME),
        sanitise(target),
        sanitise(origin),
        dict(data or {}),
        "",
    )
    entry = entry._replace(hash=_link(end.audit_hash, entry))
    s.execute(insert(AuditEntry).values(**entry._asdict()))
    s.execute(update(Revision).values(audit_id=entry.id, audit_hash=entry.hash))
    return entry


AuditKey = tuple[float, str, str, str]

_LATELY = 20_000
"""Entries, from the newest, among which is looked: for one that may be there already, and for logins."""


def audit_key(at: float, actor: str, action: str, target: str) -> AuditKey:
    """What tells an entry from others: time in Unix seconds, actor, action and target as they are stored."""
    return float(at), sanitise(actor), sanitise(action, NAME), sanitise(target)


def audited_lately(s: Session, since: float) -> frozenset[AuditKey]:
    """Keys of the newest entries, of what happened at or after a time.

    :param since: Unix seconds
    """
    newest = select(Revision.audit_id).scalar_subquery()
    columns = AuditEntry.at, AuditEntry.actor, AuditEntry.action, AuditEntry.target
    query = select(*columns).where(AuditEntry.id > newest - _LATELY, AuditEntry.at >= since)
    return frozenset((row.at, row.actor, row.action, row.target) for row in s.execute(query))


def removed_robots(s: Session, names: Collection[str]) -> dict[str, float]:
    """When robots of these names were removed the last time, Unix seconds; those that never were are left out."""
    query = (
        select(AuditEntry.target, func.max(AuditEntry.at).label("at"))
        .where(AuditEntry.action == "robot.remove", AuditEntry.target.in_(names))
        .group_by(AuditEntry.target)
    )
    return {row.target: row.at for row in s.execute(query)} if names else {}


def unshared_robots(s: Session, names: Collection[str]) -> dict[tuple[str, str], float]:
    """When robots of these names were taken out of realms the last time, Unix seconds, by name and realm."""
    query = (
        select(AuditEntry.target, AuditEntry.data, AuditEntry.at)
        .where(AuditEntry.action == "robot.unshare", AuditEntry.target.in_(names))
        .order_by(AuditEntry.id)
    )
    found = s.execute(query) if names else ()
    return {(row.target, str(row.data["realm"])): row.at for row in found}


def recent_logins(s: Session) -> list[tuple[str, str]]:
    """Who has proved a password or used a login link lately, and from which address; the oldest first."""
    newest = select(Revision.audit_id).scalar_subquery()
    query = (
        select(AuditEntry.target, AuditEntry.origin, AuditEntry.data)
        .where(AuditEntry.id > newest - _LATELY, AuditEntry.action.in_(("login", "token.issue")))
        .order_by(AuditEntry.id)
    )
    return [
        (row.target, row.origin) for row in s.execute(query) if row.data.get("how") in ("password", "link")
    ]


def verify_audit(s: Session) -> int | None:
    """The number of the first entry that was changed, removed or put in; None if the chain is whole."""
    end = s.execute(select(Revision.audit_id, Revision.audit_hash)).one()
    size = _PAGE
    previous, expected = _START, 1
    while (page := _page(s, expected, size)) != []:
        if page is None and size > 1:
            size = 1
            continue
        for row in page or [None]:
            if row is None or row.id != expected or _broken(previous, row):
                return expected
            previous, expected = str(row.hash), expected + 1
    if (expected - 1, previous) == (end.audit_id, end.audit_hash):
        return None
    return max(1, min(expected, int(end.audit_id)))


def list_audit(s: Session, limit: int = 100) -> list[AuditRecord]:
    """The latest audit entries, newest first."""
    query = select(*_COLUMNS, AuditEntry.data, AuditEntry.hash).order_by(AuditEntry.id.desc()).limit(limit)
    return [AuditRecord(*row) for row in s.execute(query)]


_COLUMNS = (
    AuditEntry.id,
    AuditEntry.at,
    AuditEntry.actor,
    AuditEntry.action,
    AuditEntry.target,
    AuditEntry.origin,
)


def _page(s: Session, first: int, size: int) -> list[Any] | None:
    """Entries from a number on, their data as the text that is stored; None where it is no text at all.

    The first page has no lower end: an entry put in before the first must be seen.
    """
    raw = type_coerce(AuditEntry.data, Text).label("text")
    query = select(*_COLUMNS, raw, AuditEntry.hash).order_by(AuditEntry.id).limit(size)
    try:
        return list(s.execute(query if first == 1 else query.where(AuditEntry.id >= first)))
    except OperationalError as error:
        if isinstance(error.orig, sqlite3.Error) and "decode" in str(error.orig):
            return None
        raise


def _broken(previous: str, row: Any) -> bool:
    """Whether an entry is not the one that was appended, to the byte."""
    try:
        data = json.loads(row.text)
        entry = AuditRecord(row.id, row.at, row.actor, row.action, row.target, row.origin, data, "")
        return canonical_json(data) != str(row.text) or _link(previous, entry) != str(row.hash)
    except (ValueError, TypeError, RecursionError):
        return True


def _link(previous: str, entry: AuditRecord) -> str:
    body = {name: value for name, value in entry._asdict().items() if name != "hash"}
    return hashlib.sha256(f"{previous}\n{canonical_json(body)}".encode()).hexdigest()
