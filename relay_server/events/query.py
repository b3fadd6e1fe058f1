"""Queries for events, made from the parameters of a request; and the schemas and formats of answers.

Fields of the relay's events that only readers with a further right may see (SPEC 1.14).
"""

from __future__ import annotations

import base64
import binascii
import math
import re
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Annotated, NamedTuple

import msgspec
from msgspec import Meta

from relay_db import queries
from relay_db.base import canonical_json
from relay_db.queries import EventCursor, EventSearch, NameCondition, StoredEventRecord
from relay_db.queries.event_search import LOGIN_KIND, RELAY_SOURCE
from relay_protocol.errors import Invalid
from relay_protocol.rights import Operation, Rules
from relay_server.events.limits import FIELDS, MAX_PAGE, PAGE, TEXT

DATA_FIELD = "data."
"""Prefix of parameters that name a field of the data."""

PARAMETERS = ("source", "kind", "robot", "user", "since", "until", "last", "limit", "after", "count")

_TIMES = ("since", "until", "last")
_CURSOR = re.compile(r"[A-Za-z0-9_-]{1,80}\Z")
_NUMBER = re.compile(r"[0-9]{1,12}(\.[0-9]{1,9})?\Z")


class EventQuery(NamedTuple):
    """The events that a request asks for, before rights are applied.

    :param robot: name or pattern
    :param since: Unix seconds; ``until`` is exclusive
    :param data: fields and their values
    :param limit: most events of a page
    :param after: the cursor behind which a page begins
    :param counts: whether only the count is wanted
    """

    source: NameCondition | None = None
    kind: NameCondition | None = None
    robot: NameCondition | None = None
    user: str | None = None
    since: float | None = None
    until: float | None = None
    data: tuple[tuple[str, str], ...] = ()
    limit: int = PAGE
    after: EventCursor | None = None
    counts: bool = False


def parse_query(parameters: Mapping[str, str], now: float) -> EventQuery:
    """Parse the parameters of a request.

    :param now: Unix seconds
    :raises Invalid: an unknown parameter, or one with an impossible value
    """
    unknown = [each for each in parameters if each not in PARAMETERS and not each.startswith(DATA_FIELD)]
    if unknown:
        names = ", ".join((*PARAMETERS, f"{DATA_FIELD}<field>"))
        raise Invalid(f"there is no parameter '{unknown[0][:40]}'; use {names}")
    if any(len(value) > TEXT or "\0" in value for value in (*parameters, *parameters.values())):
        raise Invalid(f"a parameter may have {TEXT} characters at most")
    since, until = _time(parameters, "since"), _time(parameters, "until")
    if "last" in parameters:
        if since is not None:
            raise Invalid("'last' and 'since' both set the beginning; send only one of them")
        since = now - _seconds(parameters["last"])
    return EventQuery(
        source=_name(parameters.get("source")),
        kind=_name(parameters.get("kind")),
        robot=_name(parameters.get("robot")),
        user=parameters.get("user"),
        since=since,
        until=until,
        data=_fields(parameters),
        limit=_limit(parameters.get("limit", str(PAGE))),
        after=_cursor(parameters["after"]) if "after" in parameters else None,
        counts=_flag(parameters.get("count", "false")),
    )


def _name(text: str | None) -> NameCondition | None:
    if text is None:
        return None
    begin, star, rest = text.partition("*")
    if rest:
        raise Invalid("a pattern may have one '*', at its end")
    return NameCondition(begin, prefix=bool(star))


def _fields(query: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    found = [(name[len(DATA_FIELD) :], value) for name, value in query.items() if name.startswith(DATA_FIELD)]
    if len(found) > FIELDS:
        raise Invalid(f"a query may name {FIELDS} fields of the data at most")
    return tuple(found)


def _time(query: Mapping[str, str], name: str) -> float | None:
    text = query.get(name)
    if text is None:
        return None
    if _NUMBER.match(text):
        return float(text)
    try:
        # An unescaped '+' in a query arrives as a blank.
        moment = datetime.fromisoformat(text.replace(" ", "+"))
        if moment.tzinfo is None or "T" not in text.upper():
            raise ValueError
        return moment.timestamp()
    except (ValueError, OverflowError):
        raise Invalid(
            f"'{name}' must be Unix seconds, or a time as 2026-03-01T12:00:00Z (RFC 3339)"
        ) from None


def _seconds(text: str) -> float:
    seconds = float(text) if _NUMBER.match(text) else math.nan
    if not seconds > 0:
        raise Invalid("'last' must be a number of seconds, more than 0")
    return seconds


def _limit(text: str) -> int:
    if (
        not text.isascii()
        or not text.isdigit()
        or len(text) > len(str(MAX_PAGE))
        or not 1 <= int(text) <= MAX_PAGE
    ):
        raise Invalid(f"'limit' must be a number from 1 to {MAX_PAGE}")
    return int(text)


def _flag(text: str) -> bool:
    if text not in ("true", "false"):
        raise Invalid("'count' must be true or false")
    return text == "true"


def cursor_text(cursor: EventCursor) -> str:
    """A cursor as text for ``next`` of an answer and ``after`` of a request."""
    return base64.urlsafe_b64encode(f"{cursor.at!r} {cursor.number}".encode()).decode().rstrip("=")


def _cursor(text: str) -> EventCursor:
    try:
        if not _CURSOR.match(text):
            raise ValueError
        at, number = base64.urlsafe_b64decode(text + "=" * (-len(text) % 4)).decode("ascii").split(" ")
        cursor = EventCursor(float(at), int(number))
        if not math.isfinite(cursor.at) or not 0 <= cursor.number < 2**63:
            raise ValueError
    except (ValueError, binascii.Error):
        raise Invalid("'after' must be the 'next' of an earlier answer") from None
    return cursor


def matching_robots(query: EventQuery, names: Mapping[int, str]) -> frozenset[int]:
    """The numbers of the robots that a query asks for.

    :param names: of robots, by their numbers
    """
    if query.robot is None:
        return frozenset(names)
    return frozenset(number for number, name in names.items() if query.robot.matches(name))


class EventInfo(msgspec.Struct):
    """A stored event (SPEC 1.14).

    :param at: Unix seconds
    :param use_count: how often queries have returned it
    """

    id: int
    source: str
    kind: str
    robot: str | None
    user: str | None
    at: float
    data: Annotated[msgspec.Raw, Meta(extra_json_schema={"type": "object"})]
    use_count: int


class EventFormatter:
    """Formats events for a reader.

    :param names: of robots that the reader may see, by their numbers
    :param rules: the reader's rights on them; without these no data is left out
    """

    COLUMNS = ("id", "at", "source", "kind", "robot", "user", "use_count", "data")

    def __init__(self, names: Mapping[int, str], rules: Mapping[int, Rules] | None = None) -> None:
        self._names = names
        self._rules = {} if rules is None else rules

    def robot(self, event: StoredEventRecord) -> str | None:
        """The name of the robot that an event is about, if the reader may see it."""
        return None if event.robot_id is None else self._names.get(event.robot_id)

    def data(self, event: StoredEventRecord) -> str:
        """The data that the reader may see, as JSON."""
        rules = None if event.robot_id is None else self._rules.get(event.robot_id)
        return event.data if rules is None else visible_data(event, rules)

    def info(self, event: StoredEventRecord) -> EventInfo:
        """As it stands in answers in JSON."""
        return EventInfo(
            id=event.number,
            source=event.source,
            kind=event.kind,
            robot=self.robot(event),
            user=event.user,
            at=event.at,
            data=msgspec.Raw(self.data(event).encode()),
            use_count=event.use_count,
        )

    def cells(self, event: StoredEventRecord) -> list[str]:
        """As cells of a table, in the order of :data:`COLUMNS`."""
        words = [
            _without_formula(each or "") for each in (event.source, event.kind, self.robot(event), event.user)
        ]
        return [str(event.number), repr(event.at), *words, str(event.use_count), self.data(event)]


class EventVisibility(NamedTuple):
    """The part of a query that a reader may see.

    :param search: for the database
    :param names: of robots on which the reader has a right, by their numbers
    :param rules: the reader's rights there
    """

    search: EventSearch
    names: Mapping[int, str]
    rules: Mapping[int, Rules] = {}

    @property
    def formatter(self) -> EventFormatter:
        """Formats events for the reader."""
        return EventFormatter(self.names, self.rules)

    @property
    def empty(self) -> bool:
        """Whether no event can match, so that no search is needed."""
        return not self.search.robots and not self.search.without_robot

    def matches(self, event: StoredEventRecord) -> bool:
        """Whether an event matches; the database's search gives the same result."""
        search = self.search
        if event.realm != search.realm or not self._may_see(event):
            return False
        return (
            (search.source is None or search.source.matches(event.source))
            and (search.kind is None or search.kind.matches(event.kind))
            and (search.user is None or search.user == event.user)
            and (search.since is None or event.at >= search.since)
            and (search.until is None or event.at < search.until)
            and (not search.data or queries.data_matches(search.data, msgspec.json.decode(event.data)))
        )

    def _may_see(self, event: StoredEventRecord) -> bool:
        if event.robot_id is not None:
            return event.robot_id in self.search.robots
        public = not event.source.startswith(RELAY_SOURCE) and not event.kind.startswith(LOGIN_KIND)
        return self.search.without_robot and (public or self.search.admin)


def _without_formula(text: str) -> str:
    """Text that no spreadsheet takes for a formula (OWASP, CSV injection): such text gets an apostrophe before it."""
    return f"'{text}" if text[:1] in _FORMULA else text


_FORMULA = frozenset("=+-@\t\r\n＝＋－＠")

NAMING_FIELDS = {
    "motion.begun": "topic",
    "publication.begun": "topic",
    "robot.suppressed": "resource",
    "robot.inhibited": "resource",
    "robot.key_used_twice": "addresses",
    "param.set": "param",
    "video.joined": "camera",
    "video.left": "camera",
    "call.begun": "service",
    "call.ended": "service",
    "goal.begun": "action",
    "goal.ended": "action",
    "module.ordered": "module",
    "module.changed": "module",
    "file.stored": "file",
    "file.deleted": "file",
}
"""The field with such a name, by kind of event."""


def _topic(rules: Rules, name: str) -> bool:
    # The robot may be offline, and then it is not known which topics carry images.
    reads = (Operation.SUBSCRIBE, Operation.VIEW)
    return _may(rules, Operation.PUBLISH, name) or all(_may(rules, each, name) for each in reads)


def _camera(rules: Rules, name: str) -> bool:
    return _may(rules, Operation.VIEW, name)


def _call(rules: Rules, name: str) -> bool:
    return _may(rules, Operation.CALL, name)


def _param(rules: Rules, name: str) -> bool:
    return _may(rules, Operation.CALL, f"{name.partition(':')[0]}/get_parameters")


def _addresses(rules: Rules, name: str) -> bool:
    return _may(rules, Operation.MANAGE, "")


def _module(rules: Rules, name: str) -> bool:
    return _may(rules, Operation.MANAGE, name)


def _file(rules: Rules, name: str) -> bool:
    return _may(rules, Operation.DOWNLOAD, f"/{name}")


def _may(rules: Rules, operation: Operation, name: str) -> bool:
    return rules.decide(operation, name).allowed


_RULES: Mapping[str, Callable[[Rules, str], bool]] = {
    "topic": _topic,
    "resource": _topic,
    "camera": _camera,
    "service": _call,
    "action": _call,
    "param": _param,
    "addresses": _addresses,
    "module": _module,
    "file": _file,
}


def visible_data(event: StoredEventRecord, rules: Rules) -> str:
    """The data of an event about a robot, without names that the reader may not use there."""
    field = NAMING_FIELDS.get(event.kind) if event.source.startswith(RELAY_SOURCE) else None
    if field is None:
        return event.data
    data = msgspec.json.decode(event.data)
    name = data.get(field)
    if not isinstance(name, str) or _RULES[field](rules, name):
        return event.data
    # Why an order to a module failed, or a module, may name modules and their settings.
    hidden = (field, "error", "why") if field == "module" else (field,)
    return canonical_json({each: value for each, value in data.items() if each not in hidden})


def may_search(rules: Rules, source: NameCondition | None, data: tuple[tuple[str, str], ...]) -> bool:
    """Whether a reader may search a robot's events for these values: a hit would reveal a name.

    :param source: searches for sources other than the relay's are always allowed
    """
    own_source = (
        source is None
        or source.text.startswith(RELAY_SOURCE)
        or (source.prefix and RELAY_SOURCE.startswith(source.text))
    )
    return not own_source or all(name not in _RULES or _RULES[name](rules, value) for name, value in data)
