"""Entries of the service registry and their limits."""

from __future__ import annotations

import base64
import binascii
import re
from typing import Annotated, NamedTuple
from urllib.parse import parse_qsl, urlsplit

import msgspec
from msgspec import UNSET, Meta, UnsetType

from relay_db.base import canonical_json
from relay_db.models import LABEL, SOURCE
from relay_db.queries import EntryCursor, EntryRecord, NewStoredEvent
from relay_db.queries.event_search import RELAY_SOURCE
from relay_protocol import jsontext
from relay_protocol.errors import Invalid
from relay_protocol.limits import ROBOT_NAME
from relay_protocol.text import is_printable
from relay_protocol.wildcards import check_pattern

KIND = 63
"""Longest kind of an entry, in characters."""

ADDRESS = 1024
"""Longest address, in characters."""

DATA = 2048
"""Most characters of an entry's data, as JSON in ASCII."""

TEXT = 255
"""Longest value in a query, in characters; and longest cursor:"""

CURSOR = 2048

TTL = 60.0
MIN_TTL = 2.0
MAX_TTL = 86_400.0
"""Length of a lease in seconds: without ``ttl``, at least, and at most."""

PER_USER = 200
PER_REALM = 5000
"""Most entries of a user, and of a realm."""

CHANGES_A_SECOND = 20.0
CHANGES_AT_ONCE = 400
"""Registrations, renewals, changes and removals of one user: in the long run, and at once."""

USERS = 1000
"""Users whose changes are counted; the longest quiet are dropped first."""

PAGE = 100
MAX_PAGE = 1000
"""Entries of an answer: without ``limit``, and at most."""

MAX_SCANNED = 10_000
"""Most members of robots that are scanned for one page; the next page continues there."""

SCAN_COST = 20
"""Reading the members of one kind of a robot counts as so many scanned members."""

CHECK_SECONDS = 1.0
"""Pause between two checks for expired leases. Queries leave out expired entries also before that."""

FULL_CHECK_SECONDS = 30.0
"""Longest time between two checks, in case a clock was set."""

HISTORY = 1000
"""Changes of a realm that are kept in memory for followers."""

SECRETS = frozenset(
    {
        "access_token",
        "api_key",
        "apikey",
        "auth",
        "authorization",
        "client_secret",
        "credential",
        "credentials",
        "mac",
        "passwd",
        "password",
        "pwd",
        "refresh_token",
        "secret",
        "session",
        "ticket",
        "token",
    }
)
"""Fields of a query that are credentials by their names."""

UNSAFE_SCHEMES = frozenset(
    {"about", "blob", "data", "file", "filesystem", "javascript", "vbscript", "view-source"}
)
"""Schemes of links that run a script in a page, or read the reader's own machine."""

_TEXT = re.compile(r"(?:[A-Za-z0-9\-._~:/?#\[\]@!$&'()*+,;=]|%[0-9A-Fa-f]{2})+\Z")
_SCHEME = re.compile(r"[a-z][a-z0-9+.-]*\Z")


def check_address(text: str) -> str:
    """An address: ``scheme://host…`` (RFC 3986), or the path of something on this relay.

    :raises Invalid: it is none, or holds a credential
    """
    if not 0 < len(text) <= ADDRESS:
        raise Invalid(f"'address' must have 1 to {ADDRESS} characters")
    if not _TEXT.match(text):
        raise Invalid(
            "'address' is no URI (RFC 3986): it has ASCII letters, digits and signs, everything else as %XX"
        )
    try:
        parts = urlsplit(text)
        host, _ = parts.hostname, parts.port
    except ValueError:
        raise Invalid("'address' is no URI: its host or port can't be") from None
    if not text.startswith("/") or text.startswith("//"):
        if not _SCHEME.match(parts.scheme) or not host:
            raise Invalid("'address' is scheme://host…, or a path on this relay that begins with one /")
        if parts.scheme in UNSAFE_SCHEMES:
            raise Invalid(f"'address' must not be of the scheme '{parts.scheme}'")
    if "@" in parts.netloc:
        raise Invalid(
            "'address' must not have a user or password in it: everybody who sees the entry reads it"
        )
    for part in (parts.query, parts.fragment):
        for field, _ in parse_qsl(part, keep_blank_values=True):
            if field.casefold() in SECRETS:
                raise Invalid(f"'address' must hold no credential, and '{field}' in it is one by its name")
    return text


SERVICE = "service"

ROBOT_KINDS = ("action", "camera", "node", "robot", SERVICE, "topic")
"""Kinds of entries that robots have without registration, sorted."""

_KIND = re.compile(r"[a-z][a-z0-9_.-]*\Z")
_CURSOR = re.compile(r"[A-Za-z0-9_-]+\Z")


class TooLarge(Invalid):
    """The data of an entry is too large."""

    code = "too_large"


class Registration(msgspec.Struct, forbid_unknown_fields=True):
    """The body of a request that registers or changes an entry.

    :param robot: the one it is about, if it is about one
    :param data: an object
    :param ttl: seconds for which it stays without being renewed
    """

    kind: Annotated[str, Meta(min_length=1, max_length=KIND)]
    name: Annotated[str, Meta(min_length=1, max_length=SOURCE)]
    address: Annotated[str, Meta(min_length=1, max_length=ADDRESS)]
    description: Annotated[str, Meta(max_length=LABEL)] = ""
    robot: Annotated[str, Meta(max_length=ROBOT_NAME)] | None = None
    data: msgspec.Raw = msgspec.field(default_factory=lambda: msgspec.Raw(b"{}"))
    ttl: Annotated[float, Meta(ge=MIN_TTL, le=MAX_TTL)] = TTL


def check_texts(new: Registration) -> None:
    """Check the texts of an entry.

    :raises Invalid: one is not allowed, or the kind is one that the relay fills from robots
    """
    if not _KIND.match(new.kind):
        raise Invalid(
            "'kind' must have lower-case letters, digits, '-', '_' and '.', and begin with a letter"
        )
    if new.kind in ROBOT_KINDS and new.kind != SERVICE:
        raise Invalid(
            f"entries of the kind '{new.kind}' come from robots and cannot be registered; choose another kind"
        )
    for what, text in (("name", new.name), ("description", new.description)):
        if not is_printable(text):
            raise Invalid(f"'{what}' must be one printable line")
    if new.name != new.name.strip():
        raise Invalid("'name' must not begin or end with a blank")


def data_text(data: msgspec.Raw) -> str:
    """The data of an entry as it is stored.

    :raises Invalid: it is not an object
    :raises TooLarge: it is too large
    :raises MalformedMessage: it is not JSON
    """
    value = jsontext.decode_any(bytes(data))
    if not isinstance(value, dict):
        raise Invalid("'data' must be a JSON object")
    try:
        text = canonical_json(value)
    except (ValueError, RecursionError):
        raise Invalid("'data' holds a value that JSON cannot express") from None
    if len(text) > DATA:
        raise TooLarge(f"'data' may have {DATA} characters at most, as JSON in ASCII")
    return text


class EntryInfo(msgspec.Struct):
    """An entry of the registry. Entries of robots' own resources have no user and no lease.

    :param robot: the one it is about
    :param user: the one who registered it
    :param ttl: seconds that its lease lasts
    :param registered: Unix seconds
    :param expires: Unix seconds
    """

    id: str
    kind: str
    name: str
    robot: str | None
    address: str
    description: str
    data: Annotated[msgspec.Raw, Meta(extra_json_schema={"type": "object"})]
    user: str | None
    ttl: float | None
    registered: float | None
    expires: float | None

    @classmethod
    def of(cls, record: EntryRecord, now: float) -> EntryInfo:
        """A registered entry.

        :param now: Unix seconds; ``expires`` is at most its ``ttl`` later
        """
        return cls(
            id=record.id,
            kind=record.kind,
            name=record.name,
            robot=record.robot,
            address=record.address,
            description=record.description,
            data=msgspec.Raw(record.data.encode()),
            user=record.user,
            ttl=record.ttl,
            registered=round(record.registered, 3),
            expires=round(min(record.expires, now + record.ttl), 3),
        )

    @property
    def cursor(self) -> EntryCursor:
        """Its position among all entries."""
        return EntryCursor(self.robot or "", self.kind, self.name, self.id)


def stored_event(what: str, record: EntryRecord, at: float, user: str | None) -> NewStoredEvent:
    """The event that an entry was registered, expired or removed.

    :param what: ``registered``, ``expired`` or ``removed``
    :param at: Unix seconds
    :param user: the user who did it, or did not renew it; ``None`` for the command line
    """
    data = {
        "entry": record.id,
        "entry_kind": record.kind,
        "name": record.name,
        "address": record.address,
        "registrant": record.user,
    }
    source = RELAY_SOURCE if record.robot is None else f"{RELAY_SOURCE}:{record.robot}"
    return NewStoredEvent(record.realm, at, source, what, record.robot_id, user, canonical_json(data))


# --- queries ----------------------------------------------------------------------------------------------


class EntryQuery(NamedTuple):
    """The entries that a request asks for, before rights are applied.

    :param kind: exactly this
    :param robot: pattern with shell wildcards; ``name`` as well
    :param realm: without a result if it is not the reader's own
    :param limit: most of a page
    :param after: the cursor behind which it begins
    """

    kind: str | None = None
    robot: str | None = None
    name: str = "*"
    realm: str | None = None
    limit: int = PAGE
    after: EntryCursor | None = None


Pattern = Annotated[str, Meta(max_length=TEXT)]


class EntryParameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of a search.

    :param kind: exactly of this kind
    :param robot: only about robots of this name; shell wildcards
    :param name: only of this name; shell wildcards
    :param realm: only of this realm; any but the caller's has no entries
    :param limit: most entries of a page; 100 by default
    :param after: `next` of an earlier answer, after which the page begins
    """

    kind: Pattern | UnsetType = UNSET
    robot: Pattern | UnsetType = UNSET
    name: Pattern = "*"
    realm: Pattern | UnsetType = UNSET
    limit: Annotated[int, Meta(ge=1, le=MAX_PAGE)] | UnsetType = UNSET
    after: Annotated[str, Meta(max_length=CURSOR)] | UnsetType = UNSET

    def wanted(self) -> EntryQuery:
        """The query.

        :raises Invalid: a pattern that takes too long, or a cursor that no answer gave
        """
        robot = _given(self.robot)
        for each in (robot, self.name):
            check_pattern(each or "")
        return EntryQuery(
            _given(self.kind),
            robot,
            self.name,
            _given(self.realm),
            PAGE if self.limit is UNSET else self.limit,
            None if self.after is UNSET else _cursor(self.after),
        )


def _given(text: str | UnsetType) -> str | None:
    return None if text is UNSET else text


def cursor_text(place: EntryCursor) -> str:
    """A cursor as text for ``next`` of an answer and ``after`` of a request."""
    return base64.urlsafe_b64encode(msgspec.json.encode(list(place))).decode().rstrip("=")


def _cursor(text: str) -> EntryCursor:
    try:
        if not _CURSOR.match(text):
            raise ValueError
        robot, kind, name, id = msgspec.json.decode(
            base64.urlsafe_b64decode(text + "=" * (-len(text) % 4)), type=tuple[str, str, str, str]
        )
    except (ValueError, binascii.Error, msgspec.MsgspecError):
        raise Invalid("'after' must be the 'next' of an earlier answer") from None
    return EntryCursor(robot, kind, name, id)
