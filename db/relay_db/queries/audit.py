"""The audit log: a hash chain, in which the hash of each entry covers the entry before."""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Collection, Mapping
from typing import Any

from sqlalchemy import Text, func, insert, select, type_coerce, update
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from relay_db.base import canonical_json
from relay_db.models import NAME, AuditEntry, Revision
from relay_db.names import sanitise
from relay_db.queries.records import AuditRecord, fetch_all

_START = hashlib.sha256(b"").hexdigest()
"""The hash that the first entry follows."""

_PAGE = 1000


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
    """Add an entry to the chain. Text is made printable and cut to length.

    :param at: Unix seconds
    :param actor: such as ``user:ann`` or ``cli:root``
    :param action: such as ``right.grant``
    :param target: name of what was changed
    :param origin: network address of the actor
    :raises ValueError: the data contains NaN or Infinity
    """
    end = s.execute(select(Revision.audit_id, Revision.audit_hash).with_for_update()).one()
    entry = AuditRecord(
        id=end.audit_id + 1,
        at=float(at),
        actor=sanitise(actor),
        action=sanitise(action, NAME),
        target=sanitise(target),
        origin=sanitise(origin),
        data=dict(data or {}),
        hash="",
    )
    entry = entry._replace(hash=_link(end.audit_hash, entry))
    s.execute(insert(AuditEntry).values(**entry._asdict()))
    s.execute(update(Revision).values(audit_id=entry.id, audit_hash=entry.hash))
    return entry


AuditKey = tuple[float, str, str, str]

_RECENT = 20_000
"""Newest entries that are searched for entries that may have been written already."""


def audit_key(at: float, actor: str, action: str, target: str) -> AuditKey:
    """Identifies an entry: time in Unix seconds, and actor, action and target as they are stored."""
    return float(at), sanitise(actor), sanitise(action, NAME), sanitise(target)


def recent_audit_keys(s: Session, since: float) -> frozenset[AuditKey]:
    """Keys of the newest entries, from a time on.

    :param since: Unix seconds
    """
    newest = select(Revision.audit_id).scalar_subquery()
    columns = AuditEntry.at, AuditEntry.actor, AuditEntry.action, AuditEntry.target
    query = select(*columns).where(AuditEntry.id > newest - _RECENT, AuditEntry.at >= since)
    return frozenset((row.at, row.actor, row.action, row.target) for row in s.execute(query))


def robot_removals(s: Session, names: Collection[str]) -> dict[str, float]:
    """Unix seconds at which robots of these names were last removed. Others are missing."""
    query = (
        select(AuditEntry.target, func.max(AuditEntry.at).label("at"))
        .where(AuditEntry.action == "robot.remove", AuditEntry.target.in_(names))
        .group_by(AuditEntry.target)
    )
    return {row.target: row.at for row in s.execute(query)} if names else {}


def robot_unshares(s: Session, names: Collection[str]) -> dict[tuple[str, str], float]:
    """Unix seconds at which robots of these names were last taken out of a realm, by name and realm."""
    query = (
        select(AuditEntry.target, AuditEntry.data, AuditEntry.at)
        .where(AuditEntry.action == "robot.unshare", AuditEntry.target.in_(names))
        .order_by(AuditEntry.id)
    )
    found = s.execute(query) if names else ()
    return {(row.target, str(row.data["realm"])): row.at for row in found}


def verify_audit(s: Session) -> int | None:
    """The number of the first entry that was changed, removed or inserted; ``None`` if the chain is intact."""
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
    return fetch_all(s, AuditRecord, query)


_COLUMNS = (
    AuditEntry.id,
    AuditEntry.at,
    AuditEntry.actor,
    AuditEntry.action,
    AuditEntry.target,
    AuditEntry.origin,
)


def _page(s: Session, first: int, size: int) -> list[Any] | None:
    """Entries from a number on, with their data as stored text; ``None`` if the text cannot be decoded.

    The first page has no lower bound, so that an entry inserted before the first is found.
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
    """Whether an entry differs from the one that was appended, in any byte."""
    try:
        data = json.loads(row.text)
        entry = AuditRecord(row.id, row.at, row.actor, row.action, row.target, row.origin, data, "")
        return canonical_json(data) != str(row.text) or _link(previous, entry) != str(row.hash)
    except (ValueError, TypeError, RecursionError):
        return True


def _link(previous: str, entry: AuditRecord) -> str:
    body = {name: value for name, value in entry._asdict().items() if name != "hash"}
    return hashlib.sha256(f"{previous}\n{canonical_json(body)}".encode()).hexdigest()
