"""Orders to many robots: what they ask for, and what the HTTP API answers."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Annotated, Any, Literal, NamedTuple, TypedDict

import msgspec
from msgspec import Meta

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, Refused, SwitchboardError
from relay_protocol.limits import KIB, NAME, REASON_LENGTH
from relay_protocol.wildcards import check_pattern
from relay_server.channels.names import resolve
from relay_server.common.freshness_tokens import NEEDED, FreshnessTokenExpired, FreshnessTokenRequired
from relay_server.control.stop_fields import reason_in, stop_id_in
from relay_server.robots.registry import RobotState
from relay_server.sessions.service_calls import RESUME


class RobotGroupInfo(TypedDict):
    """A group of robots, with those the caller has a right on."""

    name: str
    robots: list[str]


class RobotGroupList(TypedDict):
    """Groups of robots."""

    groups: list[RobotGroupInfo]


class FleetOrderStart(msgspec.Struct, frozen=True, omit_defaults=True):
    """The first line of an answer: the robots that the order is for.

    :param do: the kind of order
    :param unmatched: names, patterns and groups that match no robot
    :param missed: why the order may be for more robots, which could not be looked up; left out otherwise
    """

    do: Literal["stop", "resume", "call", "publish", "set", "module"]
    robots: list[str]
    unmatched: list[str]
    missed: str = ""


class FleetRobotResult(msgspec.Struct, frozen=True):
    """One line for each robot, as soon as its result is known.

    :param message: why the order failed, or the robot's report
    :param values: the response of a service
    :param pending: whether it will be done as soon as the robot is online
    :param seconds: how long it took
    """

    robot: str
    ok: bool
    message: str
    values: Any
    pending: bool
    seconds: float


class FleetOrderEnd(msgspec.Struct, frozen=True):
    """The last line of a complete answer.

    :param robots: how many the order was for
    :param ok: how many carried it out
    :param failed: how many did not
    :param seconds: how long it took
    """

    done: Literal[True]
    robots: int
    ok: int
    failed: int
    seconds: float


# --- orders ------------------------------------------------------------------------------------------------

MAX_TARGETS = 1000
"""Names, patterns and groups in one order."""

MAX_PATTERNS = 64
"""Patterns and groups among them. A pattern is compared with every robot, which takes about 7 ms for 10,000
of them; names are looked up."""

SECONDS = 10.0
"""Default time for each robot."""

_NOTHING = msgspec.Raw(b"{}")
_NO_REASON = msgspec.Raw(b'""')

Text = Annotated[str, Meta(max_length=NAME)]
Targets = Annotated[
    list[Annotated[str, Meta(min_length=1, max_length=NAME)]], Meta(min_length=1, max_length=MAX_TARGETS)
]

_FIELDS = {
    "stop": {"why", "stop_id"},
    "resume": {"why"},
    "call": {"service", "type", "args", "why"},
    "publish": {"topic", "type", "msg"},
    "set": {"name", "value"},
    "module": {"module", "action"},
}
"""The fields that each kind of order may have."""

_NEEDED = {
    "call": ("service",),
    "publish": ("topic",),
    "set": ("name", "value"),
    "module": ("module", "action"),
}


_ATTRIBUTES = {"why": "reason", "stop_id": "request"}
"""Names of the attributes of :class:`Order` that differ from those of its fields."""


class Order(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Body of ``POST /api/v1/fleet``, but for a stop: that is :class:`FleetStopOrder`.

    :param robots: names, patterns with shell wildcards, ``group:<name>``
    :param name: of a parameter, ``<node>:<parameter>``
    :param value: of the parameter, any JSON
    :param module: name of a module
    :param action: what is done with the module
    :param timeout: seconds for each robot, from when its turn comes
    :param reason: JSON; of a stop anything, see :attr:`why`
    :param request: JSON, the id of a stop as its client made it, see :attr:`stop_id`
    """

    robots: Targets
    do: Literal["stop", "resume", "call", "publish", "set", "module"]
    service: Text = ""
    topic: Text = ""
    type: Text = ""
    name: Text = ""
    module: Text = ""
    action: Literal["", "start", "stop", "restart"] = ""
    args: msgspec.Raw = msgspec.field(default_factory=lambda: _NOTHING)
    msg: msgspec.Raw = msgspec.field(default_factory=lambda: _NOTHING)
    value: msgspec.Raw = msgspec.field(default_factory=lambda: msgspec.Raw(b""))
    timeout: Annotated[float, Meta(ge=0.1, le=300.0)] = SECONDS
    reason: msgspec.Raw = msgspec.field(default_factory=lambda: _NO_REASON, name="why")
    request: msgspec.Raw = msgspec.field(default_factory=lambda: _NO_REASON, name="stop_id")

    @property
    def stop_id(self) -> str:
        """The id of a stop, as far as it can be used."""
        return stop_id_in(self.request)

    @property
    def why(self) -> str:
        """The reason, as far as it can be used."""
        return reason_in(self.reason)

    def check(self) -> None:
        """:raises Invalid: a field is missing or does not go with the kind of order, or there are too many
        patterns and groups"""
        if sum(not is_name(each) for each in self.robots) > MAX_PATTERNS:
            raise Invalid(
                f"an order may have at most {MAX_PATTERNS} patterns and groups, and {MAX_TARGETS} names"
            )
        if self.do != "stop" and not _is_valid_reason(self.reason):
            raise Invalid(f"'why' must be a string of at most {REASON_LENGTH} characters")
        for field in _NEEDED.get(self.do, ()):
            if not _comparable(getattr(self, field)):
                raise Invalid(f"'{self.do}' needs '{field}'")
        for field, default in _DEFAULTS.items():
            if field not in _FIELDS[self.do] and _comparable(getattr(self, field)) != default:
                raise Invalid(f"'{field}' does not go with '{self.do}'")

    @property
    def subject(self) -> str:
        """The service, topic, parameter or module of the order; empty for a stop or resume."""
        return self.service or self.topic or self.name or f"{self.action} {self.module}".strip()


def body_of(order: Order, robots: Sequence[str]) -> bytes:
    """The body of the same order to some of its robots."""
    body: dict[str, Any] = {"robots": robots, "do": order.do}
    if order.do != "stop":
        body["timeout"] = order.timeout
    for field in sorted(_FIELDS[order.do]):
        value = getattr(order, _ATTRIBUTES.get(field, field))
        if _comparable(value):
            body[field] = value
    return msgspec.json.encode(body)


class FleetStopOrder(msgspec.Struct, frozen=True):
    """Body of an order to stop. Other fields are ignored, since no mistake in them may keep a robot moving."""

    robots: Targets
    do: Literal["stop"]
    reason: msgspec.Raw = msgspec.field(default=_NO_REASON, name="why")
    request: msgspec.Raw = msgspec.field(default=_NO_REASON, name="stop_id")

    @property
    def order(self) -> Order:
        return Order(self.robots, self.do, reason=self.reason, request=self.request)


def _is_valid_reason(reason: msgspec.Raw) -> bool:
    try:
        said = jsontext.decode_any(bytes(reason))
    except SwitchboardError:
        return False
    return isinstance(said, str) and len(said) <= REASON_LENGTH


def _comparable(value: str | msgspec.Raw) -> str | bytes:
    return value if isinstance(value, str) else bytes(value)


_DEFAULTS: dict[str, str | bytes] = {
    "service": "",
    "topic": "",
    "type": "",
    "name": "",
    "args": b"{}",
    "msg": b"{}",
    "value": b"",
    "module": "",
    "action": "",
    "why": "",
    "stop_id": "",
}


# --- which robots ------------------------------------------------------------------------------------------

GROUP = "group:"
"""Prefix of a group's name in an order. No robot's name has a colon."""


WILDCARDS = frozenset("*?[")
"""One of these makes a pattern of a name."""


def is_name(asked: str) -> bool:
    """Whether a target is the name of one robot, and neither a pattern nor a group."""
    return not asked.startswith(GROUP) and WILDCARDS.isdisjoint(asked)


class Selection(NamedTuple):
    """The robots of an order.

    :param robots: names, each once, sorted
    :param unmatched: targets that match no robot
    """

    robots: list[str]
    unmatched: list[str]


def select_robots(
    asked: Iterable[str], robots: Collection[str], groups: Mapping[str, Collection[str]]
) -> Selection:
    """Find the robots of an order.

    :param asked: names, patterns with shell wildcards, ``group:<name>``
    :param robots: names of the robots to choose from
    :param groups: names of the robots of each group, by the group's name in lower case
    :raises Invalid: a pattern that is too expensive
    """
    known = set(robots)
    found: set[str] = set()
    unmatched = []
    for each in dict.fromkeys(asked):
        if each.startswith(GROUP):
            these = known & set(groups.get(each.removeprefix(GROUP).lower(), ()))
        elif each in known or is_name(each):
            # A thousand names must not each be compared with all robots.
            these = known & {each}
        else:
            check_pattern(each)
            these = {name for name in known if fnmatchcase(name, each)}
        found |= these
        if not these:
            unmatched.append(each)
    return Selection(sorted(found), unmatched)


# --- how old an order may be -------------------------------------------------------------------------------


class OrderAge:
    """When an order was given.

    :param earliest_sent: see :class:`relay_server.sessions.message_age.MessageAge`; ``None``: unknown
    """

    def __init__(self, order: Order, earliest_sent: int | None) -> None:
        self._order = order
        self._earliest_sent = earliest_sent

    @property
    def earliest_sent(self) -> int:
        """The same, but 0 if unknown: an order of unknown age counts as too old for anything."""
        return 0 if self._earliest_sent is None else self._earliest_sent

    def check(self, robots: list[RobotState], now: int) -> None:
        """Check, before anything is done, that the order is recent enough for all robots that it moves.

        :param now: the relay's monotonic nanoseconds
        :raises FreshnessTokenRequired: it moves a robot, or lets one move again, and its age is unknown
        :raises FreshnessTokenExpired: it moves a robot, and may be too old
        """
        moved = [robot for robot in robots if moves(robot, self._order)]
        if self._earliest_sent is None:
            if resumes(self._order):
                raise FreshnessTokenRequired(f"this lets robots move again: {NEEDED}")
            if moved:
                raise FreshnessTokenRequired(f"this moves {moved[0].name}: {NEEDED}")
        for robot in moved:
            age_ms, deadline_ms = (now - self.earliest_sent) / 1e6, robot.description.motion.deadline_ms
            if age_ms > deadline_ms:
                raise FreshnessTokenExpired(
                    f"this may have been sent {age_ms:.0f} ms ago; {robot.name} takes nothing older than {deadline_ms} "
                    "ms. Send it again with the freshness token of this answer"
                )

    def check_turn(self, robot: RobotState, now: int) -> None:
        """Check that it is recent enough for a robot that it moves, now that the robot's turn has come.

        :raises Refused: it may be too old
        """
        age_ms, deadline_ms = (now - self.earliest_sent) / 1e6, robot.description.motion.deadline_ms
        if self._earliest_sent is None:
            raise Refused(f"this moves {robot.name}, and its age is not known")
        if age_ms > deadline_ms:
            raise Refused(
                f"the turn of {robot.name} came {age_ms:.0f} ms after this was sent, and it takes nothing older "
                f"than {deadline_ms} ms; send it again for this robot"
            )


def moves(robot: RobotState, order: Order) -> bool:
    """Whether an order counts as motion on a robot, as far as the robot has reported."""
    motion = robot.description.motion
    try:
        if order.do == "call":
            return motion.moves_by_service(resolve(order.service))
        if order.do == "set":
            return motion.moves_by_service(f"{resolve(order.name.partition(':')[0])}/set_parameters")
    except SwitchboardError:
        # Not a valid name. The error is reported when the robot's turn comes.
        return False
    return False


def resumes(order: Order) -> bool:
    """Whether an order lets robots move again, by either way."""
    return order.do == "resume" or (order.do == "call" and f"/{order.service.lstrip('/')}" == RESUME)


# --- results -----------------------------------------------------------------------------------------------

VALUES_BYTES = 64 * KIB
"""A longer response of one robot is not passed on."""


@dataclass(frozen=True)
class TaskOutcome:
    """The result of an order on one robot.

    :param message: why it failed, or the robot's report
    :param values: the response of a service
    :param pending: it will be done as soon as the robot is back
    """

    ok: bool
    message: str = ""
    values: Any = None
    pending: bool = False

    @classmethod
    def from_service(cls, values: Any) -> TaskOutcome:
        """The outcome of a service call. A response with ``success: false`` counts as failed."""
        said = values if isinstance(values, dict) else {}
        message = said.get("message")
        ok = said.get("success") is not False
        if len(jsontext.encode(values)) > VALUES_BYTES:
            return cls(ok, f"the answer has more than {VALUES_BYTES // KIB} KiB and is not shown")
        words = message if isinstance(message, str) else ""
        return cls(ok, words if ok else words or "the service reports that it did not succeed", values)


@dataclass(frozen=True)
class TaskResult:
    """The outcome on one robot.

    :param seconds: how long it took
    """

    robot: str
    outcome: TaskOutcome
    seconds: float

    @property
    def line(self) -> FleetRobotResult:
        """The line of the HTTP response."""
        outcome = self.outcome
        return FleetRobotResult(
            robot=self.robot,
            ok=outcome.ok,
            message=outcome.message,
            values=outcome.values,
            pending=outcome.pending,
            seconds=round(self.seconds, 3),
        )
