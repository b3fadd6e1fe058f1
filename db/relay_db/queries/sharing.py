"""Robots and users that are of several realms.

A robot has one name in all of its realms, and one link; in each of them it is a robot like any other. A person who is
of several realms has an account in each, under one name and with one password: that of the account he had first.
"""

from __future__ import annotations

from collections import defaultdict

from sqlalchemy import delete, insert, or_, select
from sqlalchemy.orm import Session

from relay_db.models import (
    DirectoryEntry,
    Group,
    LinkedAccount,
    Realm,
    Right,
    Robot,
    RobotGroup,
    RobotMembership,
    RobotRealm,
    User,
)
from relay_db.names import normalise
from relay_db.queries.realms import realm_id
from relay_db.queries.records import UserRecord
from relay_db.queries.state import bump
from relay_db.queries.users import add_user, get_user, home_of
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_protocol.realms import full_name


def share_robot(s: Session, robot_id: int, realm: str) -> None:
    """Make a robot one of another realm too.

    :raises NotFound: no such robot or realm
    :raises Invalid: it is of the realm already, or another of its name is
    """
    name = s.scalar(select(Robot.name).where(Robot.id == robot_id))
    if name is None:
        raise NotFound("there is no such robot")
    number = realm_id(s, realm)
    there = s.scalar(
        select(RobotRealm.robot_id).where(RobotRealm.realm_id == number, RobotRealm.name == name)
    )
    if there == robot_id:
        raise Invalid(f"the robot '{name}' is of the realm '{normalise(realm)}' already")
    if there is not None:
        raise Invalid(
            f"there is another robot '{full_name(name, normalise(realm))}', and a robot has one name in all its realms"
        )
    bump(s)
    s.execute(insert(RobotRealm).values(robot_id=robot_id, realm_id=number, name=name))


def unshare_robot(s: Session, robot_id: int, realm: str) -> None:
    """Take a robot out of a realm it is shared with: with the rights on it that are held there, its places in groups
    there, and what the directory there has of it.

    :raises NotFound: no such robot or realm, or it is not of that
    :raises Refused: it is the robot's own realm
    """
    number = realm_id(s, realm)
    own = s.scalar(select(Robot.realm_id).where(Robot.id == robot_id))
    if own == number:
        raise Refused(
            f"'{normalise(realm)}' is the robot's own realm; only to remove the robot takes it out of that"
        )
    bump(s)
    # Who registers something about the robot there has done so by now, or finds it gone.
    s.execute(select(Realm.id).where(Realm.id == number).with_for_update())
    shared = (RobotRealm.robot_id == robot_id) & (RobotRealm.realm_id == number)
    if s.scalar(delete(RobotRealm).where(shared).returning(RobotRealm.robot_id)) is None:
        raise NotFound(f"the robot is not of the realm '{normalise(realm)}'")
    users = select(User.id).where(User.realm_id == number)
    groups = select(Group.id).where(Group.realm_id == number)
    s.execute(
        delete(Right).where(
            Right.robot_id == robot_id, or_(Right.user_id.in_(users), Right.group_id.in_(groups))
        )
    )
    places = select(RobotGroup.id).where(RobotGroup.realm_id == number)
    s.execute(
        delete(RobotMembership).where(
            RobotMembership.robot_id == robot_id, RobotMembership.group_id.in_(places)
        )
    )
    s.execute(
        delete(DirectoryEntry).where(DirectoryEntry.robot_id == robot_id, DirectoryEntry.realm_id == number)
    )


def robot_shares(s: Session) -> dict[int, frozenset[str]]:
    """The realms that robots are shared with, by the number of the robot; nothing of one that is of its own alone."""
    rows = s.execute(
        select(RobotRealm.robot_id, Realm.name)
        .join(Robot, Robot.id == RobotRealm.robot_id)
        .join(Realm, Realm.id == RobotRealm.realm_id)
        .where(RobotRealm.realm_id != Robot.realm_id)
    )
    found: defaultdict[int, set[str]] = defaultdict(set)
    for robot_id, realm in rows:
        found[robot_id].add(realm)
    return {robot_id: frozenset(realms) for robot_id, realms in found.items()}


def add_guest(s: Session, user_id: int, realm: str) -> UserRecord:
    """Give somebody an account in another realm, under the same name; rights he has none there.

    :raises NotFound: no such user or realm
    :raises Invalid: there is somebody of that name already
    """
    user = get_user(s, user_id)
    if user is None:
        raise NotFound("there is no such user")
    guest = add_user(s, user.name, None, realm=normalise(realm))
    s.execute(insert(LinkedAccount).values(user_id=guest.id, home_id=home_of(s, user_id)))
    made = get_user(s, guest.id)
    assert made is not None
    return made


def account_in(s: Session, user_id: int, realm: str) -> UserRecord | None:
    """The account that a user has in a realm, if it is of that."""
    home = home_of(s, user_id)
    query = (
        select(User.id)
        .join(Realm, Realm.id == User.realm_id)
        .outerjoin(LinkedAccount, LinkedAccount.user_id == User.id)
        .where(Realm.name == normalise(realm), or_(User.id == home, LinkedAccount.home_id == home))
    )
    found = s.scalar(query)
    return None if found is None else get_user(s, found)
