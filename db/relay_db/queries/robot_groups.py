"""Groups of robots, to which one order can be given. They give nobody a right."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection

from sqlalchemy import delete, insert, select
from sqlalchemy.orm import Session

from relay_db.models import Realm, Robot, RobotGroup, RobotMembership
from relay_db.names import normal_name, normalise
from relay_db.queries.realms import realm_id, robot_is_of
from relay_db.queries.records import RobotGroupRecord
from relay_protocol.errors import Invalid, NotFound
from relay_protocol.realms import DEFAULT_REALM, full_name


def find_robot_group(s: Session, name: str, realm: str = DEFAULT_REALM) -> RobotGroupRecord | None:
    """The group of robots of that name, in whatever case it is written."""
    row = s.execute(
        select(RobotGroup.id, RobotGroup.name, Realm.name)
        .join(Realm, Realm.id == RobotGroup.realm_id)
        .where(RobotGroup.name == normalise(name), Realm.name == normalise(realm))
    ).one_or_none()
    return (
        None
        if row is None
        else RobotGroupRecord(row[0], row[1], row[2], robots_of_groups(s, [row[0]])[row[0]])
    )


def list_robot_groups(s: Session, realm: str | None = None) -> list[RobotGroupRecord]:
    """All groups of robots, of one realm or of all, by name."""
    query = (
        select(RobotGroup.id, RobotGroup.name, Realm.name)
        .join(Realm, Realm.id == RobotGroup.realm_id)
        .order_by(RobotGroup.name)
    )
    if realm is not None:
        query = query.where(Realm.name == normalise(realm))
    robots = robots_of_groups(s)
    return [RobotGroupRecord(id, name, where, robots[id]) for id, name, where in s.execute(query).all()]


def robot_group_names(s: Session, realm: str) -> dict[str, int]:
    """The groups of robots of a realm: numbers by name."""
    rows = s.execute(
        select(RobotGroup.name, RobotGroup.id)
        .join(Realm, Realm.id == RobotGroup.realm_id)
        .where(Realm.name == normalise(realm))
    )
    return {row.name: row.id for row in rows}


def add_robot_group(s: Session, name: str, realm: str = DEFAULT_REALM) -> RobotGroupRecord:
    """:raises Invalid: the name can't be, or is taken
    :raises NotFound: no such realm
    """
    name, realm = normal_name(name, "name of a group"), normalise(realm)
    if find_robot_group(s, name, realm) is not None:
        raise Invalid(f"there is a group of robots '{full_name(name, realm)}' already")
    group_id = s.scalars(
        insert(RobotGroup).values(realm_id=realm_id(s, realm), name=name).returning(RobotGroup.id)
    ).one()
    return RobotGroupRecord(group_id, name, realm, ())


def remove_robot_group(s: Session, group_id: int) -> None:
    """Remove a group; its robots stay.

    :raises NotFound: no such group
    """
    if s.scalar(delete(RobotGroup).where(RobotGroup.id == group_id).returning(RobotGroup.id)) is None:
        raise NotFound("there is no such group of robots")


def add_to_robot_group(s: Session, group_id: int, robot_id: int) -> None:
    """Put a robot into a group; nothing happens if it is in it.

    :raises NotFound: no such group or robot
    :raises Invalid: they are of different realms
    """
    group_realm = s.scalar(select(RobotGroup.realm_id).where(RobotGroup.id == group_id))
    if group_realm is None or s.scalar(select(Robot.id).where(Robot.id == robot_id)) is None:
        raise NotFound("there is no such group or robot")
    if not robot_is_of(s, robot_id, group_realm):
        raise Invalid("the robot is not of the realm of the group")
    pair = (RobotMembership.group_id == group_id) & (RobotMembership.robot_id == robot_id)
    if s.scalar(select(RobotMembership.robot_id).where(pair)) is None:
        s.execute(insert(RobotMembership).values(group_id=group_id, robot_id=robot_id))


def remove_from_robot_group(s: Session, group_id: int, robot_id: int) -> bool:
    """Take a robot out of a group; false if it was not in it."""
    pair = (RobotMembership.group_id == group_id) & (RobotMembership.robot_id == robot_id)
    return s.scalar(delete(RobotMembership).where(pair).returning(RobotMembership.robot_id)) is not None


def robots_of_groups(
    s: Session, group_ids: Collection[int] | None = None
) -> defaultdict[int, tuple[str, ...]]:
    """The names of the robots of each group, or of some, by the number of the group."""
    query = (
        select(RobotMembership.group_id, Robot.name)
        .join(Robot, Robot.id == RobotMembership.robot_id)
        .order_by(Robot.name)
    )
    if group_ids is not None:
        query = query.where(RobotMembership.group_id.in_(group_ids))
    found: defaultdict[int, tuple[str, ...]] = defaultdict(tuple)
    for id, name in s.execute(query):
        found[id] += (name,)
    return found
