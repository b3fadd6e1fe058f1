"""Robots, groups of robots, keys of robots, and enrolment codes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection
from typing import NamedTuple

from sqlalchemy import Select, delete, insert, select, update
from sqlalchemy.orm import Session

from relay_db.models import EnrolmentCode, Realm, Robot, RobotGroup, RobotKey, RobotMembership, RobotRealm
from relay_db.names import checked_label, normal_name, normalise, normalise_hex, sanitise
from relay_db.queries.realms import groups_with_realm, numbers_by_name, realm_id, robot_in_realm
from relay_db.queries.records import (
    KeyRecord,
    RobotGroupRecord,
    RobotKeyRecord,
    RobotRecord,
    fetch_all,
    fetch_one,
    record_of,
)
from relay_db.queries.revision import bump
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_protocol.identity import PUBLIC_KEY_BYTES, check_robot_name
from relay_protocol.realms import DEFAULT_REALM, full_name

LIVE_KEYS = 2
"""Most live keys of a robot: the current one, and the one that it changes to."""

_BATCH = 500
"""Most keys of one query."""

_ROUTES = frozenset({"stream"})
"""Names that robots cannot have, because they are part of other URLs of the HTTP API."""

_REFUSED = (
    "the robot's name or the enrolment code is wrong, or the code was used or has expired; ask for a new one"
)


def find_robot(s: Session, name: str, realm: str = DEFAULT_REALM) -> RobotRecord | None:
    """The robot of a name in a realm: its own realm, or one that it is shared with."""
    if not _is_robot_name(name):
        return None
    return fetch_one(s, RobotRecord, _robots_in(realm).where(RobotRealm.name == name))


def list_robots(s: Session, realm: str | None = None) -> list[RobotRecord]:
    """All robots, or those of one realm including shared ones, by name."""
    query = _robots() if realm is None else _robots_in(realm)
    return fetch_all(s, RobotRecord, query.order_by(Robot.name, Realm.name))


def enrolled_robots(s: Session) -> list[RobotRecord]:
    """Robots with a live key, which may connect."""
    live = select(RobotKey.robot_id).where(RobotKey.retired.is_(None))
    query = _robots().where(Robot.id.in_(live)).order_by(Robot.name)
    return fetch_all(s, RobotRecord, query)


def add_robot(s: Session, name: str, description: str = "", realm: str = DEFAULT_REALM) -> RobotRecord:
    """:raises Invalid: the name is not valid, or is taken
    :raises NotFound: no such realm
    """
    check_robot_name(name)
    if name in _ROUTES:
        raise Invalid(f"a robot cannot have the name '{name}', which is part of a URL; choose another name")
    checked_label(description, "description of a robot")
    realm = normalise(realm)
    if find_robot(s, name, realm) is not None:
        raise Invalid(f"there is a robot '{full_name(name, realm)}' already")
    bump(s)
    number = realm_id(s, realm)
    robot_id = s.scalars(
        insert(Robot).values(realm_id=number, name=name, description=description).returning(Robot.id)
    ).one()
    s.execute(insert(RobotRealm).values(robot_id=robot_id, realm_id=number, name=name))
    return RobotRecord(robot_id, name, realm, description)


def set_robot_description(s: Session, robot_id: int, description: str) -> None:
    """Change the description of a robot.

    :raises Invalid: the description is not valid
    :raises NotFound: no such robot
    """
    text = checked_label(description, "description of a robot")
    # Relays cache the records of robots.
    bump(s)
    changed = update(Robot).where(Robot.id == robot_id).values(description=text).returning(Robot.id)
    if s.scalar(changed) is None:
        raise NotFound("there is no such robot")


def remove_robot(s: Session, robot_id: int) -> None:
    """Remove a robot with its keys, enrolment codes and all rights on it.

    :raises NotFound: no such robot
    """
    bump(s)
    if s.scalar(delete(Robot).where(Robot.id == robot_id).returning(Robot.id)) is None:
        raise NotFound("there is no such robot")


def issue_enrolment_code(s: Session, robot_id: int, code_hash: str, expires: float) -> None:
    """Store an enrolment code. Earlier codes of the robot that were not used are void.

    :param code_hash: SHA-256 in hex of the normalised code
    :param expires: Unix seconds
    :raises NotFound: no such robot
    """
    if s.scalar(select(Robot.id).where(Robot.id == robot_id)) is None:
        raise NotFound("there is no such robot")
    s.execute(delete(EnrolmentCode).where(EnrolmentCode.robot_id == robot_id, EnrolmentCode.used.is_(None)))
    s.execute(insert(EnrolmentCode).values(robot_id=robot_id, code_hash=code_hash, expires=expires))


class _NewKey(NamedTuple):
    public_key: bytes
    fingerprint: str
    agent: str


def redeem_enrolment_code(
    s: Session,
    robot_name: str,
    code_hash: str,
    public_key: bytes,
    fingerprint: str,
    agent: str,
    now: float,
    realm: str = DEFAULT_REALM,
) -> RobotRecord:
    """Use an enrolment code, and make a key live. Of more than :data:`LIVE_KEYS` the oldest is retired.

    :param agent: the software of the robot, for display
    :raises Refused: robot unknown, or code wrong, used or expired; the message is always the same
    :raises Invalid: not an Ed25519 public key, or one that was retired
    """
    if len(public_key) != PUBLIC_KEY_BYTES:
        raise Invalid(f"the public key must have {PUBLIC_KEY_BYTES} bytes (Ed25519)")
    robot = find_robot(s, robot_name, realm)
    if robot is not None and robot.realm != normalise(realm):
        # A robot enrols with its name in its own realm.
        robot = None
    spent = s.scalar(
        update(EnrolmentCode)
        .where(
            EnrolmentCode.robot_id == (-1 if robot is None else robot.id),
            EnrolmentCode.code_hash == normalise_hex(code_hash),
            EnrolmentCode.used.is_(None),
            EnrolmentCode.expires > now,
        )
        .values(used=now)
        .returning(EnrolmentCode.id)
    )
    if robot is None or spent is None:
        raise Refused(_REFUSED)
    bump(s)
    _make_live(s, robot, _NewKey(public_key, fingerprint, sanitise(agent)), now)
    return robot


def robot_key(
    s: Session, robot_name: str, fingerprint: str, realm: str = DEFAULT_REALM
) -> RobotKeyRecord | None:
    """The live key of a robot with this fingerprint."""
    if not _is_robot_name(robot_name):
        return None
    query = (
        select(RobotKey.robot_id, Robot.name.label("robot"), Realm.name.label("realm"), RobotKey.public_key)
        .join(Realm, Realm.id == Robot.realm_id)
        .join(RobotKey, RobotKey.robot_id == Robot.id)
        .where(
            Robot.name == robot_name,
            Realm.name == normalise(realm),
            RobotKey.fingerprint == normalise_hex(fingerprint),
            RobotKey.retired.is_(None),
        )
    )
    return fetch_one(s, RobotKeyRecord, query)


def live_keys(s: Session, pairs: Collection[tuple[int, str]]) -> set[tuple[int, str]]:
    """The keys among these that are live.

    :param pairs: number of the robot, and fingerprint of the key
    """
    found: set[tuple[int, str]] = set()
    wanted = list(pairs)
    for first in range(0, len(wanted), _BATCH):
        robots = {robot_id for robot_id, _ in wanted[first : first + _BATCH]}
        query = select(RobotKey.robot_id, RobotKey.fingerprint).where(
            RobotKey.robot_id.in_(robots), RobotKey.retired.is_(None)
        )
        found.update((robot_id, fingerprint) for robot_id, fingerprint in s.execute(query))
    return found & set(wanted)


def list_keys(s: Session, robot_id: int) -> list[KeyRecord]:
    """All keys of a robot, retired ones too, newest first."""
    query = (
        select(RobotKey.fingerprint, RobotKey.agent, RobotKey.created, RobotKey.retired)
        .where(RobotKey.robot_id == robot_id)
        .order_by(RobotKey.id.desc())
    )
    return fetch_all(s, KeyRecord, query)


def revoke_key(s: Session, robot_id: int, fingerprint: str, now: float) -> None:
    """Retire a live key for good.

    :raises NotFound: the robot has no such live key
    """
    bump(s)
    live = (
        RobotKey.robot_id == robot_id,
        RobotKey.fingerprint == normalise_hex(fingerprint),
        RobotKey.retired.is_(None),
    )
    if s.scalar(update(RobotKey).where(*live).values(retired=now).returning(RobotKey.id)) is None:
        raise NotFound("the robot has no such live key; see its keys for their fingerprints")


def _make_live(s: Session, robot: RobotRecord, key: _NewKey, now: float) -> None:
    known = s.execute(
        select(RobotKey.id, RobotKey.retired, RobotKey.public_key).where(
            RobotKey.robot_id == robot.id, RobotKey.fingerprint == key.fingerprint
        )
    ).one_or_none()
    if known is not None:
        # A robot that did not receive the answer sends the same key again.
        if known.retired is not None or known.public_key != key.public_key:
            raise Invalid("this key was retired; the robot must make a new one")
        return
    live = s.scalars(
        select(RobotKey.id)
        .where(RobotKey.robot_id == robot.id, RobotKey.retired.is_(None))
        .order_by(RobotKey.id.desc())
        .offset(LIVE_KEYS - 1)
    ).all()
    s.execute(update(RobotKey).where(RobotKey.id.in_(live)).values(retired=now))
    s.execute(insert(RobotKey).values(robot_id=robot.id, created=now, **key._asdict()))


def _robots() -> Select[int, str, str, str]:
    columns = Robot.id, Robot.name, Realm.name.label("realm"), Robot.description
    return select(*columns).join(Realm, Realm.id == Robot.realm_id)


def _robots_in(realm: str) -> Select[int, str, str, str]:
    """Robots of a realm, including shared ones."""
    number = select(Realm.id).where(Realm.name == normalise(realm)).scalar_subquery()
    return _robots().join(RobotRealm, RobotRealm.robot_id == Robot.id).where(RobotRealm.realm_id == number)


def _is_robot_name(name: str) -> bool:
    """Whether a robot could have this name. Other text is not sent to the database, which may fail on it."""
    try:
        check_robot_name(name)
    except Invalid:
        return False
    return True


# --- groups of robots ----------------------------------------------------------------------------------


def find_robot_group(s: Session, name: str, realm: str = DEFAULT_REALM) -> RobotGroupRecord | None:
    """The group of robots of a name, whatever its case."""
    query = groups_with_realm(RobotGroup)
    row = s.execute(
        query.where(RobotGroup.name == normalise(name), Realm.name == normalise(realm))
    ).one_or_none()
    if row is None:
        return None
    return record_of(RobotGroupRecord, row, robots=robots_of_groups(s, [row.id])[row.id])


def list_robot_groups(s: Session, realm: str | None = None) -> list[RobotGroupRecord]:
    """All groups of robots, of one realm or of all, by name."""
    query = groups_with_realm(RobotGroup).order_by(RobotGroup.name)
    if realm is not None:
        query = query.where(Realm.name == normalise(realm))
    robots = robots_of_groups(s)
    return [record_of(RobotGroupRecord, row, robots=robots[row.id]) for row in s.execute(query).all()]


def robot_group_names(s: Session, realm: str) -> dict[str, int]:
    """The numbers of the groups of robots of a realm, by name."""
    return numbers_by_name(s, RobotGroup, realm)


def add_robot_group(s: Session, name: str, realm: str = DEFAULT_REALM) -> RobotGroupRecord:
    """:raises Invalid: the name is not valid, or is taken
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
    """Remove a group of robots. Its robots stay.

    :raises NotFound: no such group
    """
    if s.scalar(delete(RobotGroup).where(RobotGroup.id == group_id).returning(RobotGroup.id)) is None:
        raise NotFound("there is no such group of robots")


def add_to_robot_group(s: Session, group_id: int, robot_id: int) -> None:
    """Put a robot into a group, if it is not in it.

    :raises NotFound: no such group or robot
    :raises Invalid: they belong to different realms
    """
    group_realm = s.scalar(select(RobotGroup.realm_id).where(RobotGroup.id == group_id))
    if group_realm is None or s.scalar(select(Robot.id).where(Robot.id == robot_id)) is None:
        raise NotFound("there is no such group or robot")
    if not robot_in_realm(s, robot_id, group_realm):
        raise Invalid("the robot does not belong to the realm of the group")
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
    """The names of the robots of all groups, or of some, by the number of the group."""
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
