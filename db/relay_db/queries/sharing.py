"""Robots and users that belong to several realms.

A shared robot has the same name in all its realms, and one link. A user of several realms has an account in each, with
the same name and the password of the first account.
"""

from __future__ import annotations

from collections import defaultdict

from sqlalchemy import delete, insert, or_, select
from sqlalchemy.orm import Session

from relay_db.models import (
    Group,
    LinkedAccount,
    Realm,
    Right,
    Robot,
    RobotGroup,
    RobotMembership,
    RobotRealm,
    ServiceRegistryEntry,
    User,
)
from relay_db.names import normalise
from relay_db.queries.realms import realm_id
from relay_db.queries.records import UserRecord
from relay_db.queries.revision import bump
from relay_db.queries.users import add_user, get_user, home_account
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_protocol.realms import full_name


def share_robot(s: Session, robot_id: int, realm: str) -> None:
    """Share a robot with another realm.

    :raises NotFound: no such robot or realm
    :raises Invalid: it belongs to the realm already, or the realm has another robot of its name
    """
    name = s.scalar(select(Robot.name).where(Robot.id == robot_id))
    if name is None:
        raise NotFound("there is no such robot")
    number = realm_id(s, realm)
    present = s.scalar(
        select(RobotRealm.robot_id).where(RobotRealm.realm_id == number, RobotRealm.name == name)
    )
    if present == robot_id:
        raise Invalid(f"the robot '{name}' belongs to the realm '{normalise(realm)}' already")
    if present is not None:
        raise Invalid(
            f"there is another robot '{full_name(name, normalise(realm))}'; a robot has the same name in all its realms"
        )
    bump(s)
    s.execute(insert(RobotRealm).values(robot_id=robot_id, realm_id=number, name=name))


def unshare_robot(s: Session, robot_id: int, realm: str) -> None:
    """Take a robot out of a realm it is shared with. Its rights, group memberships and registry entries there go too.

    :raises NotFound: no such robot or realm, or the robot does not belong to it
    :raises Refused: it is the robot's own realm
    """
    number = realm_id(s, realm)
    own = s.scalar(select(Robot.realm_id).where(Robot.id == robot_id))
    if own == number:
        raise Refused(f"'{normalise(realm)}' is the robot's own realm; remove the robot instead")
    bump(s)
    # Writers of registry entries about the robot have committed by now, or will find it removed.
    s.execute(select(Realm.id).where(Realm.id == number).with_for_update())
    shared = (RobotRealm.robot_id == robot_id) & (RobotRealm.realm_id == number)
    if s.scalar(delete(RobotRealm).where(shared).returning(RobotRealm.robot_id)) is None:
        raise NotFound(f"the robot does not belong to the realm '{normalise(realm)}'")
    users = select(User.id).where(User.realm_id == number)
    groups = select(Group.id).where(Group.realm_id == number)
    s.execute(
        delete(Right).where(
            Right.robot_id == robot_id, or_(Right.user_id.in_(users), Right.group_id.in_(groups))
        )
    )
    groups_of_robots = select(RobotGroup.id).where(RobotGroup.realm_id == number)
    s.execute(
        delete(RobotMembership).where(
            RobotMembership.robot_id == robot_id, RobotMembership.group_id.in_(groups_of_robots)
        )
    )
    s.execute(
        delete(ServiceRegistryEntry).where(
            ServiceRegistryEntry.robot_id == robot_id, ServiceRegistryEntry.realm_id == number
        )
    )


def robot_shares(s: Session) -> dict[int, frozenset[str]]:
    """The realms that robots are shared with, by the number of the robot. Robots that are not shared are missing."""
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


def add_linked_account(s: Session, user_id: int, realm: str) -> UserRecord:
    """Add an account of a user in another realm, with the same name and without rights.

    :raises NotFound: no such user or realm
    :raises Invalid: the realm has a user of that name
    """
    user = get_user(s, user_id)
    if user is None:
        raise NotFound("there is no such user")
    linked = add_user(s, user.name, None, realm=normalise(realm))
    s.execute(insert(LinkedAccount).values(user_id=linked.id, home_user_id=home_account(s, user_id)))
    added = get_user(s, linked.id)
    assert added is not None
    return added


def linked_account_in(s: Session, user_id: int, realm: str) -> UserRecord | None:
    """The account of a user in a realm, if there is one."""
    home = home_account(s, user_id)
    query = (
        select(User.id)
        .join(Realm, Realm.id == User.realm_id)
        .outerjoin(LinkedAccount, LinkedAccount.user_id == User.id)
        .where(Realm.name == normalise(realm), or_(User.id == home, LinkedAccount.home_user_id == home))
    )
    found = s.scalar(query)
    return None if found is None else get_user(s, found)
