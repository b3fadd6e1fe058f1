"""Robots, their keys, and the codes that let them hand in a key."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

from sqlalchemy import Select, delete, insert, select, update
from sqlalchemy.orm import Session

from relay_db.models import EnrolmentCode, Realm, Robot, RobotKey, RobotRealm
from relay_db.names import findable_hex, label, normalise, sanitise
from relay_db.queries.realms import realm_id
from relay_db.queries.records import KeyRecord, RobotKeyRecord, RobotRecord
from relay_db.queries.state import bump
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_protocol.identity import PUBLIC_KEY_BYTES, check_robot_name
from relay_protocol.realms import DEFAULT_REALM, full_name

LIVE_KEYS = 2
"""Keys of a robot that are good at a time: the one in use, and the one it changes to."""

_PAIRS = 500
"""Keys asked for in one statement."""

_ROUTES = frozenset({"stream"})
"""Names that would be taken for another address of the relay's HTTP interface."""

_REFUSED = (
    "the robot's name or the enrolment code is wrong, or the code was used or has expired; ask for a new one"
)


def find_robot(s: Session, name: str, realm: str = DEFAULT_REALM) -> RobotRecord | None:
    """The robot of that name in a realm, its own or one that it is shared with."""
    if not _possible(name):
        return None
    row = s.execute(_robots_in(realm).where(RobotRealm.name == name)).one_or_none()
    return None if row is None else RobotRecord(*row)


def list_robots(s: Session, realm: str | None = None) -> list[RobotRecord]:
    """All robots, or those of one realm with those that are shared with it, by name."""
    query = _robots() if realm is None else _robots_in(realm)
    return [RobotRecord(*row) for row in s.execute(query.order_by(Robot.name, Realm.name))]


def enrolled_robots(s: Session) -> list[RobotRecord]:
    """Robots of which a key is live: those that may come."""
    live = select(RobotKey.robot_id).where(RobotKey.retired.is_(None))
    query = _robots().where(Robot.id.in_(live)).order_by(Robot.name)
    return [RobotRecord(*row) for row in s.execute(query)]


def add_robot(s: Session, name: str, description: str = "", realm: str = DEFAULT_REALM) -> RobotRecord:
    """:raises Invalid: the name can't be, or is taken
    :raises NotFound: no such realm
    """
    check_robot_name(name)
    if name in _ROUTES:
        raise Invalid(f"a robot can't be called '{name}': that is an address of the relay itself")
    label(description, "description of a robot")
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


def describe_robot(s: Session, robot_id: int, description: str) -> None:
    """Change what a robot is said to be.

    :raises Invalid: the description can't be kept
    :raises NotFound: no such robot
    """
    text = label(description, "description of a robot")
    # Relays remember whom they show which robots.
    bump(s)
    changed = update(Robot).where(Robot.id == robot_id).values(description=text).returning(Robot.id)
    if s.scalar(changed) is None:
        raise NotFound("there is no such robot")


def remove_robot(s: Session, robot_id: int) -> None:
    """Remove a robot with its keys, codes and all rights on it.

    :raises NotFound: no such robot
    """
    bump(s)
    if s.scalar(delete(Robot).where(Robot.id == robot_id).returning(Robot.id)) is None:
        raise NotFound("there is no such robot")


def issue_enrolment_code(s: Session, robot_id: int, code_hash: str, expires: float) -> None:
    """Let the robot hand in a key with this code; codes issued before and not used are void.

    :param code_hash: SHA-256 in hex of the normalised code
    :param expires: Unix seconds
    :raises NotFound: no such robot
    """
    if s.scalar(select(Robot.id).where(Robot.id == robot_id)) is None:
        raise NotFound("there is no such robot")
    s.execute(delete(EnrolmentCode).where(EnrolmentCode.robot_id == robot_id, EnrolmentCode.used.is_(None)))
    s.execute(insert(EnrolmentCode).values(robot_id=robot_id, code_hash=code_hash, expires=expires))


class _EnrolmentCode(NamedTuple):
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
    """Spend a code and make the key live; a third live key retires the oldest.

    :param agent: what the robot says it runs, for people
    :raises Refused: robot unknown, or code wrong, used or expired: always the same sentence
    :raises Invalid: not an Ed25519 public key, or one that was retired
    """
    if len(public_key) != PUBLIC_KEY_BYTES:
        raise Invalid(f"the public key must have {PUBLIC_KEY_BYTES} bytes (Ed25519)")
    robot = find_robot(s, robot_name, realm)
    if robot is not None and robot.realm != normalise(realm):
        # Keys are handed in under the name of its own realm.
        robot = None
    spent = s.scalar(
        update(EnrolmentCode)
        .where(
            EnrolmentCode.robot_id == (-1 if robot is None else robot.id),
            EnrolmentCode.code_hash == findable_hex(code_hash),
            EnrolmentCode.used.is_(None),
            EnrolmentCode.expires > now,
        )
        .values(used=now)
        .returning(EnrolmentCode.id)
    )
    if robot is None or spent is None:
        raise Refused(_REFUSED)
    bump(s)
    _make_live(s, robot, _EnrolmentCode(public_key, fingerprint, sanitise(agent)), now)
    return robot


def robot_key(
    s: Session, robot_name: str, fingerprint: str, realm: str = DEFAULT_REALM
) -> RobotKeyRecord | None:
    """The live key of that fingerprint, if the robot has it."""
    if not _possible(robot_name):
        return None
    row = s.execute(
        select(Robot.id, Robot.name, Realm.name, RobotKey.public_key)
        .join(Realm, Realm.id == Robot.realm_id)
        .join(RobotKey, RobotKey.robot_id == Robot.id)
        .where(
            Robot.name == robot_name,
            Realm.name == normalise(realm),
            RobotKey.fingerprint == findable_hex(fingerprint),
            RobotKey.retired.is_(None),
        )
    ).one_or_none()
    return None if row is None else RobotKeyRecord(*row)


def live_keys(s: Session, pairs: Collection[tuple[int, str]]) -> set[tuple[int, str]]:
    """Which of these keys are live.

    :param pairs: a robot's number and the fingerprint of its key, each
    """
    found: set[tuple[int, str]] = set()
    asked = list(pairs)
    for first in range(0, len(asked), _PAIRS):
        robots = {robot_id for robot_id, _ in asked[first : first + _PAIRS]}
        query = select(RobotKey.robot_id, RobotKey.fingerprint).where(
            RobotKey.robot_id.in_(robots), RobotKey.retired.is_(None)
        )
        found.update((robot_id, fingerprint) for robot_id, fingerprint in s.execute(query))
    return found & set(asked)


def list_keys(s: Session, robot_id: int) -> list[KeyRecord]:
    """All keys the robot ever handed in, newest first."""
    query = (
        select(RobotKey.fingerprint, RobotKey.agent, RobotKey.created, RobotKey.retired)
        .where(RobotKey.robot_id == robot_id)
        .order_by(RobotKey.id.desc())
    )
    return [KeyRecord(*row) for row in s.execute(query)]


def revoke_key(s: Session, robot_id: int, fingerprint: str, now: float) -> None:
    """Retire a live key for good.

    :raises NotFound: the robot has no such live key
    """
    bump(s)
    live = (
        RobotKey.robot_id == robot_id,
        RobotKey.fingerprint == findable_hex(fingerprint),
        RobotKey.retired.is_(None),
    )
    if s.scalar(update(RobotKey).where(*live).values(retired=now).returning(RobotKey.id)) is None:
        raise NotFound("the robot has no such live key; see its keys for their fingerprints")


def _make_live(s: Session, robot: RobotRecord, key: _EnrolmentCode, now: float) -> None:
    known = s.execute(
        select(RobotKey.id, RobotKey.retired, RobotKey.public_key).where(
            RobotKey.robot_id == robot.id, RobotKey.fingerprint == key.fingerprint
        )
    ).one_or_none()
    if known is not None:
        # The answer to the first try may have been lost on the way: the same key may come again.
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
    return select(Robot.id, Robot.name, Realm.name, Robot.description).join(Realm, Realm.id == Robot.realm_id)


def _robots_in(realm: str) -> Select[int, str, str, str]:
    """Those of a realm, and those that are shared with it."""
    number = select(Realm.id).where(Realm.name == normalise(realm)).scalar_subquery()
    return _robots().join(RobotRealm, RobotRealm.robot_id == Robot.id).where(RobotRealm.realm_id == number)


def _possible(name: str) -> bool:
    """Whether a robot could be called so; what is not text of the database is never sent there."""
    try:
        check_robot_name(name)
    except Invalid:
        return False
    return True
