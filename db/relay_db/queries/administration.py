"""What an administrator sees of his realm, many rows at a time; and that those who change it do so in turn."""

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
from relay_db.names import findable_hex, normalise
from relay_db.queries.records import TokenRecord
from relay_db.queries.rights import of_user, with_holders
from relay_db.queries.tokens import list_tokens
from relay_protocol.realms import full_name

_TOKEN_NAME = 16
"""Digits of a token's hash that name it where its number would tell how many tokens other realms have."""


class RealmSize(NamedTuple):
    """How much is in a realm."""

    users: int
    groups: int
    robots: int
    memberships: int
    rights: int
    programs: int
    robot_groups: int
    robot_memberships: int


class RightOnRobot(NamedTuple):
    """Where a right stands: exactly one of ``user`` and ``group`` is a name."""

    id: int
    robot: str
    user: str | None
    group: str | None


def lock_for_change(s: Session) -> None:
    """Have what others change wait until this transaction ends; on SQLite it does anyway."""
    s.execute(select(Revision.id).with_for_update())


def realm_size(s: Session, realm: str) -> RealmSize:
    """How much is in a realm; nothing in one that there is not."""
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
    programs = (
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
    counted = (users, groups, robots, memberships, rights, programs, robot_groups, in_groups)
    return RealmSize(*(s.scalar(each.where(of)) or 0 for each in counted))


def count_patterns(s: Session, *, realm: str, robot_id: int | None = None) -> int:
    """How many patterns the rights that are held in a realm have, or those of them on a robot."""
    none: Any = literal([], JsonText)
    query = with_holders(select(Right.allow, Right.deny)).where(
        Realm.name == normalise(realm), or_(Right.allow != none, Right.deny != none)
    )
    if robot_id is not None:
        query = query.where(Right.robot_id == robot_id)
    return sum(len(allow) + len(deny) for allow, deny in s.execute(query))


def right_places(
    s: Session, realm: str, *, robot_id: int | None = None, user_id: int | None = None
) -> list[RightOnRobot]:
    """Where the rights that are held in a realm stand, without what they say; of a user also those by its groups."""
    query = with_holders(select(Right.id, Robot.name, User.name, Group.name)).where(
        Realm.name == normalise(realm)
    )
    query = query.join(Robot, Robot.id == Right.robot_id)
    if robot_id is not None:
        query = query.where(Right.robot_id == robot_id)
    if user_id is not None:
        query = query.where(of_user(user_id))
    return [RightOnRobot(*row) for row in s.execute(query)]


def groups_of(s: Session, user_ids: Collection[int]) -> dict[int, list[str]]:
    """The names of the groups that users are in, by the number of the user; nothing of who is in none."""
    rows = s.execute(
        select(Membership.user_id, Group.name)
        .join(Group, Group.id == Membership.group_id)
        .where(Membership.user_id.in_(user_ids))
    )
    return _gathered(rows)


def members_of(s: Session, group_ids: Collection[int]) -> dict[int, list[str]]:
    """The names of those who are in groups, by the number of the group; nothing of one that nobody is in."""
    rows = s.execute(
        select(Membership.group_id, User.name)
        .join(User, User.id == Membership.user_id)
        .where(Membership.group_id.in_(group_ids))
    )
    return _gathered(rows)


def group_names(s: Session, realm: str) -> dict[str, int]:
    """The groups of a realm: numbers by name."""
    rows = s.execute(
        select(Group.name, Group.id)
        .join(Realm, Realm.id == Group.realm_id)
        .where(Realm.name == normalise(realm))
    )
    return {row.name: row.id for row in rows}


def count_live_keys(s: Session, robot_ids: Collection[int]) -> dict[int, int]:
    """How many keys of robots are live, by the number of the robot; nothing of one without."""
    rows = s.execute(
        select(RobotKey.robot_id, func.count(RobotKey.id))
        .where(RobotKey.robot_id.in_(robot_ids), RobotKey.retired.is_(None))
        .group_by(RobotKey.robot_id)
    )
    return {row[0]: row[1] for row in rows}


def named_tokens(s: Session, user_id: int) -> dict[str, TokenRecord]:
    """A user's tokens by names that tell nothing of others' tokens, nor what could be used as one."""
    names = s.execute(
        select(AccessToken.id, func.substr(AccessToken.token_hash, 1, _TOKEN_NAME)).where(
            AccessToken.user_id == user_id
        )
    )
    by_number = {row[0]: row[1] for row in names}
    return {by_number[each.id]: each for each in list_tokens(s, user_id)}


def find_token(s: Session, name: str, realm: str) -> int | None:
    """The number of the token of that name (:func:`named_tokens`), if its user is of the realm."""
    if len(name) != _TOKEN_NAME or not findable_hex(name):
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
    """The full name of whom a token proves; ``None`` if there is none of that number."""
    return _full_name(s, AccessToken, token_id)


def user_of_program(s: Session, program_id: int) -> str | None:
    """The full name of whom a program acts for; ``None`` if there is none of that number."""
    return _full_name(s, OAuthClient, program_id)


def _full_name(s: Session, what: type[AccessToken] | type[OAuthClient], number: int) -> str | None:
    query = select(User.name, Realm.name).join(Realm, Realm.id == User.realm_id)
    row = s.execute(query.join(what, what.user_id == User.id).where(what.id == number)).one_or_none()
    return None if row is None else full_name(*row)


def _gathered(rows: Any) -> dict[int, list[str]]:
    found: dict[int, list[str]] = defaultdict(list)
    for number, name in rows:
        found[number].append(name)
    return {number: sorted(names) for number, names in found.items()}
