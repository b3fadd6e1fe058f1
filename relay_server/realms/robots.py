"""A realm's robots, their keys and groups, and the rights on them, as administrators see and change them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.queries import AlreadyExists, GroupRecord, RightOnRobot, RightRecord, RobotRecord
from relay_protocol.errors import NotFound
from relay_protocol.limits import ENROLMENT_SECONDS
from relay_server.realms.changes import GROUP_MARK, NotInGroup, holder_ids
from relay_server.realms.realm_change import (
    NO_PRECONDITION,
    Precondition,
    RealmChangeTransaction,
    holder_in,
    home_robot_in,
    new_name,
    no_types,
    robot_group_in,
    robot_in,
    user_in,
)
from relay_server.resources.page import PageQuery

NO_RIGHT = "there is no such right; rights of groups and of administrators are separate"

# --- robots -----------------------------------------------------------------------------------------------


def robots(s: Session, realm: str, listing: PageQuery) -> dict[str, Any]:
    """A page of robots, enrolled or not."""
    found, behind = listing.page({each.name: each for each in queries.list_robots(s, realm)}, no_types)
    keys = queries.count_live_keys(s, [each.id for _, each in found])
    return {"robots": [_robot(each, keys.get(each.id, 0), realm) for _, each in found], "next": behind}


def robot(s: Session, realm: str, name: str) -> dict[str, Any]:
    found = robot_in(s, realm, name)
    return _robot(found, queries.count_live_keys(s, [found.id]).get(found.id, 0), realm)


def number(s: Session, realm: str, name: str) -> int:
    return robot_in(s, realm, name).id


def add_robot(change: RealmChangeTransaction, name: str, description: str) -> dict[str, Any]:
    """:raises Invalid: the name or description is not valid
    :raises AlreadyExists: the name is taken
    :raises QuotaExceeded: there are too many
    """
    if queries.find_robot(change.session, name, change.realm) is not None:
        raise AlreadyExists(f"the robot '{name}' exists already")
    change.check_room("robots")
    added, code = change.add_robot(name, change.realm, description)
    return {**_robot(added, 0, change.realm), **_enrolment(code)}


def change_robot(
    change: RealmChangeTransaction, name: str, description: str | None, seen: Precondition = NO_PRECONDITION
) -> dict[str, Any]:
    """Change a robot; ``None`` leaves a field as it is.

    :raises NotFound: no such robot
    :raises PreconditionFailed: it has changed
    :raises Invalid: the description is not valid
    :raises Refused: it belongs to another realm
    """
    found = change.home_robot(name)
    keys = queries.count_live_keys(change.session, [found.id]).get(found.id, 0)
    seen.check(_robot(found, keys, change.realm))
    if description is not None and description != found.description:
        found = change.set_robot_description(found, description)
    return _robot(found, keys, change.realm)


def new_code(change: RealmChangeTransaction, name: str) -> dict[str, Any]:
    """:raises NotFound: no such robot
    :raises Refused: it belongs to another realm
    """
    found = change.home_robot(name)
    return {"robot": found.name, **_enrolment(change.new_code(found))}


def remove_robot(change: RealmChangeTransaction, name: str, recordings: int) -> None:
    """:param recordings: how many recordings are deleted with it
    :raises NotFound: no such robot
    :raises Refused: it belongs to another realm
    """
    change.remove_robot(change.home_robot(name), recordings)


def _robot(record: RobotRecord, keys: int, realm: str) -> dict[str, Any]:
    current = {"robot": record.name, "description": record.description}
    return {**current, "keys": keys, "guest": record.realm != realm}


def _enrolment(code: str) -> dict[str, Any]:
    return {"enrolment_code": code, "expires_in": ENROLMENT_SECONDS}


# --- keys -------------------------------------------------------------------------------------------------


def keys(s: Session, realm: str, name: str, listing: PageQuery) -> dict[str, Any]:
    """A page of all keys that a robot ever had.

    :raises NotFound: no such robot
    """
    known = queries.list_keys(s, home_robot_in(s, realm, name).id)
    found, behind = listing.page({each.fingerprint: each for each in known}, no_types)
    return {"keys": [each._asdict() for _, each in found], "next": behind}


def revoke_key(change: RealmChangeTransaction, name: str, fingerprint: str) -> None:
    """:raises NotFound: no such robot, or no such valid key
    :raises Refused: it belongs to another realm
    """
    change.revoke_key(change.home_robot(name), fingerprint)


# --- groups -----------------------------------------------------------------------------------------------


def groups(s: Session, realm: str, listing: PageQuery) -> dict[str, Any]:
    """A page of groups of robots with their members."""
    found, behind = listing.page(queries.robot_group_names(s, realm), no_types)
    members = queries.robots_of_groups(s, [number for _, number in found])
    return {"robot_groups": [_group(name, members[number]) for name, number in found], "next": behind}


def group(s: Session, realm: str, name: str) -> dict[str, Any]:
    """:raises NotFound: no such group of robots"""
    found = robot_group_in(s, realm, name)
    return _group(found.name, found.robots)


def add_group(change: RealmChangeTransaction, name: str) -> dict[str, Any]:
    """:raises Invalid: the name is not valid
    :raises AlreadyExists: the name is taken
    :raises QuotaExceeded: there are too many
    """
    name = new_name(name, "group")
    if queries.find_robot_group(change.session, name, change.realm) is not None:
        raise AlreadyExists(f"the group of robots '{name}' exists already")
    change.check_room("robot_groups")
    return _group(change.fill_robot_group(name, change.realm).name, ())


def remove_group(change: RealmChangeTransaction, name: str) -> None:
    """:raises NotFound: no such group of robots"""
    change.remove_robot_group(change.robot_group(name))


def join(change: RealmChangeTransaction, name: str, robot: str) -> None:
    """:raises NotFound: no such group or robot
    :raises QuotaExceeded: groups have too many members
    """
    found, member = change.robot_group(name), change.robot(robot)
    if member.name not in found.robots:
        change.check_room("robot_memberships")
        change.fill_robot_group(found.name, change.realm, [member])


def leave(change: RealmChangeTransaction, name: str, robot: str) -> None:
    """:raises NotFound: no such group or robot, or the robot is not in it"""
    found, member = change.robot_group(name), change.robot(robot)
    try:
        change.empty_robot_group(found, [member])
    except NotInGroup:
        raise NotFound("the robot is not in this group") from None


def _group(name: str, robots: Sequence[str]) -> dict[str, Any]:
    return {"group": name, "robots": list(robots)}


# --- rights -----------------------------------------------------------------------------------------------


def rights(s: Session, realm: str, listing: PageQuery, robot: str | None, user: str | None) -> dict[str, Any]:
    """A page of rights as they were granted, ordered by robot and holder.

    :param robot: only rights on this robot
    :param user: only rights of this user, including those of their groups
    :raises NotFound: no such robot or user
    """
    places = queries.list_right_holders(
        s,
        realm,
        robot_id=None if robot is None else robot_in(s, realm, robot).id,
        user_id=None if user is None else user_in(s, realm, user).id,
    )
    page, behind = listing.page({f"{each.robot}/{_holder(each)}": each.id for each in places}, no_types)
    found = {each.id: each for each in queries.list_rights(s, ids=[id for _, id in page])}
    return {"rights": [_info(found[id]) for _, id in page], "next": behind}


def right(s: Session, realm: str, robot: str, holder: str) -> dict[str, Any]:
    """The right that a holder has on a robot.

    :raises NotFound: no such robot, user or group, or no such right
    """
    found = robot_in(s, realm, robot)
    held = queries.get_right(s, found.id, **holder_ids(holder_in(s, realm, holder)))
    if held is None:
        raise NotFound(NO_RIGHT)
    return _info(held)


def grant(
    change: RealmChangeTransaction,
    robot: str,
    holder: str,
    level: str,
    allow: Sequence[str],
    deny: Sequence[str],
    seen: Precondition = NO_PRECONDITION,
) -> tuple[dict[str, Any], bool]:
    """Grant a right; also returns whether the holder had none on the robot. An equal right is left as it is.

    :raises NotFound: no such robot, user or group
    :raises PreconditionFailed: the right has changed
    :raises Invalid: a pattern is not valid
    :raises QuotaExceeded: there are too many patterns
    :raises Refused: the token has a scope
    """
    change.require_full_scope()
    found, whose = change.robot(robot), change.holder(holder)
    mark = GROUP_MARK if isinstance(whose, GroupRecord) else ""
    current = _right(found.name, f"{mark}{whose.name}", level, allow, deny)
    held = queries.get_right(change.session, found.id, **holder_ids(whose))
    seen.check(None if held is None else _info(held))
    if held is not None and _info(held) == current:
        return current, False
    if held is None:
        change.check_room("rights")
    before = 0 if held is None else len(held.allow) + len(held.deny)
    change.check_pattern_room(found, len(allow) + len(deny) - before)
    change.grant(found, whose, level, allow, deny)
    return current, held is None


def revoke(change: RealmChangeTransaction, robot: str, holder: str) -> None:
    """:raises NotFound: no such robot, user or group, or no such right
    :raises Refused: the token has a scope
    """
    change.require_full_scope()
    if not change.revoke(change.robot(robot), change.holder(holder)):
        raise NotFound(NO_RIGHT)


def _holder(record: RightRecord | RightOnRobot) -> str:
    return f"{GROUP_MARK}{record.group}" if record.user is None else record.user


def _info(record: RightRecord) -> dict[str, Any]:
    return _right(record.robot, _holder(record), str(record.level), record.allow, record.deny)


def _right(robot: str, holder: str, level: str, allow: Sequence[str], deny: Sequence[str]) -> dict[str, Any]:
    current = {"holder": holder, "robot": robot, "level": level}
    return {**current, "allow": list(allow), "deny": list(deny)}
