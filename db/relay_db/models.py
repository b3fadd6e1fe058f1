"""The tables. Rows hold constraints; rules live in the queries and above.

Times are Unix seconds. Numbers of rows are never given out twice (AUTOINCREMENT on SQLite): an open session
remembers its token by number, and a new token must not inherit it.

No secret is stored: tokens and enrolment codes as SHA-256 in hex, passwords as argon2id, of robot keys the
public half only. Rules of alerts are the exception: what signs a message, or sends one, must be at hand.
"""

from __future__ import annotations

from typing import Annotated, Any

from sqlalchemy import CheckConstraint, Double, ForeignKey, Index, LargeBinary, String, Text, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from relay_db.base import Base, JsonText
from relay_protocol.limits import ROBOT_NAME

NAME = 63
"""Longest name of a realm, user or group, in characters."""

LABEL = 255
"""Longest free text for people (labels, descriptions, targets of audit entries), in characters."""

Key = Annotated[int, mapped_column(primary_key=True)]
Name = Annotated[str, mapped_column(String(NAME))]
Label = Annotated[str, mapped_column(String(LABEL))]
Seconds = Annotated[float, mapped_column(Double)]
Digest = Annotated[str, mapped_column(String(64))]
"""A SHA-256 in hex."""

_NO_REUSE = {"sqlite_autoincrement": True}


def _owned_by(column: str, *, index: bool = True) -> Any:
    """A foreign key whose rows go with what they belong to.

    :param index: false where a unique constraint begins with the column
    """
    return mapped_column(ForeignKey(column, ondelete="CASCADE"), index=index)


class Realm(Base):
    """A world of its own: users, groups and robots of one realm never see another's."""

    __tablename__ = "realm"
    __table_args__ = (UniqueConstraint("name"), _NO_REUSE)

    id: Mapped[Key]
    name: Mapped[Name]


class User(Base):
    """A person, or a program acting as one. Without a password only tokens let it in."""

    __tablename__ = "user_account"
    __table_args__ = (UniqueConstraint("realm_id", "name"), _NO_REUSE)

    id: Mapped[Key]
    realm_id: Mapped[int] = mapped_column(ForeignKey("realm.id", ondelete="RESTRICT"))
    name: Mapped[Name]
    password_hash: Mapped[Label | None]
    admin: Mapped[bool]
    disabled: Mapped[bool]


class Group(Base):
    """Users that get rights together."""

    __tablename__ = "user_group"
    __table_args__ = (UniqueConstraint("realm_id", "name"), _NO_REUSE)

    id: Mapped[Key]
    realm_id: Mapped[int] = mapped_column(ForeignKey("realm.id", ondelete="RESTRICT"))
    name: Mapped[Name]


class Membership(Base):
    """A user is in a group."""

    __tablename__ = "membership"

    group_id: Mapped[int] = mapped_column(ForeignKey("user_group.id", ondelete="CASCADE"), primary_key=True)
    user_id: Mapped[int] = mapped_column(
        ForeignKey("user_account.id", ondelete="CASCADE"), primary_key=True, index=True
    )


class Robot(Base):
    """A robot that may dial in, once a key of it is enrolled."""

    __tablename__ = "robot"
    __table_args__ = (UniqueConstraint("realm_id", "name"), _NO_REUSE)

    id: Mapped[Key]
    realm_id: Mapped[int] = mapped_column(ForeignKey("realm.id", ondelete="RESTRICT"))
    name: Mapped[str] = mapped_column(String(ROBOT_NAME))
    description: Mapped[Label]


class RobotGroup(Base):
    """Robots to which one order can be given. It gives nobody a right."""

    __tablename__ = "robot_group"
    __table_args__ = (UniqueConstraint("realm_id", "name"), _NO_REUSE)

    id: Mapped[Key]
    realm_id: Mapped[int] = mapped_column(ForeignKey("realm.id", ondelete="RESTRICT"))
    name: Mapped[Name]


class RobotMembership(Base):
    """A robot is in a group."""

    __tablename__ = "robot_membership"

    group_id: Mapped[int] = mapped_column(ForeignKey("robot_group.id", ondelete="CASCADE"), primary_key=True)
    robot_id: Mapped[int] = mapped_column(
        ForeignKey("robot.id", ondelete="CASCADE"), primary_key=True, index=True
    )


class RobotKey(Base):
    """The public half of a key of a robot; live until it is retired."""

    __tablename__ = "robot_key"
    __table_args__ = (
        UniqueConstraint("robot_id", "fingerprint"),
        CheckConstraint("length(public_key) = 32", name="public_key"),
        _NO_REUSE,
    )

    id: Mapped[Key]
    robot_id: Mapped[int] = _owned_by("robot.id", index=False)
    public_key: Mapped[bytes] = mapped_column(LargeBinary(32))
    fingerprint: Mapped[Digest]
    agent: Mapped[Label]
    created: Mapped[Seconds]
    retired: Mapped[Seconds | None]


class EnrolmentCode(Base):
    """Lets a robot hand in a key, once, until it expires."""

    __tablename__ = "enrolment_code"
    __table_args__ = (
        UniqueConstraint("code_hash"),
        CheckConstraint("length(code_hash) = 64", name="code_hash"),
        _NO_REUSE,
    )

    id: Mapped[Key]
    robot_id: Mapped[int] = _owned_by("robot.id")
    code_hash: Mapped[Digest]
    expires: Mapped[Seconds]
    used: Mapped[Seconds | None]


class Right(Base):
    """What a user or a group may do on a robot."""

    __tablename__ = "robot_right"
    __table_args__ = (
        UniqueConstraint("robot_id", "user_id"),
        UniqueConstraint("robot_id", "group_id"),
        CheckConstraint("level IN ('viewer', 'operator', 'owner')", name="level"),
        CheckConstraint("(user_id IS NULL) <> (group_id IS NULL)", name="one_holder"),
        _NO_REUSE,
    )

    id: Mapped[Key]
    robot_id: Mapped[int] = _owned_by("robot.id", index=False)
    user_id: Mapped[int | None] = _owned_by("user_account.id")
    group_id: Mapped[int | None] = _owned_by("user_group.id")
    level: Mapped[str] = mapped_column(String(16))
    allow: Mapped[list[str]] = mapped_column(JsonText)
    deny: Mapped[list[str]] = mapped_column(JsonText)


class AccessToken(Base):
    """Lets its bearer act as a user: for programs (access), a browser (session), or once (login)."""

    __tablename__ = "access_token"
    __table_args__ = (
        UniqueConstraint("token_hash"),
        CheckConstraint("kind IN ('access', 'session', 'login')", name="kind"),
        CheckConstraint("length(token_hash) = 64", name="token_hash"),
        _NO_REUSE,
    )

    id: Mapped[Key]
    user_id: Mapped[int] = _owned_by("user_account.id")
    token_hash: Mapped[Digest]
    kind: Mapped[str] = mapped_column(String(16))
    label: Mapped[Label]
    created: Mapped[Seconds]
    expires: Mapped[Seconds | None]


class Event(Base):
    """Something that happened, worth remembering for a while."""

    __tablename__ = "event"
    __table_args__ = (
        Index(None, "robot_id", "id"),
        Index(None, "at"),
        CheckConstraint("kind <> ''", name="kind"),
        _NO_REUSE,
    )

    id: Mapped[Key]
    at: Mapped[Seconds]
    kind: Mapped[Name]
    source: Mapped[Label]
    robot_id: Mapped[int | None] = mapped_column(ForeignKey("robot.id", ondelete="SET NULL"))
    user_id: Mapped[int | None] = mapped_column(
        ForeignKey("user_account.id", ondelete="SET NULL"), index=True
    )
    data: Mapped[dict[str, Any]] = mapped_column(JsonText)


class AuditEntry(Base):
    """Who did what when from where; triggers refuse to change or remove it.

    Names stand as text, not as keys: an entry outlives whom it tells of.
    """

    __tablename__ = "audit_entry"
    __table_args__ = (CheckConstraint("length(hash) = 64", name="hash"),)

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    at: Mapped[Seconds]
    actor: Mapped[Label]
    action: Mapped[Name]
    target: Mapped[Label]
    origin: Mapped[Label]
    data: Mapped[dict[str, Any]] = mapped_column(JsonText)
    hash: Mapped[Digest]


class StopOrder(Base):
    """A robot is to stop and has not confirmed it yet: it is told as soon as it is there."""

    __tablename__ = "stop_order"

    robot_id: Mapped[int] = mapped_column(
        ForeignKey("robot.id", ondelete="CASCADE"), primary_key=True, autoincrement=False
    )
    by: Mapped[Label]
    why: Mapped[str] = mapped_column(Text)
    at: Mapped[Seconds]


class Alert(Base):
    """What people should know of a robot; all that was told of the same while it lasted is one row."""

    __tablename__ = "alert"
    __table_args__ = (
        Index(None, "robot_id", "last_at"),
        Index(None, "last_at"),
        Index(None, "over_at"),
        CheckConstraint("level IN ('info', 'warning', 'error')", name="level"),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    robot_id: Mapped[int] = _owned_by("robot.id", index=False)
    kind: Mapped[Name]
    about: Mapped[Label]
    level: Mapped[str] = mapped_column(String(16))
    text: Mapped[str] = mapped_column(Text)
    first_at: Mapped[Seconds]
    last_at: Mapped[Seconds]
    times: Mapped[int]
    news: Mapped[int]
    over_at: Mapped[Seconds | None]
    ack_by: Mapped[Label | None]
    ack_at: Mapped[Seconds | None]


class AlertRule(Base):
    """Which alerts a user is told of, when, and by which way."""

    __tablename__ = "alert_rule"
    __table_args__ = (
        CheckConstraint("channel IN ('portal', 'webhook', 'apprise')", name="channel"),
        CheckConstraint("level IN ('info', 'warning', 'error')", name="level"),
        _NO_REUSE,
    )

    id: Mapped[Key]
    user_id: Mapped[int] = _owned_by("user_account.id")
    label: Mapped[Label]
    robots: Mapped[Label]
    kinds: Mapped[list[str]] = mapped_column(JsonText)
    level: Mapped[str] = mapped_column(String(16))
    channel: Mapped[str] = mapped_column(String(16))
    url: Mapped[str] = mapped_column(Text)
    secret: Mapped[Label]
    over: Mapped[bool]
    group_s: Mapped[Seconds]
    quiet: Mapped[dict[str, str] | None] = mapped_column(JsonText)
    created: Mapped[Seconds]


class Revision(Base):
    """The one row that tells whether anything about access changed, and where the audit chain ends.

    Without the end of the chain, cutting off the last entries would leave a chain that verifies.
    """

    __tablename__ = "revision"
    __table_args__ = (CheckConstraint("id = 1", name="one_row"),)

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    number: Mapped[int]
    audit_id: Mapped[int]
    audit_hash: Mapped[Digest]
