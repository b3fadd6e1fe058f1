"""Tasks of which one relay of a cluster at a time has each. Time is that of the database, which all relays share."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Double, cast, delete, extract, func, insert, or_, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from relay_db.models import RelayLease


def acquire_relay_lease(s: Session, task: str, relay: str, seconds: float) -> bool:
    """Acquire or renew the lease of a task; false if another relay has it.

    :param relay: id of the relay
    :param seconds: until it ends
    """
    now: Any = cast(extract("epoch", func.now()), Double)
    free = or_(RelayLease.relay == relay, RelayLease.expires < now)
    changed = (
        update(RelayLease).where(RelayLease.task == task, free).values(relay=relay, expires=now + seconds)
    )
    if s.scalar(changed.returning(RelayLease.task)) is not None:
        return True
    if s.scalar(select(RelayLease.task).where(RelayLease.task == task)) is not None:
        return False
    try:
        with s.begin_nested():
            s.execute(insert(RelayLease).values(task=task, relay=relay, expires=now + seconds))
    except IntegrityError:
        return False
    return True


def release_relay_leases(s: Session, relay: str) -> None:
    """End all leases of a relay."""
    s.execute(delete(RelayLease).where(RelayLease.relay == relay))
