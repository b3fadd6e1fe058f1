"""The revision counter, which every change of access counts up."""

from __future__ import annotations

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from relay_db.models import Revision


def revision(s: Session) -> int:
    """The number of the latest change."""
    return s.scalars(select(Revision.number)).one()


def bump(s: Session) -> None:
    """Count one change. On PostgreSQL this also makes other changes wait until the transaction ends."""
    s.execute(update(Revision).values(number=Revision.number + 1))
