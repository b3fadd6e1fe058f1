"""The tables. Rows hold constraints; rules live in the queries and above.

Times are Unix seconds. Numbers of rows are never reused (AUTOINCREMENT on SQLite): an open session keeps the number of
its token, which must not become another token's.

Secrets are not stored: tokens and enrolment codes are stored as SHA-256 in hex, passwords as argon2id, and keys of
robots as public keys. Rules of alerts are the exception, because their secrets sign and send messages.
"""

from __future__ import annotations

from typing import Annotated, Any

from sqlalchemy import (
    BigInteger,
    CheckConstraint,
    Double,
    ForeignKey,
    Index,
    LargeBinary,
    String,
    Text,
    UniqueConstraint,
    text,
)
from sqlalchemy.orm import Mapped, mapped_column

from relay_db.base import Base, JsonText
from relay_protocol.limits import FILE_NAME, ROBOT_NAME, STOP_ID_LENGTH

NAME = 63
"""Longest name of a realm, user or group, in characters."""

SOURCE = 128
"""Longest source of an event, and longest name of a registry entry, in characters."""

ROLE_NAME = 128
"""Longest name of a Role, in characters."""

LABEL = 255
"""Longest free text for people (labels, descriptions, targets of audit entries), in characters."""

Key = Annotated[int, mapped_column(primary_key=True)]
Name = Annotated[str, mapped_column(String(NAME))]
Label = Annotated[str, mapped_column(String(LABEL))]
Seconds = Annotated[float, mapped_column(Double)]
Days = Annotated[float, mapped_column(Double)]
Digest = Annotated[str, mapped_column(String(64))]
"""A SHA-256 in hex."""

NO_REUSE = {"sqlite_autoincrement": True}


def owned_by(column: str, *, index: bool = True) -> Any:
    """A foreign key; the rows are deleted with the row that they refer to.

    :param index: false where a unique constraint begins with the column
    """
    return mapped_column(ForeignKey(column, ondelete="CASCADE"), index=index)


# --- users, groups, tokens ------------------------------------------------------------------------------


class Realm(Base):
    """Users, groups and robots of one realm do not see those of another.

    ``events_days`` is how long its events are stored; null for the setting of the relay.
    """

    __tablename__ = "realm"
    __table_args__ = (UniqueConstraint("name"), NO_REUSE)

    id: Mapped[Key]
    name: Mapped[Name]
    events_days: Mapped[Days | None]


class User(Base):
    """A person, or an account for programs. Without a password it can log in only with tokens."""

    __tablename__ = "user_account"
    __table_args__ = (UniqueConstraint("realm_id", "name"), NO_REUSE)

    id: Mapped[Key]
    realm_id: Mapped[int] = mapped_column(ForeignKey("realm.id", ondelete="RESTRICT"))
    name: Mapped[Name]
    password_hash: Mapped[Label | None]
    admin: Mapped[bool]
    disabled: Mapped[bool]


class LinkedAccount(Base):
    """An account that has the password of an account of the same user in another realm, its home."""

    __tablename__ = "linked_account"

    user_id: Mapped[int] = mapped_column(
        ForeignKey("user_account.id", ondelete="CASCADE"), primary_key=True, autoincrement=False
    )
    home_user_id: Mapped[int] = owned_by("user_account.id")


class Group(Base):
    """Users that have rights together."""

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
    """Authenticates a user: programs (``access``), a browser (``session``), one login (``login``), or the Foxglove
    websockets of one robot (``foxglove``).
    """

    __tablename__ = "access_token"
    __table_args__ = (
        UniqueConstraint("token_hash"),
        CheckConstraint("kind IN ('access', 'session', 'login', 'foxglove')", name="kind"),
        CheckConstraint("length(token_hash) = 64", name="token_hash"),
        CheckConstraint("(kind = 'foxglove') = (robot_id IS NOT NULL)", name="robot"),
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
    oauth_client_id: Mapped[int | None] = owned_by("oauth_client.id")
    family_id: Mapped[int | None] = owned_by("token_family.id")
    robot_id: Mapped[int | None] = owned_by("robot.id")


class OAuthClient(Base):
    """A program that authenticates itself by key and secret, and acts as a user.

    ``digest_ha1`` is H(A1) of RFC 7616 section 3.4.2 by SHA-256, which checking Digest requires. The secret in it is
    random, so it cannot be guessed.
    """

    __tablename__ = "oauth_client"
    __table_args__ = (
        UniqueConstraint("key"),
        CheckConstraint("length(digest_ha1) = 64", name="digest_ha1"),
        NO_REUSE,
    )

    id: Mapped[Key]
    user_id: Mapped[int] = owned_by("user_account.id")
    key: Mapped[Digest]
    digest_ha1: Mapped[Digest]
    scope: Mapped[str | None] = mapped_column(Text)
    label: Mapped[Label]
    created: Mapped[Seconds]


class TokenFamily(Base):
    """All tokens of one login: a refresh token, which is replaced at each use, and the access tokens issued for it.

    The refresh token before the current one is stored too: its use shows that it was copied, and ends the family (RFC
    9700 section 4.14.2).
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


# --- robots, their keys, and rights ---------------------------------------------------------------------


class Robot(Base):
    """A robot; it may connect once a key is enrolled."""

    __tablename__ = "robot"
    __table_args__ = (UniqueConstraint("realm_id", "name"), NO_REUSE)

    id: Mapped[Key]
    realm_id: Mapped[int] = mapped_column(ForeignKey("realm.id", ondelete="RESTRICT"))
    name: Mapped[str] = mapped_column(String(ROBOT_NAME))
    description: Mapped[Label]


class HomeRelay(Base):
    """The relay of a cluster that a robot is connected to.

    ``relay`` is its id, and empty after the robot has disconnected; ``epoch`` numbers the robot's connections.
    """

    __tablename__ = "home_relay"

    robot_id: Mapped[int] = mapped_column(
        ForeignKey("robot.id", ondelete="CASCADE"), primary_key=True, autoincrement=False
    )
    relay: Mapped[str] = mapped_column(String(64))
    epoch: Mapped[int]


class RelayLease(Base):
    """A task that one relay of a cluster has until the lease expires, by the database's clock."""

    __tablename__ = "relay_lease"

    task: Mapped[str] = mapped_column(String(64), primary_key=True)
    relay: Mapped[str] = mapped_column(String(64))
    expires: Mapped[Seconds]


class RobotRealm(Base):
    """A robot belongs to a realm: the one in which it was added, and each that it is shared with."""

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
    """Robots to which one order can be given. Membership gives no rights."""

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
    """The public key of a robot; live until it is retired."""

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
    """Allows a robot to enrol a key, once, until it expires."""

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
    """The right of a user or a group on a robot."""

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
    """An order to stop that the robot has not confirmed yet; it is sent as soon as the robot is online."""

    __tablename__ = "stop_order"

    robot_id: Mapped[int] = mapped_column(
        ForeignKey("robot.id", ondelete="CASCADE"), primary_key=True, autoincrement=False
    )
    by: Mapped[Label]
    why: Mapped[str] = mapped_column(Text)
    at: Mapped[Seconds]
    stop_id: Mapped[str] = mapped_column(String(STOP_ID_LENGTH), server_default=text("''"))


class ModuleReport(Base):
    """The modules of a robot as it last reported them: JSON, a list as in the message ``modules`` (SPEC 2.4)."""

    __tablename__ = "module_report"

    robot_id: Mapped[int] = mapped_column(
        ForeignKey("robot.id", ondelete="CASCADE"), primary_key=True, autoincrement=False
    )
    at: Mapped[Seconds]
    modules: Mapped[str] = mapped_column(Text)


class ModuleOrder(Base):
    """A module is to be started or stopped as soon as its robot is online, or the robot has refused that."""

    __tablename__ = "module_order"

    robot_id: Mapped[int] = mapped_column(
        ForeignKey("robot.id", ondelete="CASCADE"), primary_key=True, autoincrement=False
    )
    module: Mapped[str] = mapped_column(String(63), primary_key=True)
    start: Mapped[bool]
    user_id: Mapped[int | None] = mapped_column(ForeignKey("user_account.id", ondelete="CASCADE"), index=True)
    by: Mapped[Label]
    at: Mapped[Seconds]
    refused_at: Mapped[Seconds | None]
    refusal: Mapped[str] = mapped_column(Text, server_default=text("''"))


class Pipe(Base):
    """Carries the messages of one robot's topic to another, as long as its owner may.

    ``settings`` is JSON: the ends, the fields and the rate. ``enabled`` is whether it is to run, ``moves`` whether it
    was found to move a robot. ``reason`` says why the relay ended it.
    """

    __tablename__ = "pipe"
    __table_args__ = (UniqueConstraint("realm_id", "name"), NO_REUSE)

    id: Mapped[Key]
    realm_id: Mapped[int] = owned_by("realm.id", index=False)
    name: Mapped[Name]
    owner_id: Mapped[int] = owned_by("user_account.id")
    source_robot_id: Mapped[int] = owned_by("robot.id")
    source_account_id: Mapped[int] = owned_by("user_account.id")
    target_robot_id: Mapped[int] = owned_by("robot.id")
    target_account_id: Mapped[int] = owned_by("user_account.id")
    settings: Mapped[str] = mapped_column(Text)
    enabled: Mapped[bool]
    moves: Mapped[bool]
    reason: Mapped[Label]


# --- functions ------------------------------------------------------------------------------------------


class FunctionJob(Base):
    """A call of a function whose caller does not wait, of a user or a robot.

    ``arguments`` and ``result`` are MessagePack; the arguments are removed at the end. ``relay`` is the relay of a
    cluster that works on it, or empty. ``robot_id`` is set for a job
    of a robot, otherwise ``user_id``. ``payer`` is the robot that a user calls it for.
    """

    __tablename__ = "function_job"
    __table_args__ = (
        UniqueConstraint("user_id", "key"),
        UniqueConstraint("robot_id", "key"),
        Index(None, "expires"),
        Index(None, "state"),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    realm_id: Mapped[int] = owned_by("realm.id")
    user_id: Mapped[int | None] = owned_by("user_account.id", index=False)
    robot_id: Mapped[int | None] = owned_by("robot.id", index=False)
    payer_id: Mapped[int | None] = owned_by("robot.id")
    key: Mapped[str | None] = mapped_column(String(LABEL))
    digest: Mapped[Digest]
    function: Mapped[Name]
    version: Mapped[int]
    state: Mapped[str] = mapped_column(String(16))
    code: Mapped[str] = mapped_column(String(32))
    error: Mapped[str] = mapped_column(Text)
    arguments: Mapped[bytes] = mapped_column(LargeBinary)
    result: Mapped[bytes | None] = mapped_column(LargeBinary)
    result_bytes: Mapped[int]
    created: Mapped[Seconds]
    started: Mapped[Seconds | None]
    ended: Mapped[Seconds | None]
    deadline: Mapped[Seconds]
    expires: Mapped[Seconds | None]
    attempts: Mapped[int]
    run_seconds: Mapped[Seconds | None]
    relay: Mapped[str] = mapped_column(String(64), server_default=text("''"))


# --- roles ----------------------------------------------------------------------------------------------


class RoleDocument(Base):
    """A Role of a realm as a document in N-Triples.

    ``serial`` grows with each change in the realm, ``statements`` counts triples; ``robots`` are the names that the
    document gives to robots.
    """

    __tablename__ = "role_document"
    __table_args__ = (
        UniqueConstraint("realm_id", "name"),
        Index(None, "realm_id", "serial"),
        NO_REUSE,
    )

    id: Mapped[Key]
    realm_id: Mapped[int] = owned_by("realm.id", index=False)
    name: Mapped[str] = mapped_column(String(ROLE_NAME))
    revision: Mapped[int]
    serial: Mapped[int]
    owner_id: Mapped[int | None] = mapped_column(
        ForeignKey("user_account.id", ondelete="SET NULL"), index=True
    )
    by: Mapped[Label]
    at: Mapped[Seconds]
    statements: Mapped[int]
    robots: Mapped[list[str]] = mapped_column(JsonText)
    document: Mapped[str] = mapped_column(Text)


class RoleRun(Base):
    """A Role that a user has started, and by whose rights it runs.

    ``parts`` is JSON; ``reason`` says why the relay ended it, and is empty while it is started.
    """

    __tablename__ = "role_run"

    role_id: Mapped[int] = mapped_column(ForeignKey("role_document.id", ondelete="CASCADE"), primary_key=True)
    user_id: Mapped[int] = owned_by("user_account.id")
    at: Mapped[Seconds]
    parts: Mapped[str] = mapped_column(Text)
    reason: Mapped[Label]


# --- alerts ---------------------------------------------------------------------------------------------


class Alert(Base):
    """An alert about a robot. All reports of the same alert are one row.

    ``about`` is the part of the robot. ``report_count`` counts reports, ``notification_count`` the notifications of
    users. ``over_at`` is when it ended.
    """

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
    report_count: Mapped[int]
    notification_count: Mapped[int]
    over_at: Mapped[Seconds | None]
    ack_by: Mapped[Label | None]
    ack_at: Mapped[Seconds | None]


class AlertRule(Base):
    """A rule by which a user is notified of alerts.

    ``robots`` is a pattern of names. ``notify_end`` is whether ends of alerts are sent too, ``group_s`` the least
    seconds between two messages, ``quiet`` the hours in which only severe alerts are sent.
    """

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
    notify_end: Mapped[bool]
    group_s: Mapped[Seconds]
    quiet: Mapped[dict[str, str] | None] = mapped_column(JsonText)
    created: Mapped[Seconds]


# --- service registry -----------------------------------------------------------------------------------


class ServiceRegistryEntry(Base):
    """A registered service or application, as long as its lease is renewed.

    ``data`` is JSON, ``ttl`` the length of the lease in seconds. An entry is deleted with its user and its robot.
    """

    __tablename__ = "service_registry_entry"
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


# --- event log and audit log ----------------------------------------------------------------------------


class StoredEvent(Base):
    """A stored event, numbered within its realm, so that numbers show nothing about other realms.

    ``data`` is JSON. Users are stored by name and robots by number, without foreign keys, so events are written without
    looking them up. Events about a removed robot are visible to no user.

    ``use_count`` is how often queries have returned the event.
    """

    __tablename__ = "stored_event"
    __table_args__ = (
        Index("ix_stored_event_at", "realm_id", "at", "number"),
        Index("ix_stored_event_source", "realm_id", "source", "at", "number"),
        Index("ix_stored_event_kind", "realm_id", "kind", "at", "number"),
        Index("ix_stored_event_user", "realm_id", "user_name", "at", "number"),
        Index("ix_stored_event_robot", "realm_id", "robot_id", "at", "number"),
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
    use_count: Mapped[int]


class LastEventNumber(Base):
    """The number of the latest event of a realm, so that no number is used twice."""

    __tablename__ = "last_event_number"

    realm_id: Mapped[int] = mapped_column(
        ForeignKey("realm.id", ondelete="RESTRICT"), primary_key=True, autoincrement=False
    )
    number: Mapped[int] = mapped_column(BigInteger)


class StoredFile(Base):
    """A file of a robot. Its contents are in the relay's file storage under its number.

    ``state`` is ``incoming`` until the contents are stored durably, and ``removing`` before they are deleted, so that
    the storage holds nothing that is in no row. Robots are stored by number without a foreign key: the contents of a
    removed robot's files are deleted before their rows.

    ``origin`` is the robot's group of files, or ``user:`` and the name of the user who uploaded it. ``modified`` is
    when the file was changed last at its origin, ``state_since`` when it entered its state.
    """

    __tablename__ = "stored_file"
    __table_args__ = (
        UniqueConstraint("robot_id", "name", "sha256"),
        Index("ix_stored_file_state", "state", "state_since"),
        CheckConstraint("size >= 0", name="size"),
        CheckConstraint("state IN ('incoming', 'stored', 'removing')", name="state"),
        NO_REUSE,
    )

    id: Mapped[Key]
    robot_id: Mapped[int]
    name: Mapped[str] = mapped_column(
        # Ordered by bytes, as SQLite does, so that names with a prefix are together.
        String(FILE_NAME).with_variant(String(FILE_NAME, collation="C"), "postgresql")
    )
    sha256: Mapped[Digest]
    size: Mapped[int] = mapped_column(BigInteger)
    state: Mapped[str] = mapped_column(String(8))
    origin: Mapped[Label]
    modified: Mapped[Seconds]
    state_since: Mapped[Seconds]


class FileUsage(Base):
    """Number and size of a robot's files, so that a quota is checked without counting them."""

    __tablename__ = "file_usage"

    robot_id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    realm_id: Mapped[int] = mapped_column(index=True)
    files: Mapped[int]
    bytes: Mapped[int] = mapped_column(BigInteger)


class LoginFailure(Base):
    """A failed login of an account, which may not exist, from a network that its user has never logged in from.

    ``account`` is the SHA-256 of its name.
    """

    __tablename__ = "login_failure"

    id: Mapped[Key]
    account: Mapped[Digest] = mapped_column(index=True)
    expires: Mapped[Seconds]


class LoginNetwork(Base):
    """A network that a user has logged in from; ``at`` is about the time of the last login."""

    __tablename__ = "login_network"

    user_id: Mapped[int] = mapped_column(
        ForeignKey("user_account.id", ondelete="CASCADE"), primary_key=True, autoincrement=False
    )
    network: Mapped[str] = mapped_column(String(LABEL), primary_key=True)
    at: Mapped[Seconds]


class AuditEntry(Base):
    """An entry of the audit log; triggers prevent that it is changed or removed.

    Names are stored as text without foreign keys, because entries outlive the users and robots that they name.
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
    """One row: the number of the latest change of access, and the end of the audit chain.

    The end is stored because a chain without its last entries would still verify.
    """

    __tablename__ = "revision"
    __table_args__ = (CheckConstraint("id = 1", name="one_row"),)

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    number: Mapped[int]
    audit_id: Mapped[int]
    audit_hash: Mapped[Digest]
