"""What queries answer with. Nothing here is tied to a session."""

from __future__ import annotations

from typing import Any, NamedTuple

from relay_protocol.rights import Level


class RealmRecord(NamedTuple):
    """A realm."""

    id: int
    name: str


class UserRecord(NamedTuple):
    """A user; ``password_hash`` is None for one that only tokens let in."""

    id: int
    name: str
    realm: str
    admin: bool
    disabled: bool
    password_hash: str | None


class GroupRecord(NamedTuple):
    """A group and the names of its members."""

    id: int
    name: str
    realm: str
    members: tuple[str, ...]


class RobotRecord(NamedTuple):
    """A robot."""

    id: int
    name: str
    realm: str
    description: str


class RobotKeyRecord(NamedTuple):
    """A live key of a robot: 32 raw bytes of Ed25519."""

    robot_id: int
    robot: str
    realm: str
    public_key: bytes


class KeyRecord(NamedTuple):
    """A key of a robot as people see it; ``retired`` is None while it is live."""

    fingerprint: str
    agent: str
    created: float
    retired: float | None


class RightRecord(NamedTuple):
    """A right: exactly one of ``user`` and ``group`` is a name."""

    id: int
    robot_id: int
    robot: str
    user: str | None
    group: str | None
    level: Level
    allow: tuple[str, ...]
    deny: tuple[str, ...]


class PrincipalRecord(NamedTuple):
    """Who a token stands for; ``expires`` is the token's end, None for never."""

    user_id: int
    name: str
    realm: str
    admin: bool
    token_id: int
    expires: float | None


class TokenRecord(NamedTuple):
    """A token as people see it, without anything that could be used as one."""

    id: int
    user_id: int
    user: str
    kind: str
    label: str
    created: float
    expires: float | None


class EventRecord(NamedTuple):
    """Something that happened."""

    id: int
    at: float
    kind: str
    source: str
    robot_id: int | None
    user_id: int | None
    data: dict[str, Any]


class AuditRecord(NamedTuple):
    """Who did what when from where."""

    id: int
    at: float
    actor: str
    action: str
    target: str
    origin: str
    data: dict[str, Any]
    hash: str
