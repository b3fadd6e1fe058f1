"""The records that queries return, and how rows become records. A record belongs to no session."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from sqlalchemy.orm import Session

from relay_protocol.realms import full_name
from relay_protocol.rights import Level

R = TypeVar("R")


def record_of(kind: Callable[..., R], row: Any, **more: Any) -> R:
    """A record of a row of SQLAlchemy whose labels are the fields of the record.

    :param more: fields that the row lacks, or has in another form
    """
    return kind(**{**row._mapping, **more})


def fetch_all(s: Session, kind: Callable[..., R], query: Any, **more: Any) -> list[R]:
    """The records of all rows; see :func:`record_of`."""
    return [record_of(kind, row, **more) for row in s.execute(query)]


def fetch_one(s: Session, kind: Callable[..., R], query: Any) -> R | None:
    """The record of the only row, ``None`` if there is no row."""
    row = s.execute(query).one_or_none()
    return None if row is None else record_of(kind, row)


class RealmRecord(NamedTuple):
    """A realm.

    :param events_days: how many days its events are stored; ``None`` for the setting of the relay
    """

    id: int
    name: str
    events_days: float | None


class UserRecord(NamedTuple):
    """A user.

    :param password_hash: ``None`` for a user that can log in only with tokens
    :param home: full name of the account in another realm whose password this one has
    """

    id: int
    name: str
    realm: str
    admin: bool
    disabled: bool
    password_hash: str | None
    home: str | None = None

    @property
    def full(self) -> str:
        """The name that is unique in the relay: ``toad@lab1``."""
        return full_name(self.name, self.realm)


class GroupRecord(NamedTuple):
    """A group and the names of its members."""

    id: int
    name: str
    realm: str
    members: tuple[str, ...]

    @property
    def full(self) -> str:
        """The name that is unique in the relay: ``toad@lab1``."""
        return full_name(self.name, self.realm)


class RobotRecord(NamedTuple):
    """A robot. ``realm`` is its own realm; it may be shared with others."""

    id: int
    name: str
    realm: str
    description: str

    @property
    def full(self) -> str:
        """The name that is unique in the relay: ``toad@lab1``."""
        return full_name(self.name, self.realm)


class HomeRelayRecord(NamedTuple):
    """The relay of a cluster that a robot is connected to.

    :ivar relay: id of the relay; empty: the robot has disconnected
    :ivar epoch: number of the connection
    """

    robot_id: int
    relay: str
    epoch: int


class RobotGroupRecord(NamedTuple):
    """A group of robots and their names."""

    id: int
    name: str
    realm: str
    robots: tuple[str, ...]

    @property
    def full(self) -> str:
        """The name that is unique in the relay: ``toad@lab1``."""
        return full_name(self.name, self.realm)


class RobotKeyRecord(NamedTuple):
    """A live key of a robot: 32 bytes, Ed25519."""

    robot_id: int
    robot: str
    realm: str
    public_key: bytes


class KeyRecord(NamedTuple):
    """A key of a robot for display.

    :param agent: the software that enrolled it
    :param retired: Unix seconds; ``None`` while it is live
    """

    fingerprint: str
    agent: str
    created: float
    retired: float | None


class RightRecord(NamedTuple):
    """A right. Exactly one of ``user`` and ``group`` is a name, in the realm ``realm``."""

    id: int
    robot_id: int
    robot: str
    realm: str
    user: str | None
    group: str | None
    level: Level
    allow: tuple[str, ...]
    deny: tuple[str, ...]


class PrincipalRecord(NamedTuple):
    """The user that a token authenticates.

    :param expires: Unix seconds at which the token expires; ``None`` for never
    :param scope: limits the user's rights; ``None`` for no limit
    :param robot_id: the only robot that the token is for; ``None`` for all
    """

    user_id: int
    name: str
    realm: str
    admin: bool
    token_id: int
    expires: float | None
    scope: str | None = None
    robot_id: int | None = None


class TokenRecord(NamedTuple):
    """A token for display, without its secret."""

    id: int
    user_id: int
    user: str
    kind: str
    label: str
    created: float
    expires: float | None
    scope: str | None = None
    robot_id: int | None = None


class OAuthClientRecord(NamedTuple):
    """An OAuth client: a program that authenticates itself by key and secret, and acts as a user.

    :param digest_ha1: H(A1) of RFC 7616 by SHA-256, in hex
    :param scope: the widest scope of its tokens; ``None`` for no limit
    """

    id: int
    user_id: int
    user: str
    realm: str
    key: str
    digest_ha1: str
    scope: str | None
    label: str
    created: float


class IssuedRecord(NamedTuple):
    """An access or refresh token, for introspection and refreshing.

    :param kind: ``access`` or ``refresh``
    :param client_id: key of the OAuth client that it was issued to
    :param family_id: the token family that it belongs to, if it can be refreshed
    """

    kind: str
    user_id: int
    user: str
    realm: str
    scope: str | None
    client_id: str | None
    created: float
    expires: float | None
    family_id: int | None


class StopRecord(NamedTuple):
    """An order to stop that a robot has not confirmed yet.

    :param at: Unix seconds at which it was given; identifies the order
    :param stop_id: made by the client; the same on every path by which the stop arrives; empty for none
    """

    robot_id: int
    by: str
    why: str
    at: float
    stop_id: str = ""


class PipeRecord(NamedTuple):
    """A pipe.

    :param owner: full name of the user
    :param source_account_id: account of the owner in the realm by which the source robot is named
    :param settings: JSON: ends, fields, rate
    :param enabled: whether it is to run
    :param moves: whether it was found to move a robot
    :param reason: why the relay ended it; empty if a user did
    """

    id: int
    name: str
    realm: str
    owner_id: int
    owner: str
    source_robot_id: int
    source_account_id: int
    target_robot_id: int
    target_account_id: int
    settings: str
    enabled: bool
    moves: bool
    reason: str


class FunctionJobRecord(NamedTuple):
    """A job of a function, of a user or of a robot.

    :param owner: full name of the user or robot
    :param payer: full name of the robot that a user calls it for, or empty
    :param key: idempotency key of the owner
    :param digest: SHA-256 of function and arguments
    :param arguments: MessagePack; empty once the job has ended
    :param result: MessagePack; ``None`` if there is none, and in lists
    """

    id: str
    realm: str
    owner: str
    user_id: int | None
    robot_id: int | None
    payer_id: int | None
    payer: str
    key: str | None
    digest: str
    function: str
    version: int
    state: str
    created: float
    deadline: float
    arguments: bytes = b""
    result: bytes | None = None
    result_bytes: int = 0
    code: str = ""
    error: str = ""
    started: float | None = None
    ended: float | None = None
    expires: float | None = None
    attempts: int = 0
    run_seconds: float | None = None
    relay: str = ""


class FileRecord(NamedTuple):
    """A file of a robot.

    :param state: ``incoming``, ``stored`` or ``removing``
    :param origin: group of files, or ``user:`` and a name
    :param modified: when it was changed last at its origin, Unix seconds
    :param state_since: when it entered its state, Unix seconds
    """

    id: int
    robot_id: int
    name: str
    sha256: str
    size: int
    state: str
    origin: str
    modified: float
    state_since: float


class FileUsageRecord(NamedTuple):
    """Files of one robot or more, including those that are being uploaded."""

    files: int
    bytes: int


class ModuleReportRecord(NamedTuple):
    """The modules of a robot as it last reported them.

    :param at: Unix time
    :param modules: JSON, a list as in the message ``modules`` (SPEC 2.4)
    """

    robot_id: int
    at: float
    modules: str


class ModuleOrderRecord(NamedTuple):
    """A module is to be started or stopped as soon as its robot is online, or the robot has refused that.

    :param start: true to start it, false to stop it
    :param user_id: the user whose order it is; ``None`` for the command line on the relay's machine
    :param by: the user as shown at the robot; of the operating system for the command line
    :param at: Unix time of the order
    :param refused_at: Unix time of the refusal; ``None`` while the order is pending
    :param refusal: its reason
    """

    robot_id: int
    module: str
    start: bool
    user_id: int | None
    by: str
    at: float
    refused_at: float | None = None
    refusal: str = ""


class RoleRecord(NamedTuple):
    """A Role without its document.

    :param revision: grows with each change of this Role
    :param serial: grows with each change of a Role in the realm
    :param owner_id: ``None`` for the command line on the relay's machine
    :param by: full name of the user who changed it last
    :param at: Unix time of that change
    :param statements: how many there are
    :param robots: names of robots that it refers to, in its realm
    """

    name: str
    revision: int
    serial: int
    owner_id: int | None
    by: str
    at: float
    statements: int
    robots: list[str]


class NewRole(NamedTuple):
    """A Role to be stored.

    :param document: in N-Triples
    """

    name: str
    document: str
    statements: int
    robots: list[str]


class AlertRecord(NamedTuple):
    """An alert about a robot.

    :param about: the part of the robot
    :param first: Unix seconds of the first report; ``last`` of the latest
    :param report_count: how often it was reported
    :param notification_count: how often users were notified that it began, came back, became worse or ended
    :param over: Unix seconds of its end; ``None`` while it is open
    :param ack_by: the user who acknowledged it; ``ack_at`` in Unix seconds
    """

    id: str
    robot_id: int
    robot: str
    realm: str
    kind: str
    about: str
    level: str
    text: str
    first: float
    last: float
    report_count: int
    notification_count: int
    over: float | None
    ack_by: str | None
    ack_at: float | None


class AlertRuleRecord(NamedTuple):
    """A rule by which a user is notified of alerts. ``url`` and ``secret`` must not be shown to anyone.

    :param notify_end: whether ends of alerts are sent too
    :param group_s: least seconds between two messages
    """

    id: int
    user_id: int
    user: str
    realm: str
    label: str
    robots: str
    kinds: tuple[str, ...]
    level: str
    channel: str
    url: str
    secret: str
    notify_end: bool
    group_s: float
    quiet: dict[str, str] | None
    created: float


class NewStoredEvent(NamedTuple):
    """An event to be stored.

    :param data: a JSON object as text, in ASCII, as :func:`relay_db.base.canonical_json` writes it
    """

    realm: str
    at: float
    source: str
    kind: str
    robot_id: int | None
    user: str | None
    data: str


class StoredEventRecord(NamedTuple):
    """A stored event.

    :param number: counts the events of the realm in the order in which they were written
    :param use_count: how often queries have returned it
    """

    number: int
    realm: str
    at: float
    source: str
    kind: str
    robot_id: int | None
    user: str | None
    data: str
    use_count: int


class NameCondition(NamedTuple):
    """A condition on a name: equal to the text, or with ``prefix`` beginning with it."""

    text: str
    prefix: bool = False

    def matches(self, name: str) -> bool:
        """Whether a name meets the condition."""
        return name.startswith(self.text) if self.prefix else name == self.text


class EventCursor(NamedTuple):
    """A position in a list of events, which begins with the newest."""

    at: float
    number: int


class EventSearch(NamedTuple):
    """A search for events of a realm, limited to those that the reader may see.

    :param robots: numbers of the robots whose events are searched
    :param without_robot: also search events that are about no robot
    :param admin: of these also the relay's own, and logins
    :param since: Unix seconds; ``until`` is exclusive
    :param data: top-level fields of the data, and their values as text
    """

    realm: str
    robots: frozenset[int]
    without_robot: bool
    admin: bool = False
    source: NameCondition | None = None
    kind: NameCondition | None = None
    user: str | None = None
    since: float | None = None
    until: float | None = None
    data: tuple[tuple[str, str], ...] = ()


class FoundEvents(NamedTuple):
    """Events that were found, and the cursor after which there may be more; ``None`` if there are no more."""

    events: list[StoredEventRecord]
    cursor: EventCursor | None


class StoredEventCounts(NamedTuple):
    """A count of events; their numbers if they are few; the cursor as in :class:`FoundEvents`."""

    size: int
    numbers: list[int]
    cursor: EventCursor | None


class AuditRecord(NamedTuple):
    """An entry of the audit log; see :func:`relay_db.queries.audit.append_audit`."""

    id: int
    at: float
    actor: str
    action: str
    target: str
    origin: str
    data: dict[str, Any]
    hash: str


class NewEntry(NamedTuple):
    """An entry to be registered in the service registry.

    :param robot_id: the robot it is about, if it is about one
    :param user_id: the user who registers it
    :param data: a JSON object as text, in ASCII, as :func:`relay_db.base.canonical_json` writes it
    :param ttl: length of its lease, seconds
    """

    realm: str
    kind: str
    name: str
    address: str
    description: str
    robot_id: int | None
    user_id: int
    data: str
    ttl: float


class EntryRecord(NamedTuple):
    """An entry of the service registry.

    :param data: see :class:`NewEntry`
    :param ttl: length of its lease, seconds
    :param registered: Unix seconds
    :param expires: Unix seconds at which its lease ends
    """

    id: str
    realm: str
    kind: str
    name: str
    address: str
    description: str
    robot_id: int | None
    robot: str | None
    user_id: int
    user: str
    data: str
    ttl: float
    registered: float
    expires: float


class EntryCursor(NamedTuple):
    """A position in a list of entries; those about no robot come first."""

    robot: str
    kind: str
    name: str
    id: str


class EntrySearch(NamedTuple):
    """A search for entries of a realm, limited to those that the reader may see.

    :param robots: numbers of the robots whose entries are searched; ``None`` for all
    :param without_robot: also search entries that are about no robot
    :param name: pattern with shell wildcards
    :param after: the cursor after which the result begins
    """

    realm: str
    robots: frozenset[int] | None = None
    without_robot: bool = True
    kind: str | None = None
    name: str = "*"
    after: EntryCursor | None = None


class LeaseTimes(NamedTuple):
    """The state of all leases.

    :param ids: of all entries, also of those whose lease has ended
    :param next_end: Unix seconds at which the next lease ends; ``None`` if there are none
    :param too_long: a lease lasts longer than it was granted, because the clock was set back
    """

    ids: frozenset[str]
    next_end: float | None
    too_long: bool
