"""What people should know of robots, and how they are told."""

from __future__ import annotations

from sqlalchemy import CheckConstraint, Index, String, Text
from sqlalchemy.orm import Mapped, mapped_column

from relay_db.base import Base, JsonText
from relay_db.models.columns import NO_REUSE, Key, Label, Name, Seconds, owned_by


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
    robot_id: Mapped[int] = owned_by("robot.id", index=False)
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
        NO_REUSE,
    )

    id: Mapped[Key]
    user_id: Mapped[int] = owned_by("user_account.id")
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
