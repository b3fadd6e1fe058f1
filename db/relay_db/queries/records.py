"""What queries answer with. Nothing here is tied to a session."""

from __future__ import annotations

from typing import Any, NamedTuple

from relay_protocol.realms import full_name
from relay_protocol.rights import Level


class RealmRecord(NamedTuple):
    """A realm.

    :param events_days: how long its memory keeps events; ``None``: as long as that of the whole relay
    """

    id: int
    name: str
    events_days: float | None


class UserRecord(NamedTuple):
    """A user; ``password_hash`` is None for one that only tokens let in.

    :param home: the full name of the account it is a guest of: the password is that one's
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
        """Its name for the whole relay: ``toad@lab1``."""
        return full_name(self.name, self.realm)


class GroupRecord(NamedTuple):
    """A group and the names of its members."""

    id: int
    name: str
    realm: str
    members: tuple[str, ...]

    @property
    def full(self) -> str:
        """Its name for the whole relay: ``toad@lab1``."""
        return full_name(self.name, self.realm)


class RobotRecord(NamedTuple):
    """A robot, with its own realm, whatever realms it is shared with."""

    id: int
    name: str
    realm: str
    description: str

    @property
    def full(self) -> str:
        """Its name for the whole relay: ``toad@lab1``."""
        return full_name(self.name, self.realm)


class RobotGroupRecord(NamedTuple):
    """A group of robots and their names."""

    id: int
    name: str
    realm: str
    robots: tuple[str, ...]

    @property
    def full(self) -> str:
        """Its name for the whole relay: ``toad@lab1``."""
        return full_name(self.name, self.realm)


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
    """A right: exactly one of ``user`` and ``group`` is a name, in the realm ``realm``."""

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
    """Who a token stands for; ``expires`` is the token's end, None for never.

    :param scope: what it may be used for; ``None`` for all that its user may
    """

    user_id: int
    name: str
    realm: str
    admin: bool
    token_id: int
    expires: float | None
    scope: str | None = None


class TokenRecord(NamedTuple):
    """A token as people see it, without anything that could be used as one."""

    id: int
    user_id: int
    user: str
    kind: str
    label: str
    created: float
    expires: float | None
    scope: str | None = None


class OAuthClientRecord(NamedTuple):
    """A program that proves itself by key and secret.

    :param verifier: H(A1) of RFC 7616 by SHA-256, in hex
    :param scope: what its tokens may be used for at most; ``None`` for all that its user may
    """

    id: int
    user_id: int
    user: str
    realm: str
    key: str
    verifier: str
    scope: str | None
    label: str
    created: float


class IssuedRecord(NamedTuple):
    """What a token stands for that somebody asks about or goes on with.

    :param kind: ``access`` or ``refresh``
    :param program: key of the program it was given to
    :param family_id: what it belongs to, if it can be refreshed
    """

    kind: str
    user_id: int
    user: str
    realm: str
    scope: str | None
    program: str | None
    created: float
    expires: float | None
    family_id: int | None


class StopRecord(NamedTuple):
    """An order to stop that a robot has not confirmed yet.

    :param at: Unix time it was given; names it
    """

    robot_id: int
    by: str
    why: str
    at: float


class AlertRecord(NamedTuple):
    """What people should know of a robot.

    :param first: Unix time it was told first; ``last``: and last
    :param times: how often it was told
    :param news: how often there was something worth telling
    :param over: Unix time it was over, None while it lasts
    :param ack_by: who looks after it, if anybody
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
    times: int
    news: int
    over: float | None
    ack_by: str | None
    ack_at: float | None


class AlertRuleRecord(NamedTuple):
    """Which alerts a user is told of, and how. ``url`` and ``secret`` are nobody's to see.

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
    over: bool
    group_s: float
    quiet: dict[str, str] | None
    created: float


class EventRecord(NamedTuple):
    """Something that happened."""

    id: int
    at: float
    kind: str
    source: str
    robot_id: int | None
    user_id: int | None
    data: dict[str, Any]


class NewStoredEvent(NamedTuple):
    """An event for the short-term memory.

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
    """An event of the short-term memory.

    :param number: within its realm, in the order in which they were written
    :param used: how often a query has given it
    """

    number: int
    realm: str
    at: float
    source: str
    kind: str
    robot_id: int | None
    user: str | None
    data: str
    used: int


class NameIs(NamedTuple):
    """A name, or what it begins with."""

    text: str
    prefix: bool = False

    def fits(self, name: str) -> bool:
        """Whether a name is meant."""
        return name.startswith(self.text) if self.prefix else name == self.text


class EventCursor(NamedTuple):
    """A place among events that are told from the newest on."""

    at: float
    number: int


class EventSearch(NamedTuple):
    """What is asked of a realm's memory, and what of it may be seen.

    :param robots: robots about which events are wanted and may be seen
    :param general: whether those about no robot are wanted
    :param insider: whether of these also the relay's own, and logins, may be seen
    :param since: Unix seconds; ``until`` is the first moment after
    :param data: top-level fields of the data, and their values as text
    """

    realm: str
    robots: frozenset[int]
    general: bool
    insider: bool = False
    source: NameIs | None = None
    kind: NameIs | None = None
    user: str | None = None
    since: float | None = None
    until: float | None = None
    data: tuple[tuple[str, str], ...] = ()


class MemoryPage(NamedTuple):
    """Events that were found, and where to go on, ``None`` where there are no more."""

    events: list[StoredEventRecord]
    place: EventCursor | None


class StoredEventCounts(NamedTuple):
    """How many events there are, their numbers where they are few, and where to go on as in :class:`MemoryPage`."""

    size: int
    numbers: list[int]
    place: EventCursor | None


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
