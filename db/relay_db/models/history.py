"""What happened, and how far what is remembered has changed."""

from __future__ import annotations

from typing import Any

from sqlalchemy import BigInteger, CheckConstraint, ForeignKey, Index, String, Text
from sqlalchemy.orm import Mapped, mapped_column

from relay_db.base import Base, JsonText
from relay_db.models.columns import NO_REUSE, SOURCE, Digest, Key, Label, Name, Seconds


class Event(Base):
    """Something that happened, worth remembering for a while."""

    __tablename__ = "event"
    __table_args__ = (
        Index(None, "robot_id", "id"),
        Index(None, "at"),
        CheckConstraint("kind <> ''", name="kind"),
        NO_REUSE,
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


class StoredEvent(Base):
    """An event of the short-term memory, numbered within its realm: nobody learns by it how much others do.

    ``data`` is JSON as it is told. The names of users stand as text, robots as numbers that are never given out twice:
    an event is written without asking who is still there, and what is about a robot that is gone nobody may see.
    """

    __tablename__ = "memory"
    __table_args__ = (
        Index("ix_memory_at", "realm_id", "at", "number"),
        Index("ix_memory_source", "realm_id", "source", "at", "number"),
        Index("ix_memory_kind", "realm_id", "kind", "at", "number"),
        Index("ix_memory_user", "realm_id", "user_name", "at", "number"),
        Index("ix_memory_robot", "realm_id", "robot_id", "at", "number"),
        CheckConstraint("kind <> ''", name="kind"),
    )

    realm_id: Mapped[int] = mapped_column(
        ForeignKey("realm.id", ondelete="RESTRICT"), primary_key=True, autoincrement=False
    )
    number: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    at: Mapped[Seconds]
    source: Mapped[str] = mapped_column(String(SOURCE))
    kind: Mapped[Name]
    robot_id: Mapped[int | None]
    user_name: Mapped[Name | None]
    data: Mapped[str] = mapped_column(Text)
    used: Mapped[int]


class StoredEventCount(Base):
    """The number that was given last to an event of a realm's memory, so that none is given twice."""

    __tablename__ = "memory_count"

    realm_id: Mapped[int] = mapped_column(
        ForeignKey("realm.id", ondelete="RESTRICT"), primary_key=True, autoincrement=False
    )
    last: Mapped[int] = mapped_column(BigInteger)


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
