"""Lists and counts for administrators of a realm, and the lock under which they change it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection
from typing import Any, NamedTuple

from sqlalchemy import ColumnElement, func, literal, or_, select
from sqlalchemy.orm import Session

from relay_db.base import JsonText
from relay_db.models import (
    AccessToken,
    Group,
    Membership,
    OAuthClient,
    Realm,
    Revision,
    Right,
    Robot,
    RobotGroup,
    RobotKey,
    RobotMembership,
    RobotRealm,
    User,
)
from relay_db.names import normalise, normalise_hex
from relay_db.queries.realms import numbers_by_name
from relay_db.queries.records import TokenRecord, fetch_all
from relay_db.queries.rights import held_by_user, with_holders
from relay_db.queries.tokens import list_tokens
from relay_protocol.realms import full_name

_TOKEN_NAME = 16
"""Digits of a token's hash that identify it over HTTP: its number would show how many tokens other realms have."""


class RealmSize(NamedTuple):
    """Counts of what belongs to a realm."""

    users: int
    groups: int
    robots: int
    memberships: int
    rights: int
    oauth_clients: int
    robot_groups: int
    robot_memberships: int


class RightOnRobot(NamedTuple):
    """Robot and holder of a right. Exactly one of ``user`` and ``group`` is a name."""

    id: int
    robot: str
    user: str | None
    group: str | None


def lock_for_change(s: Session) -> None:
    """Make other changes wait until this transaction ends; on SQLite they always do."""
    s.execute(select(Revision.id).with_for_update())


def realm_size(s: Session, realm: str) -> RealmSize:
    """Counts of what belongs to a realm; zeros if it does not exist."""
    of = Realm.name == normalise(realm)
    users = select(func.count(User.id)).join(Realm, Realm.id == User.realm_id)
    groups = select(func.count(Group.id)).join(Realm, Realm.id == Group.realm_id)
    robots = select(func.count(RobotRealm.robot_id)).join(Realm, Realm.id == RobotRealm.realm_id)
    memberships = (
        select(func.count(Membership.user_id))
        .join(Group, Group.id == Membership.group_id)
        .join(Realm, Realm.id == Group.realm_id)
    )
    rights = with_holders(select(func.count(Right.id)))
    oauth_clients = (
        select(func.count(OAuthClient.id))
        .join(User, User.id == OAuthClient.user_id)
        .join(Realm, Realm.id == User.realm_id)
    )
    robot_groups = select(func.count(RobotGroup.id)).join(Realm, Realm.id == RobotGroup.realm_id)
    in_groups = (
        select(func.count(RobotMembership.robot_id))
        .join(RobotGroup, RobotGroup.id == RobotMembership.group_id)
        .join(Realm, Realm.id == RobotGroup.realm_id)
    )

    def count(query: Any) -> int:
        return s.scalar(query.where(of)) or 0

    return RealmSize(
        users=count(users),
        groups=count(groups),
        robots=count(robots),
        memberships=count(memberships),
        rights=count(rights),
        oauth_clients=count(oauth_clients),
        robot_groups=count(robot_groups),
        robot_memberships=count(in_groups),
    )


def count_patterns(s: Session, *, realm: str, robot_id: int | None = None) -> int:
    """The number of patterns in the rights that are held in a realm, on one robot or on all."""
    none: Any = literal([], JsonText)
    query = with_holders(select(Right.allow, Right.deny)).where(
        Realm.name == normalise(realm), or_(Right.allow != none, Right.deny != none)
    )
    if robot_id is not None:
        query = query.where(Right.robot_id == robot_id)
    return sum(len(allow) + len(deny) for allow, deny in s.execute(query))


def list_right_holders(
    s: Session, realm: str, *, robot_id: int | None = None, user_id: int | None = None
) -> list[RightOnRobot]:
    """Robots and holders of the rights that are held in a realm. With ``user_id`` also rights through groups."""
    query = with_holders(
        select(Right.id, Robot.name.label("robot"), User.name.label("user"), Group.name.label("group"))
    ).where(Realm.name == normalise(realm))
    query = query.join(Robot, Robot.id == Right.robot_id)
    if robot_id is not None:
        query = query.where(Right.robot_id == robot_id)
    if user_id is not None:
        query = query.where(held_by_user(user_id))
    return fetch_all(s, RightOnRobot, query)


def groups_of(s: Session, user_ids: Collection[int]) -> dict[int, list[str]]:
    """The names of the groups of users, by the number of the user. Users without a group are missing."""
    rows = s.execute(
        select(Membership.user_id, Group.name)
        .join(Group, Group.id == Membership.group_id)
        .where(Membership.user_id.in_(user_ids))
    )
    return _names_by_number(rows)


def members_of(s: Session, group_ids: Collection[int]) -> dict[int, list[str]]:
    """The names of the members of groups, by the number of the group. Empty groups are missing."""
    rows = s.execute(
        select(Membership.group_id, User.name)
        .join(User, User.id == Membership.user_id)
        .where(Membership.group_id.in_(group_ids))
    )
    return _names_by_number(rows)


def group_names(s: Session, realm: str) -> dict[str, int]:
    """The numbers of the groups of users of a realm, by name."""
    return numbers_by_name(s, Group, realm)


def count_live_keys(s: Session, robot_ids: Collection[int]) -> dict[int, int]:
    """The number of live keys of robots, by the number of the robot. Robots without one are missing."""
    rows = s.execute(
        select(RobotKey.robot_id, func.count(RobotKey.id))
        .where(RobotKey.robot_id.in_(robot_ids), RobotKey.retired.is_(None))
        .group_by(RobotKey.robot_id)
    )
    return {row[0]: row[1] for row in rows}


def tokens_by_name(s: Session, user_id: int) -> dict[str, TokenRecord]:
    """A user's tokens by a name that shows nothing about other tokens, and is not usable as a token."""
    names = s.execute(
        select(AccessToken.id, func.substr(AccessToken.token_hash, 1, _TOKEN_NAME)).where(
            AccessToken.user_id == user_id
        )
    )
    by_number = {row[0]: row[1] for row in names}
    return {by_number[each.id]: each for each in list_tokens(s, user_id)}


def find_token(s: Session, name: str, realm: str) -> int | None:
    """The number of a token by its name (:func:`tokens_by_name`), if its user belongs to the realm."""
    if len(name) != _TOKEN_NAME or not normalise_hex(name):
        return None
    named: ColumnElement[bool] = AccessToken.token_hash.startswith(name)
    query = (
        select(AccessToken.id)
        .join(User, User.id == AccessToken.user_id)
        .join(Realm, Realm.id == User.realm_id)
        .where(named, Realm.name == normalise(realm))
    )
    return s.scalars(query).first()


def user_of_token(s: Session, token_id: int) -> str | None:
    """The full name of the user of a token; ``None`` if there is no such token."""
    return _user_of(s, AccessToken, token_id)


def user_of_oauth_client(s: Session, oauth_client_id: int) -> str | None:
    """The full name of the user of an OAuth client; ``None`` if there is no such client."""
    return _user_of(s, OAuthClient, oauth_client_id)


def _user_of(s: Session, table: type[AccessToken] | type[OAuthClient], number: int) -> str | None:
    query = select(User.name, Realm.name.label("realm")).join(Realm, Realm.id == User.realm_id)
    row = s.execute(query.join(table, table.user_id == User.id).where(table.id == number)).one_or_none()
    return None if row is None else full_name(row.name, row.realm)


def _names_by_number(rows: Any) -> dict[int, list[str]]:
    found: dict[int, list[str]] = defaultdict(list)
    for number, name in rows:
        found[number].append(name)
    return {number: sorted(names) for number, names in found.items()}
