"""Robots, groups of them, their keys, and who may do what on them."""

from __future__ import annotations

from sqlalchemy import CheckConstraint, ForeignKey, LargeBinary, String, Text, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from relay_db.base import Base, JsonText
from relay_db.models.columns import NO_REUSE, Digest, Key, Label, Name, Seconds, owned_by
from relay_protocol.limits import ROBOT_NAME


class Robot(Base):
    """A robot that may dial in, once a key of it is enrolled."""

    __tablename__ = "robot"
    __table_args__ = (UniqueConstraint("realm_id", "name"), NO_REUSE)

    id: Mapped[Key]
    realm_id: Mapped[int] = mapped_column(ForeignKey("realm.id", ondelete="RESTRICT"))
    name: Mapped[str] = mapped_column(String(ROBOT_NAME))
    description: Mapped[Label]


class RobotRealm(Base):
    """A robot is of a realm, under its one name: of its own, where it was added, and of any it is shared with."""

    __tablename__ = "robot_realm"
    __table_args__ = (UniqueConstraint("realm_id", "name"),)

    robot_id: Mapped[int] = mapped_column(
        ForeignKey("robot.id", ondelete="CASCADE"), primary_key=True, autoincrement=False
    )
    realm_id: Mapped[int] = mapped_column(
        ForeignKey("realm.id", ondelete="RESTRICT"), primary_key=True, autoincrement=False
    )
    name: Mapped[str] = mapped_column(String(ROBOT_NAME))


class RobotGroup(Base):
    """Robots to which one order can be given. It gives nobody a right."""

    __tablename__ = "robot_group"
    __table_args__ = (UniqueConstraint("realm_id", "name"), NO_REUSE)

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
        NO_REUSE,
    )

    id: Mapped[Key]
    robot_id: Mapped[int] = owned_by("robot.id", index=False)
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
        NO_REUSE,
    )

    id: Mapped[Key]
    robot_id: Mapped[int] = owned_by("robot.id")
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
        NO_REUSE,
    )

    id: Mapped[Key]
    robot_id: Mapped[int] = owned_by("robot.id", index=False)
    user_id: Mapped[int | None] = owned_by("user_account.id")
    group_id: Mapped[int | None] = owned_by("user_group.id")
    level: Mapped[str] = mapped_column(String(16))
    allow: Mapped[list[str]] = mapped_column(JsonText)
    deny: Mapped[list[str]] = mapped_column(JsonText)


class StopOrder(Base):
    """A robot is to stop and has not confirmed it yet: it is told as soon as it is there."""

    __tablename__ = "stop_order"

    robot_id: Mapped[int] = mapped_column(
        ForeignKey("robot.id", ondelete="CASCADE"), primary_key=True, autoincrement=False
    )
    by: Mapped[Label]
    why: Mapped[str] = mapped_column(Text)
    at: Mapped[Seconds]
