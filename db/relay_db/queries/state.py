"""The revision counter: one number that tells whether anything about access changed."""

from __future__ import annotations

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from relay_db.models import Revision


def revision(s: Session) -> int:
    """The number of the latest change to who may do what."""
    return s.scalars(select(Revision.number)).one()


def bump(s: Session) -> None:
    """Count one change. On PostgreSQL this also puts changes in a row until the end of the transaction."""
    s.execute(update(Revision).values(number=Revision.number + 1))
