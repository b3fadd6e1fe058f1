"""What is asked of the memory, from the parameters of a request; and the forms in which events are told."""

from __future__ import annotations

import base64
import binascii
import math
import re
from collections.abc import Mapping
from datetime import datetime
from typing import Any, NamedTuple

import msgspec

from relay_db.queries import EventCursor, NameIs, StoredEventRecord
from relay_protocol.errors import Invalid
from relay_protocol.rights import Rules
from relay_server.events import visibility
from relay_server.events.limits import FIELDS, LONGEST, PAGE, TEXT

DATA_FIELD = "data."
"""A parameter that begins so asks for a field of the data."""

PARAMETERS = ("source", "kind", "robot", "user", "since", "until", "last", "limit", "after", "count")

_TIMES = ("since", "until", "last")
_PLACE = re.compile(r"[A-Za-z0-9_-]{1,80}\Z")
_NUMBER = re.compile(r"[0-9]{1,12}(\.[0-9]{1,9})?\Z")


class EventQuery(NamedTuple):
    """Which events are wanted, whatever of them may be seen.

    :param robot: name or pattern
    :param since: Unix seconds; ``until`` is the first moment after
    :param data: fields and their values
    :param limit: most events of a page
    :param after: the place behind which a page begins
    :param counts: how many there are is wanted, and nothing else
    """

    source: NameIs | None = None
    kind: NameIs | None = None
    robot: NameIs | None = None
    user: str | None = None
    since: float | None = None
    until: float | None = None
    data: tuple[tuple[str, str], ...] = ()
    limit: int = PAGE
    after: EventCursor | None = None
    counts: bool = False


def ask_of(query: Mapping[str, str], now: float) -> EventQuery:
    """From the parameters of a request.

    :param now: Unix seconds
    :raises Invalid: one that there is not, or with a value that it can't have
    """
    strange = [each for each in query if each not in PARAMETERS and not each.startswith(DATA_FIELD)]
    if strange:
        names = ", ".join((*PARAMETERS, f"{DATA_FIELD}<field>"))
        raise Invalid(f"there is no parameter '{strange[0][:40]}'; there are {names}")
    if any(len(value) > TEXT or "\0" in value for value in (*query, *query.values())):
        raise Invalid(f"a parameter may have {TEXT} characters at most")
    since, until = _moment(query, "since"), _moment(query, "until")
    if "last" in query:
        if since is not None:
            raise Invalid("'last' and 'since' say the same; give one of them")
        since = now - _seconds(query["last"])
    return EventQuery(
        source=_name(query.get("source")),
        kind=_name(query.get("kind")),
        robot=_name(query.get("robot")),
        user=query.get("user"),
        since=since,
        until=until,
        data=_fields(query),
        limit=_limit(query.get("limit", str(PAGE))),
        after=_place(query["after"]) if "after" in query else None,
        counts=_yes(query.get("count", "false")),
    )


def _name(text: str | None) -> NameIs | None:
    if text is None:
        return None
    begin, star, rest = text.partition("*")
    if rest:
        raise Invalid("a pattern is the beginning of a name, with '*' at its end")
    return NameIs(begin, prefix=bool(star))


def _fields(query: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    found = [(name[len(DATA_FIELD) :], value) for name, value in query.items() if name.startswith(DATA_FIELD)]
    if len(found) > FIELDS:
        raise Invalid(f"a query may name {FIELDS} fields of the data at most")
    return tuple(found)


def _moment(query: Mapping[str, str], name: str) -> float | None:
    text = query.get(name)
    if text is None:
        return None
    if _NUMBER.match(text):
        return float(text)
    try:
        # In a query '+' is a blank where nobody has escaped it.
        moment = datetime.fromisoformat(text.replace(" ", "+"))
        if moment.tzinfo is None or "T" not in text.upper():
            raise ValueError
        return moment.timestamp()
    except (ValueError, OverflowError):
        raise Invalid(f"'{name}' is a moment: Unix seconds, or as 2026-03-01T12:00:00Z (RFC 3339)") from None


def _seconds(text: str) -> float:
    seconds = float(text) if _NUMBER.match(text) else math.nan
    if not seconds > 0:
        raise Invalid("'last' is a number of seconds, more than 0")
    return seconds


def _limit(text: str) -> int:
    if (
        not text.isascii()
        or not text.isdigit()
        or len(text) > len(str(LONGEST))
        or not 1 <= int(text) <= LONGEST
    ):
        raise Invalid(f"'limit' must be a number from 1 to {LONGEST}")
    return int(text)


def _yes(text: str) -> bool:
    if text not in ("true", "false"):
        raise Invalid("'count' is true or false")
    return text == "true"


def place_text(place: EventCursor) -> str:
    """A place as the next request gives it back."""
    return base64.urlsafe_b64encode(f"{place.at!r} {place.number}".encode()).decode().rstrip("=")


def _place(text: str) -> EventCursor:
    try:
        if not _PLACE.match(text):
            raise ValueError
        at, number = base64.urlsafe_b64decode(text + "=" * (-len(text) % 4)).decode("ascii").split(" ")
        place = EventCursor(float(at), int(number))
        if not math.isfinite(place.at) or not 0 <= place.number < 2**63:
            raise ValueError
    except (ValueError, binascii.Error):
        raise Invalid("'after' is what an answer gave as 'next'") from None
    return place


def chosen(ask: EventQuery, names: Mapping[int, str]) -> frozenset[int]:
    """Which of these robots, by number and name, are meant."""
    if ask.robot is None:
        return frozenset(names)
    return frozenset(number for number, name in names.items() if ask.robot.fits(name))


class EventFormatter:
    """Events as they are told.

    :param names: of robots that may be seen, by their numbers
    :param rules: by which those are seen; without them all is told
    """

    COLUMNS = ("id", "at", "source", "kind", "robot", "user", "used", "data")

    def __init__(self, names: Mapping[int, str], rules: Mapping[int, Rules] | None = None) -> None:
        self._names = names
        self._rules = {} if rules is None else rules

    def robot(self, event: StoredEventRecord) -> str | None:
        """The name of the robot that an event is about."""
        return None if event.robot_id is None else self._names.get(event.robot_id)

    def data(self, event: StoredEventRecord) -> str:
        """What it says, as JSON."""
        rules = None if event.robot_id is None else self._rules.get(event.robot_id)
        return event.data if rules is None else visibility.told(event, rules)

    def json(self, event: StoredEventRecord) -> dict[str, Any]:
        """For an answer."""
        return {
            "id": event.number,
            "source": event.source,
            "kind": event.kind,
            "robot": self.robot(event),
            "user": event.user,
            "at": event.at,
            "data": msgspec.Raw(self.data(event).encode()),
            "used": event.used,
        }

    def cells(self, event: StoredEventRecord) -> list[str]:
        """For a table, in the order of :data:`COLUMNS`."""
        words = [_inert(each or "") for each in (event.source, event.kind, self.robot(event), event.user)]
        return [str(event.number), repr(event.at), *words, str(event.used), self.data(event)]


def _inert(text: str) -> str:
    """Text that no table takes for a formula (OWASP, CSV injection): it is told with an apostrophe before it."""
    return f"'{text}" if text[:1] in _FORMULA else text


_FORMULA = frozenset("=+-@\t\r\n＝＋－＠")
