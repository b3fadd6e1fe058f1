"""Realms, users, groups, and what proves them."""

from __future__ import annotations

from sqlalchemy import CheckConstraint, ForeignKey, String, Text, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from relay_db.base import Base
from relay_db.models.columns import NO_REUSE, Digest, Key, Label, Name, Seconds, owned_by


class Realm(Base):
    """A world of its own: users, groups and robots of one realm never see another's."""

    __tablename__ = "realm"
    __table_args__ = (UniqueConstraint("name"), NO_REUSE)

    id: Mapped[Key]
    name: Mapped[Name]
    events_days: Mapped[Seconds | None]


class User(Base):
    """A person, or a program acting as one. Without a password only tokens let it in."""

    __tablename__ = "user_account"
    __table_args__ = (UniqueConstraint("realm_id", "name"), NO_REUSE)

    id: Mapped[Key]
    realm_id: Mapped[int] = mapped_column(ForeignKey("realm.id", ondelete="RESTRICT"))
    name: Mapped[Name]
    password_hash: Mapped[Label | None]
    admin: Mapped[bool]
    disabled: Mapped[bool]


class LinkedAccount(Base):
    """A user is the same person as one of another realm, and logs in by that one's password."""

    __tablename__ = "guest_account"

    user_id: Mapped[int] = mapped_column(
        ForeignKey("user_account.id", ondelete="CASCADE"), primary_key=True, autoincrement=False
    )
    home_id: Mapped[int] = owned_by("user_account.id")


class Group(Base):
    """Users that get rights together."""

    __tablename__ = "user_group"
    __table_args__ = (UniqueConstraint("realm_id", "name"), NO_REUSE)

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


class AccessToken(Base):
    """Lets its bearer act as a user: for programs (access), a browser (session), or once (login)."""

    __tablename__ = "access_token"
    __table_args__ = (
        UniqueConstraint("token_hash"),
        CheckConstraint("kind IN ('access', 'session', 'login')", name="kind"),
        CheckConstraint("length(token_hash) = 64", name="token_hash"),
        NO_REUSE,
    )

    id: Mapped[Key]
    user_id: Mapped[int] = owned_by("user_account.id")
    token_hash: Mapped[Digest]
    kind: Mapped[str] = mapped_column(String(16))
    label: Mapped[Label]
    created: Mapped[Seconds]
    expires: Mapped[Seconds | None]
    scope: Mapped[str | None] = mapped_column(Text)
    program_id: Mapped[int | None] = owned_by("program.id")
    family_id: Mapped[int | None] = owned_by("token_family.id")


class OAuthClient(Base):
    """Proves itself by key and secret, and acts as a user.

    ``verifier`` is what RFC 7616 section 3.4.2 calls H(A1): responses of Digest can be checked by nothing less. The
    secret behind it is random, so it can't be searched for, and the key is known to no other relay.
    """

    __tablename__ = "program"
    __table_args__ = (
        UniqueConstraint("key"),
        CheckConstraint("length(verifier) = 64", name="verifier"),
        NO_REUSE,
    )

    id: Mapped[Key]
    user_id: Mapped[int] = owned_by("user_account.id")
    key: Mapped[Digest]
    verifier: Mapped[Digest]
    scope: Mapped[str | None] = mapped_column(Text)
    label: Mapped[Label]
    created: Mapped[Seconds]


class TokenFamily(Base):
    """All tokens that came of one login: a refresh token, replaced at each use, and the access tokens it gave.

    The one it replaced is remembered: who comes with that has a copy, and all of the family ends (RFC 9700 section
    4.14.2).
    """

    __tablename__ = "token_family"
    __table_args__ = (
        UniqueConstraint("refresh_hash"),
        UniqueConstraint("former_hash"),
        CheckConstraint("length(refresh_hash) = 64", name="refresh_hash"),
        CheckConstraint("length(former_hash) = 64", name="former_hash"),
        NO_REUSE,
    )

    id: Mapped[Key]
    user_id: Mapped[int] = owned_by("user_account.id")
    scope: Mapped[str | None] = mapped_column(Text)
    refresh_hash: Mapped[Digest]
    former_hash: Mapped[Digest | None]
    created: Mapped[Seconds]
    expires: Mapped[Seconds]
