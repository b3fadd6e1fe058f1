"""What is registered, how it is told, and what is asked of the directory, from the parameters of a request."""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple
from urllib.parse import parse_qsl, urlsplit

import msgspec
from msgspec import Meta

from relay_db.base import canonical_json
from relay_db.models import LABEL, SOURCE
from relay_db.queries import EntryCursor, EntryRecord, NewStoredEvent
from relay_db.queries.event_search import OURS
from relay_protocol import jsontext
from relay_protocol.errors import Invalid
from relay_protocol.limits import ROBOT_NAME
from relay_protocol.text import legible
from relay_protocol.wildcards import see_cheap
from relay_server.registry.limits import ADDRESS, DATA, KIND, LONGEST, MOST, PAGE, PLACE, SHORTEST, TEXT, TTL

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

RUNS = frozenset({"about", "blob", "data", "file", "filesystem", "javascript", "vbscript", "view-source"})
"""Schemes by which a link in a page would run something, or look into the reader's own machine."""

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
        if parts.scheme in RUNS:
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

OWN = ("action", "camera", "module", "robot", SERVICE, "topic")
"""Kinds of what robots have, in the order of their names."""

PARAMETERS = ("kind", "robot", "name", "realm", "limit", "after")

_KIND = re.compile(r"[a-z][a-z0-9_.-]*\Z")
_PLACE = re.compile(r"[A-Za-z0-9_-]+\Z")


class TooLarge(Invalid):
    """What should be registered has too much data."""

    code = "too_large"


class Registration(msgspec.Struct, forbid_unknown_fields=True):
    """Body of what registers or changes an entry.

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
    ttl: Annotated[float, Meta(ge=SHORTEST, le=LONGEST)] = TTL


def check_words(new: Registration) -> None:
    """See that names can be, and are not what the relay tells of robots.

    :raises Invalid: they can't
    """
    if not _KIND.match(new.kind):
        raise Invalid("'kind' has lower-case letters, digits, '-', '_' and '.', and begins with a letter")
    if new.kind in OWN and new.kind != SERVICE:
        raise Invalid(
            f"what is of the kind '{new.kind}' the directory knows from robots; nobody registers it"
        )
    for what, text in (("name", new.name), ("description", new.description)):
        if not legible(text):
            raise Invalid(f"'{what}' must be one printable line")
    if new.name != new.name.strip():
        raise Invalid("'name' must not begin or end with a blank")


def data_text(data: msgspec.Raw) -> str:
    """The data of an entry as it is kept.

    :raises Invalid: it is no object
    :raises TooLarge: it is too large
    :raises MalformedMessage: it is no JSON
    """
    value = jsontext.decode_any(bytes(data))
    if not isinstance(value, dict):
        raise Invalid("'data' is a JSON object")
    try:
        text = canonical_json(value)
    except (ValueError, RecursionError):
        raise Invalid("'data' can't be kept as JSON") from None
    if len(text) > DATA:
        raise TooLarge(f"'data' may have {DATA} characters at most, as JSON in ASCII")
    return text


class RegistryEntry(NamedTuple):
    """Something in the directory, as it is told.

    :param data: JSON
    :param user: who registered it; ``None`` for what robots have, as of all that follows
    :param expires: Unix seconds
    """

    id: str
    kind: str
    name: str
    robot: str | None
    address: str
    description: str = ""
    data: bytes = b"{}"
    user: str | None = None
    ttl: float | None = None
    registered: float | None = None
    expires: float | None = None

    @classmethod
    def of(cls, record: EntryRecord, now: float) -> RegistryEntry:
        """Of what was registered.

        :param now: Unix seconds; no lease lasts longer from now on than it was given
        """
        return cls(
            record.id,
            record.kind,
            record.name,
            record.robot,
            record.address,
            record.description,
            record.data.encode(),
            record.user,
            record.ttl,
            record.registered,
            min(record.expires, now + record.ttl),
        )

    @property
    def place(self) -> EntryCursor:
        """Where it stands among others."""
        return EntryCursor(self.robot or "", self.kind, self.name, self.id)

    def told(self) -> dict[str, Any]:
        """For an answer."""
        times = {"registered": self.registered, "expires": self.expires}
        return {
            **self._asdict(),
            "data": msgspec.Raw(self.data),
            **{name: value and round(value, 3) for name, value in times.items()},
        }


def event(what: str, record: EntryRecord, at: float, user: str | None) -> NewStoredEvent:
    """What the memory is told of an entry: it came, or went.

    :param what: ``registered``, ``expired`` or ``removed``
    :param at: Unix seconds
    :param user: who did it, or let it happen; ``None`` for the administrator of the relay's machine
    """
    data = {
        "entry": record.id,
        "entry_kind": record.kind,
        "name": record.name,
        "address": record.address,
        "registrant": record.user,
    }
    source = OURS if record.robot is None else f"{OURS}:{record.robot}"
    return NewStoredEvent(record.realm, at, source, what, record.robot_id, user, canonical_json(data))


# --- what is asked ----------------------------------------------------------------------------------------


class EntryQuery(NamedTuple):
    """Which entries are wanted, whatever of them may be seen.

    :param kind: exactly this
    :param robot: pattern with shell wildcards; ``name`` as well
    :param realm: of another than one's own there is nothing
    :param limit: most of a page
    :param after: the place behind which it begins
    """

    kind: str | None = None
    robot: str | None = None
    name: str = "*"
    realm: str | None = None
    limit: int = PAGE
    after: EntryCursor | None = None


def ask_of(query: Mapping[str, str]) -> EntryQuery:
    """From the parameters of a request.

    :raises Invalid: one that there is not, or with a value that it can't have
    """
    strange = query.keys() - set(PARAMETERS)
    if strange:
        raise Invalid(f"there is no parameter '{min(strange)[:40]}'; there are {', '.join(PARAMETERS)}")
    if any(len(text) > (PLACE if name == "after" else TEXT) for name, text in query.items()):
        raise Invalid(f"a parameter may have {TEXT} characters at most")
    for name in ("robot", "name"):
        see_cheap(query.get(name, ""))
    limit = query.get("limit", str(PAGE))
    if not (limit.isascii() and limit.isdigit() and len(limit) <= len(str(MOST)) and 1 <= int(limit) <= MOST):
        raise Invalid(f"'limit' must be a number from 1 to {MOST}")
    return EntryQuery(
        query.get("kind"),
        query.get("robot"),
        query.get("name", "*"),
        query.get("realm"),
        int(limit),
        _place(query["after"]) if "after" in query else None,
    )


def place_text(place: EntryCursor) -> str:
    """A place as the next request gives it back."""
    return base64.urlsafe_b64encode(msgspec.json.encode(list(place))).decode().rstrip("=")


def _place(text: str) -> EntryCursor:
    try:
        if not _PLACE.match(text):
            raise ValueError
        robot, kind, name, id = msgspec.json.decode(
            base64.urlsafe_b64decode(text + "=" * (-len(text) % 4)), type=tuple[str, str, str, str]
        )
    except (ValueError, binascii.Error, msgspec.MsgspecError):
        raise Invalid("'after' is what an answer gave as 'next'") from None
    return EntryCursor(robot, kind, name, id)
