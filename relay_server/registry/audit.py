"""Changes of the directory, each in one transaction with what the audit log says of it."""

from __future__ import annotations

from typing import Any

from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.queries import EntryRecord
from relay_protocol.realms import full_name
from relay_server.access import Principal


def change(
    s: Session, principal: Principal, before: EntryRecord, values: dict[str, Any], now: float, address: str
) -> EntryRecord | None:
    """Have an entry say something else; see :func:`relay_db.queries.directory.change_entry`.

    :param address: where the principal is
    """
    kept = queries.change_entry(s, before, now=now, **values)
    if kept is not None:
        _audit(s, "directory.change", principal, kept, now, address)
    return kept


def remove(
    s: Session, principal: Principal, before: EntryRecord, now: float, address: str
) -> EntryRecord | None:
    """Take an entry out; see :func:`relay_db.queries.directory.remove_entry`."""
    gone = queries.remove_entry(s, before.id, now)
    if gone is not None:
        _audit(s, "directory.remove", principal, gone, now, address)
    return gone


def _audit(
    s: Session, action: str, principal: Principal, record: EntryRecord, now: float, address: str
) -> None:
    """Say who has changed what another has registered. What somebody does with his own is in the memory alone."""
    if record.user_id == principal.user_id:
        return
    queries.append_audit(
        s,
        at=now,
        actor=f"user:{principal.full}",
        action=action,
        target=record.id,
        origin=address,
        data=audited(record),
    )


def audited(record: EntryRecord) -> dict[str, Any]:
    """What the audit log says of an entry."""
    return {
        "kind": record.kind,
        "name": record.name,
        "robot": record.robot and full_name(record.robot, record.realm),
        "registrant": full_name(record.user, record.realm),
        "address": record.address,
    }
