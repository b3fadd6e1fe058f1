"""The robots of a realm, their keys, groups, and the rights on them: as an administrator sees and changes them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.queries import AlreadyExists, GroupRecord, RightOnRobot, RightRecord, RobotRecord
from relay_protocol.errors import NotFound
from relay_protocol.limits import ENROLMENT_SECONDS
from relay_server.realms.changes import GROUP_MARK, NotInGroup, numbers
from relay_server.realms.realm_change import (
    ANYTHING,
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

NO_RIGHT = "there is no such right; what comes by a group, or of administration, is another"

# --- robots -----------------------------------------------------------------------------------------------


def robots(s: Session, realm: str, listing: PageQuery) -> dict[str, Any]:
    """A page of them, enrolled or not."""
    found, behind = listing.page({each.name: each for each in queries.list_robots(s, realm)}, no_types)
    keys = queries.count_live_keys(s, [each.id for _, each in found])
    return {"robots": [_robot(each, keys.get(each.id, 0), realm) for _, each in found], "next": behind}


def robot(s: Session, realm: str, name: str) -> dict[str, Any]:
    """:raises NotFound: no such robot"""
    found = robot_in(s, realm, name)
    return _robot(found, queries.count_live_keys(s, [found.id]).get(found.id, 0), realm)


def number(s: Session, realm: str, name: str) -> int:
    """:raises NotFound: no such robot"""
    return robot_in(s, realm, name).id


def add_robot(change: RealmChangeTransaction, name: str, description: str) -> dict[str, Any]:
    """:raises Invalid: name or description can't be
    :raises Taken: there is one of this name
    :raises NoRoom: there are too many
    """
    if queries.find_robot(change.session, name, change.realm) is not None:
        raise AlreadyExists(f"there is a robot '{name}' already")
    change.see_room("robots")
    added, code = change.add_robot(name, change.realm, description)
    return {**_robot(added, 0, change.realm), **_enrolment(code)}


def change_robot(
    change: RealmChangeTransaction, name: str, description: str | None, seen: Precondition = ANYTHING
) -> dict[str, Any]:
    """What is ``None`` stays as it is.

    :raises NotFound: no such robot
    :raises NotAsBefore: it is not as was seen
    :raises Invalid: the description can't be
    :raises Refused: it is a robot of another realm
    """
    found = change.home_robot(name)
    keys = queries.count_live_keys(change.session, [found.id]).get(found.id, 0)
    seen.check(_robot(found, keys, change.realm))
    if description is not None and description != found.description:
        found = change.describe_robot(found, description)
    return _robot(found, keys, change.realm)


def new_code(change: RealmChangeTransaction, name: str) -> dict[str, Any]:
    """:raises NotFound: no such robot
    :raises Refused: it is a robot of another realm
    """
    found = change.home_robot(name)
    return {"robot": found.name, **_enrolment(change.new_code(found))}


def remove_robot(change: RealmChangeTransaction, name: str, recordings: int) -> None:
    """:param recordings: how many are kept of it
    :raises NotFound: no such robot
    :raises Refused: it is a robot of another realm
    """
    change.remove_robot(change.home_robot(name), recordings)


def _robot(record: RobotRecord, keys: int, realm: str) -> dict[str, Any]:
    told = {"robot": record.name, "description": record.description}
    return {**told, "keys": keys, "guest": record.realm != realm}


def _enrolment(code: str) -> dict[str, Any]:
    return {"enrolment_code": code, "expires_in": ENROLMENT_SECONDS}


# --- keys -------------------------------------------------------------------------------------------------


def keys(s: Session, realm: str, name: str, listing: PageQuery) -> dict[str, Any]:
    """A page of all that a robot ever handed in.

    :raises NotFound: no such robot
    """
    known = queries.list_keys(s, home_robot_in(s, realm, name).id)
    found, behind = listing.page({each.fingerprint: each for each in known}, no_types)
    return {"keys": [each._asdict() for _, each in found], "next": behind}


def revoke_key(change: RealmChangeTransaction, name: str, fingerprint: str) -> None:
    """:raises NotFound: no such robot, or it has no such live key
    :raises Refused: it is a robot of another realm
    """
    change.revoke_key(change.home_robot(name), fingerprint)


# --- groups -----------------------------------------------------------------------------------------------


def groups(s: Session, realm: str, listing: PageQuery) -> dict[str, Any]:
    """A page of groups of robots, with what is in them."""
    found, behind = listing.page(queries.robot_group_names(s, realm), no_types)
    members = queries.robots_of_groups(s, [number for _, number in found])
    return {"robot_groups": [_group(name, members[number]) for name, number in found], "next": behind}


def group(s: Session, realm: str, name: str) -> dict[str, Any]:
    """:raises NotFound: no such group of robots"""
    found = robot_group_in(s, realm, name)
    return _group(found.name, found.robots)


def add_group(change: RealmChangeTransaction, name: str) -> dict[str, Any]:
    """:raises Invalid: the name can't be
    :raises Taken: there is one of this name
    :raises NoRoom: there are too many
    """
    name = new_name(name, "group")
    if queries.find_robot_group(change.session, name, change.realm) is not None:
        raise AlreadyExists(f"there is a group of robots '{name}' already")
    change.see_room("robot_groups")
    return _group(change.fill_robot_group(name, change.realm).name, ())


def remove_group(change: RealmChangeTransaction, name: str) -> None:
    """:raises NotFound: no such group of robots"""
    change.remove_robot_group(change.robot_group(name))


def join(change: RealmChangeTransaction, name: str, robot: str) -> None:
    """:raises NotFound: no such group of robots, or no such robot
    :raises NoRoom: too many are in groups
    """
    found, member = change.robot_group(name), change.robot(robot)
    if member.name not in found.robots:
        change.see_room("robot_memberships")
        change.fill_robot_group(found.name, change.realm, [member])


def leave(change: RealmChangeTransaction, name: str, robot: str) -> None:
    """:raises NotFound: no such group of robots, no such robot, or it is not in it"""
    found, member = change.robot_group(name), change.robot(robot)
    try:
        change.empty_robot_group(found, [member])
    except NotInGroup:
        raise NotFound("the robot is not in this group") from None


def _group(name: str, robots: Sequence[str]) -> dict[str, Any]:
    return {"group": name, "robots": list(robots)}


# --- rights -----------------------------------------------------------------------------------------------


def rights(s: Session, realm: str, listing: PageQuery, robot: str | None, user: str | None) -> dict[str, Any]:
    """A page of rights as they were given, in the order of their addresses.

    :param robot: only those on this one
    :param user: only those of this one, also through groups
    :raises NotFound: no such robot or user
    """
    places = queries.right_places(
        s,
        realm,
        robot_id=None if robot is None else robot_in(s, realm, robot).id,
        user_id=None if user is None else user_in(s, realm, user).id,
    )
    page, behind = listing.page({f"{each.robot}/{_holder(each)}": each.id for each in places}, no_types)
    found = {each.id: each for each in queries.list_rights(s, ids=[id for _, id in page])}
    return {"rights": [_told(found[id]) for _, id in page], "next": behind}


def right(s: Session, realm: str, robot: str, holder: str) -> dict[str, Any]:
    """The right that a holder has on a robot.

    :raises NotFound: no such robot, user or group, or no such right
    """
    found = robot_in(s, realm, robot)
    held = queries.right_held(s, found.id, **numbers(holder_in(s, realm, holder)))
    if held is None:
        raise NotFound(NO_RIGHT)
    return _told(held)


def grant(
    change: RealmChangeTransaction,
    robot: str,
    holder: str,
    level: str,
    allow: Sequence[str],
    deny: Sequence[str],
    seen: Precondition = ANYTHING,
) -> tuple[dict[str, Any], bool]:
    """Give a right, and whether the holder had none on the robot. One that it has already is left as it is.

    :raises NotFound: no such robot, user or group
    :raises NotAsBefore: what the holder has there is not as was seen
    :raises Invalid: a pattern that is none
    :raises NoRoom: there are too many
    :raises Refused: the token in use is for less than all
    """
    change.needs_whole()
    found, whose = change.robot(robot), change.holder(holder)
    mark = GROUP_MARK if isinstance(whose, GroupRecord) else ""
    told = _right(found.name, f"{mark}{whose.name}", level, allow, deny)
    held = queries.right_held(change.session, found.id, **numbers(whose))
    seen.check(None if held is None else _told(held))
    if held is not None and _told(held) == told:
        return told, False
    if held is None:
        change.see_room("rights")
    before = 0 if held is None else len(held.allow) + len(held.deny)
    change.see_room_for_patterns(found, len(allow) + len(deny) - before)
    change.grant(found, whose, level, allow, deny)
    return told, held is None


def revoke(change: RealmChangeTransaction, robot: str, holder: str) -> None:
    """:raises NotFound: no such robot, user or group, or no such right
    :raises Refused: the token in use is for less than all
    """
    change.needs_whole()
    if not change.revoke(change.robot(robot), change.holder(holder)):
        raise NotFound(NO_RIGHT)


def _holder(record: RightRecord | RightOnRobot) -> str:
    return f"{GROUP_MARK}{record.group}" if record.user is None else record.user


def _told(record: RightRecord) -> dict[str, Any]:
    return _right(record.robot, _holder(record), str(record.level), record.allow, record.deny)


def _right(robot: str, holder: str, level: str, allow: Sequence[str], deny: Sequence[str]) -> dict[str, Any]:
    told = {"holder": holder, "robot": robot, "level": level}
    return {**told, "allow": list(allow), "deny": list(deny)}
