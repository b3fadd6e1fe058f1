"""Roles of a realm: documents with revisions."""

from __future__ import annotations

from collections.abc import Collection

from sqlalchemy import delete, func, insert, select, update
from sqlalchemy.orm import Session

from relay_db.models import Realm, RoleDocument
from relay_db.names import sanitise
from relay_db.queries.realms import realm_id
from relay_db.queries.records import NewRole, RoleRecord, fetch_all, fetch_one

_SUMMARY = (
    RoleDocument.name,
    RoleDocument.revision,
    RoleDocument.serial,
    RoleDocument.owner_id,
    RoleDocument.by,
    RoleDocument.at,
    RoleDocument.statements,
    RoleDocument.robots,
)


def list_roles(s: Session, realm: str) -> list[RoleRecord]:
    """All Roles of a realm, by name."""
    query = select(*_SUMMARY).where(RoleDocument.realm_id == realm_id(s, realm)).order_by(RoleDocument.name)
    return fetch_all(s, RoleRecord, query)


def find_role(s: Session, realm: str, name: str) -> RoleRecord | None:
    """A Role of a realm."""
    query = select(*_SUMMARY).where(RoleDocument.realm_id == realm_id(s, realm), RoleDocument.name == name)
    return fetch_one(s, RoleRecord, query)


def role_documents(s: Session, realm: str, names: Collection[str]) -> list[tuple[str, str]]:
    """Names and documents (N-Triples) of these Roles, by name; those that do not exist are left out."""
    query = (
        select(RoleDocument.name, RoleDocument.document)
        .where(RoleDocument.realm_id == realm_id(s, realm), RoleDocument.name.in_(names))
        .order_by(RoleDocument.name)
    )
    return [(name, document) for name, document in s.execute(query)]


def role_version(s: Session, realm: str) -> tuple[int, int, int]:
    """A value that differs after each change of a realm's Roles: highest serial, highest number, how many."""
    query = select(func.max(RoleDocument.serial), func.max(RoleDocument.id), func.count()).where(
        RoleDocument.realm_id == realm_id(s, realm)
    )
    serial, number, count = s.execute(query).one()
    return serial or 0, number or 0, count


def role_totals(s: Session, realm: str, owner_id: int | None) -> tuple[int, int, int]:
    """Roles of a realm, statements in all of them, and Roles of one owner."""
    of_realm = RoleDocument.realm_id == realm_id(s, realm)
    roles, statements = s.execute(
        select(func.count(), func.coalesce(func.sum(RoleDocument.statements), 0)).where(of_realm)
    ).one()
    own = s.scalar(
        select(func.count()).select_from(RoleDocument).where(of_realm, RoleDocument.owner_id == owner_id)
    )
    return roles, statements, own or 0


def store_role(
    s: Session, realm: str, new: NewRole, *, owner_id: int | None, by: str, at: float
) -> RoleRecord:
    """Add a Role, or replace its document; it keeps its owner.

    :param owner_id: of a new one
    :param by: full name of the user
    :param at: Unix seconds
    """
    number = realm_id(s, realm)
    # Changes of the Roles of one realm happen one after the other, so serials grow.
    s.execute(select(Realm.id).where(Realm.id == number).with_for_update())
    serial = role_version(s, realm)[0] + 1
    old = find_role(s, realm, new.name)
    values = {**new._asdict(), "serial": serial, "by": sanitise(by), "at": float(at)}
    if old is None:
        s.execute(insert(RoleDocument).values(**values, realm_id=number, revision=1, owner_id=owner_id))
    else:
        here = (RoleDocument.realm_id == number, RoleDocument.name == new.name)
        s.execute(update(RoleDocument).where(*here).values(**values, revision=old.revision + 1))
    stored = find_role(s, realm, new.name)
    assert stored is not None
    return stored


def remove_role(s: Session, realm: str, name: str) -> bool:
    """Remove a Role; false if there was none."""
    here = delete(RoleDocument).where(RoleDocument.realm_id == realm_id(s, realm), RoleDocument.name == name)
    return s.scalar(here.returning(RoleDocument.id)) is not None
