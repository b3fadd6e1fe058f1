"""Rights of users and groups on robots."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable
from typing import Any

from sqlalchemy import ColumnElement, delete, func, insert, or_, select
from sqlalchemy.orm import Session

from relay_db.models import Group, Membership, Realm, Right, Robot, RobotRealm, User
from relay_db.queries.realms import robot_in_realm
from relay_db.queries.records import RightRecord, RobotRecord, record_of
from relay_db.queries.revision import bump
from relay_db.queries.users import live_user
from relay_protocol.errors import Invalid, NotFound
from relay_protocol.rights import Grant, Level, parse_level, parse_pattern
from relay_protocol.text import is_printable

PATTERNS = 64
"""Most allow and most deny patterns of one right; all are matched against every new resource."""

_PATTERN_LENGTH = 512


def grant_right(
    s: Session,
    robot_id: int,
    level: Level | str,
    *,
    user_id: int | None = None,
    group_id: int | None = None,
    allow: Iterable[str] = (),
    deny: Iterable[str] = (),
) -> None:
    """Grant a right to a user or a group. It replaces the holder's right on the robot.

    :param allow: patterns ``operation:resource`` allowed beyond the level
    :param deny: patterns denied even if something else allows them
    :raises Invalid: not exactly one holder, an invalid pattern, or the robot does not belong to the holder's realm
    :raises NotFound: no such robot, user or group
    """
    level = parse_level(str(level))
    patterns = _patterns(allow), _patterns(deny)
    # First, so that the robot cannot be taken out of the realm meanwhile.
    bump(s)
    _check_realms(s, robot_id, user_id, group_id)
    s.execute(delete(Right).where(_held(robot_id, user_id, group_id)))
    s.execute(
        insert(Right).values(
            robot_id=robot_id,
            user_id=user_id,
            group_id=group_id,
            level=level.value,
            allow=patterns[0],
            deny=patterns[1],
        )
    )


def revoke_right(
    s: Session, robot_id: int, *, user_id: int | None = None, group_id: int | None = None
) -> bool:
    """Revoke the right of a user or a group on a robot; false if there was none.

    :raises Invalid: not exactly one holder
    """
    _one_holder(user_id, group_id)
    bump(s)
    statement = delete(Right).where(_held(robot_id, user_id, group_id)).returning(Right.id)
    return s.scalar(statement) is not None


def list_rights(
    s: Session,
    *,
    robot_id: int | None = None,
    user_id: int | None = None,
    group_id: int | None = None,
    ids: Collection[int] | None = None,
) -> list[RightRecord]:
    """Rights as they were granted, by robot and holder. With ``user_id`` also rights through groups.

    :param ids: only of these numbers
    """
    query = with_holders(
        select(
            Right.id,
            Right.robot_id,
            Robot.name.label("robot"),
            Realm.name.label("realm"),
            User.name.label("user"),
            Group.name.label("group"),
            Right.level,
            Right.allow,
            Right.deny,
        )
        .join(Robot, Robot.id == Right.robot_id)
        .order_by(Robot.name, User.name, Group.name)
    )
    if robot_id is not None:
        query = query.where(Right.robot_id == robot_id)
    if group_id is not None:
        query = query.where(Right.group_id == group_id)
    if user_id is not None:
        query = query.where(held_by_user(user_id))
    if ids is not None:
        query = query.where(Right.id.in_(ids))
    return [
        record_of(RightRecord, row, level=Level(row.level), allow=tuple(row.allow), deny=tuple(row.deny))
        for row in s.execute(query)
    ]


def get_right(
    s: Session, robot_id: int, *, user_id: int | None = None, group_id: int | None = None
) -> RightRecord | None:
    """The right of a user or a group on a robot, without rights through groups.

    :raises Invalid: not exactly one holder
    """
    _one_holder(user_id, group_id)
    ids = s.scalars(select(Right.id).where(_held(robot_id, user_id, group_id))).all()
    return next(iter(list_rights(s, ids=ids)), None)


def grants_for(s: Session, user_id: int, robot_id: int) -> list[Grant]:
    """All grants of a user on a robot: its own, those of its groups, and an administrator's.

    A disabled user has none, nor has a user of a realm that the robot does not belong to.
    """
    return _grants(s, user_id, robot_id).get(robot_id, [])


def robots_with_grants(s: Session, user_id: int) -> list[tuple[RobotRecord, list[Grant]]]:
    """The robots on which a user has at least one right, by name."""
    grants = _grants(s, user_id, None)
    robots = s.execute(
        select(Robot.id, Robot.name, Realm.name.label("realm"), Robot.description)
        .join(Realm, Realm.id == Robot.realm_id)
        .join(RobotRealm, RobotRealm.robot_id == Robot.id)
        .join(User, User.realm_id == RobotRealm.realm_id)
        .where(User.id == user_id)
        .order_by(Robot.name)
    )
    return [(record_of(RobotRecord, row), grants[row.id]) for row in robots if row.id in grants]


def _grants(s: Session, user_id: int, robot_id: int | None) -> dict[int, list[Grant]]:
    """Grants of a live user by robot, of one robot or of all."""
    user = s.execute(
        select(User.name, User.admin, User.realm_id).where(User.id == user_id, live_user())
    ).one_or_none()
    grants: dict[int, list[Grant]] = defaultdict(list)
    if user is None:
        return grants
    if user.admin:
        robots = select(RobotRealm.robot_id).where(RobotRealm.realm_id == user.realm_id)
        for each in s.scalars(robots if robot_id is None else robots.where(RobotRealm.robot_id == robot_id)):
            grants[each].append(Grant(Level.OWNER, source=f"admin {user.name}"))
    rights = (
        select(Right.robot_id, Right.level, Right.allow, Right.deny, Group.name.label("group"))
        .join(RobotRealm, (RobotRealm.robot_id == Right.robot_id) & (RobotRealm.realm_id == user.realm_id))
        .outerjoin(Group, Group.id == Right.group_id)
        .where(held_by_user(user_id))
        .order_by(Right.id)
    )
    for row in s.execute(rights if robot_id is None else rights.where(Right.robot_id == robot_id)):
        source = f"user {user.name}" if row.group is None else f"group {row.group}"
        grants[row.robot_id].append(Grant(Level(row.level), tuple(row.allow), tuple(row.deny), source))
    return grants


def held_by_user(user_id: int) -> ColumnElement[bool]:
    """The rights of a user, also through groups."""
    groups = select(Membership.group_id).where(Membership.user_id == user_id)
    return or_(Right.user_id == user_id, Right.group_id.in_(groups))


def with_holders(query: Any) -> Any:
    """Rights with the users or groups that hold them, and the realms of these."""
    return (
        query.outerjoin(User, User.id == Right.user_id)
        .outerjoin(Group, Group.id == Right.group_id)
        .join(Realm, Realm.id == func.coalesce(User.realm_id, Group.realm_id))
    )


def _held(robot_id: int, user_id: int | None, group_id: int | None) -> Any:
    holder = Right.user_id == user_id if user_id is not None else Right.group_id == group_id
    return (Right.robot_id == robot_id) & holder


def _one_holder(user_id: int | None, group_id: int | None) -> None:
    if (user_id is None) == (group_id is None):
        raise Invalid("a right belongs to exactly one user or group")


def _check_realms(s: Session, robot_id: int, user_id: int | None, group_id: int | None) -> None:
    _one_holder(user_id, group_id)
    if s.scalar(select(Robot.id).where(Robot.id == robot_id)) is None:
        raise NotFound("there is no such robot")
    if user_id is not None:
        holder_realm = s.scalar(select(User.realm_id).where(User.id == user_id))
    else:
        holder_realm = s.scalar(select(Group.realm_id).where(Group.id == group_id))
    if holder_realm is None:
        raise NotFound("there is no such user or group")
    if not robot_in_realm(s, robot_id, holder_realm):
        raise Invalid("the robot does not belong to the realm of the holder of the right")


def _patterns(texts: Iterable[str]) -> list[str]:
    patterns = [parse_pattern(text) for text in texts]
    if len(patterns) > PATTERNS:
        raise Invalid(f"a right has at most {PATTERNS} allow and {PATTERNS} deny patterns")
    for each in patterns:
        if len(each) > _PATTERN_LENGTH or not is_printable(each):
            raise Invalid(f"a pattern is one printable line of at most {_PATTERN_LENGTH} characters")
    return patterns
