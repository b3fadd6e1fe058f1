"""What services and applications say of themselves."""

from __future__ import annotations

from sqlalchemy import CheckConstraint, ForeignKey, Index, String, Text
from sqlalchemy.orm import Mapped, mapped_column

from relay_db.base import Base
from relay_db.models.columns import SOURCE, Label, Name, Seconds, owned_by


class DirectoryEntry(Base):
    """A service or an application that was registered, for as long as its lease is renewed.

    ``data`` is JSON as it is told, ``ttl`` the length of the lease in seconds. It goes with who registered it and with
    the robot it is about.
    """

    __tablename__ = "directory_entry"
    __table_args__ = (
        Index(None, "realm_id", "kind", "name"),
        Index(None, "expires"),
        CheckConstraint("kind <> ''", name="kind"),
        CheckConstraint("ttl > 0", name="ttl"),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    realm_id: Mapped[int] = mapped_column(ForeignKey("realm.id", ondelete="RESTRICT"))
    user_id: Mapped[int] = owned_by("user_account.id")
    robot_id: Mapped[int | None] = owned_by("robot.id")
    kind: Mapped[Name]
    name: Mapped[str] = mapped_column(String(SOURCE))
    address: Mapped[str] = mapped_column(Text)
    description: Mapped[Label]
    data: Mapped[str] = mapped_column(Text)
    ttl: Mapped[Seconds]
    registered: Mapped[Seconds]
    expires: Mapped[Seconds]
