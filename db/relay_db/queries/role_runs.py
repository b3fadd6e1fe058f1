"""Roles that users have started."""

from __future__ import annotations

from typing import NamedTuple

from sqlalchemy import delete, insert, select, update
from sqlalchemy.orm import Session

from relay_db.models import Realm, RoleDocument, RoleRun
from relay_db.names import sanitise
from relay_db.queries.records import UserRecord
from relay_db.queries.users import get_user


class RoleRunRecord(NamedTuple):
    """A Role that a user has started.

    :param user: by whose rights it runs
    :param at: Unix time of its start
    :param parts: JSON
    :param reason: why the relay ended it; empty while it is started
    """

    role_id: int
    role: str
    realm: str
    user: UserRecord
    at: float
    parts: str
    reason: str


def list_role_runs(s: Session, realm: str | None = None, role: str | None = None) -> list[RoleRunRecord]:
    """Roles that were started, of all realms or of one; or one of them."""
    query = (
        select(RoleRun, RoleDocument.name, Realm.name)
        .join(RoleDocument, RoleDocument.id == RoleRun.role_id)
        .join(Realm, Realm.id == RoleDocument.realm_id)
        .order_by(RoleRun.role_id)
    )
    if realm is not None:
        query = query.where(Realm.name == realm)
    if role is not None:
        query = query.where(RoleDocument.name == role)
    found = []
    for run, name, realm_name in s.execute(query):
        user = get_user(s, run.user_id)
        if user is not None:
            found.append(RoleRunRecord(run.role_id, name, realm_name, user, run.at, run.parts, run.reason))
    return found


def begin_role_run(s: Session, realm: str, role: str, user_id: int, at: float) -> int | None:
    """Store that a user has started a Role.

    :returns: the Role's number; ``None`` if there is none
    """
    role_id = s.scalar(
        select(RoleDocument.id)
        .join(Realm, Realm.id == RoleDocument.realm_id)
        .where(Realm.name == realm, RoleDocument.name == role)
    )
    if role_id is not None:
        remove_role_run(s, role_id)
        s.execute(insert(RoleRun).values(role_id=role_id, user_id=user_id, at=at, parts="[]", reason=""))
    return role_id


def set_role_parts(s: Session, role_id: int, parts: str) -> None:
    """Store the parts of a Role that was started, JSON."""
    s.execute(update(RoleRun).where(RoleRun.role_id == role_id).values(parts=parts))


def end_role_run(s: Session, role_id: int, reason: str) -> bool:
    """Store why the relay ended a Role; false if it was not started."""
    ended = (
        update(RoleRun)
        .where(RoleRun.role_id == role_id, RoleRun.reason == "")
        .values(reason=sanitise(reason))
        .returning(RoleRun.role_id)
    )
    return s.scalar(ended) is not None


def remove_role_run(s: Session, role_id: int) -> None:
    """Delete the record that a Role was started."""
    s.execute(delete(RoleRun).where(RoleRun.role_id == role_id))
