"""An order to many robots, as it is asked for."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, Refused, SwitchboardError
from relay_protocol.limits import NAME
from relay_server.channels.robot_link import resolve
from relay_server.common.freshness_tokens import NEEDED, FreshnessTokenExpired, FreshnessTokenRequired
from relay_server.control.audit import WHY, reason_in
from relay_server.fleet.selection import is_name
from relay_server.robots.registry import RobotState
from relay_server.sessions.service_calls import RESUME, moves_by


class OrderAge:
    """When one order was given.

    :param sent: a moment before which it can't have been, the relay's monotonic nanoseconds; ``None`` where nobody says
    """

    def __init__(self, order: Order, sent: int | None) -> None:
        self._order = order
        self._sent = sent

    @property
    def since(self) -> int:
        """That moment; of an order of which nobody says when it was given, one at which it is too old for anything."""
        return 0 if self._sent is None else self._sent

    def check(self, robots: list[RobotState], now: int) -> None:
        """See that the order is young enough for all robots that it moves, before anything is done.

        :param now: the relay's monotonic nanoseconds
        :raises MomentNeeded: it moves one, or lets one move again, and nobody says when it was given
        :raises TooOld: it moves one, and may have been given too long ago
        """
        moved = [robot for robot in robots if moves(robot, self._order)]
        if self._sent is None:
            if resumes(self._order):
                raise FreshnessTokenRequired(f"this lets robots move again: {NEEDED}")
            if moved:
                raise FreshnessTokenRequired(f"this moves {moved[0].name}: {NEEDED}")
        for robot in moved:
            age_ms, deadline_ms = (now - self.since) / 1e6, robot.description.motion.deadline_ms
            if age_ms > deadline_ms:
                raise FreshnessTokenExpired(
                    f"this may have been sent {age_ms:.0f} ms ago; {robot.name} takes nothing older than {deadline_ms} "
                    "ms. Give back the moment of this answer"
                )

    def check_turn(self, robot: RobotState, now: int) -> None:
        """See that it is young enough for a robot that it moves, now that this has its turn.

        :raises Refused: it may be too old
        """
        age_ms, deadline_ms = (now - self.since) / 1e6, robot.description.motion.deadline_ms
        if self._sent is None:
            raise Refused(f"this moves {robot.name}, and nobody has said when it was sent")
        if age_ms > deadline_ms:
            raise Refused(
                f"the turn of {robot.name} has come {age_ms:.0f} ms after this was sent, and it takes nothing older "
                f"than {deadline_ms} ms; give it once more for this robot"
            )


def moves(robot: RobotState, order: Order) -> bool:
    """Whether what is ordered counts as motion on a robot, as far as it has told."""
    motion = robot.description.motion
    try:
        if order.do == "call":
            return moves_by(motion, resolve(order.service))
        if order.do == "set":
            return moves_by(motion, f"{resolve(order.name.partition(':')[0])}/set_parameters")
    except SwitchboardError:
        # No name: that is told when a robot has its turn.
        return False
    return False


def resumes(order: Order) -> bool:
    """Whether it lets robots move again, in one way or the other."""
    return order.do == "resume" or (order.do == "call" and f"/{order.service.lstrip('/')}" == RESUME)


TARGETS = 1000
"""Names, patterns and groups in one order."""

PATTERNS = 64
"""Patterns and groups among them. A pattern is held against all robots there are, which takes some 7 ms for 10,000 of
them; names are looked up."""

SECONDS = 10.0
"""What a robot has when nothing is said."""

_NOTHING = msgspec.Raw(b"{}")
_NO_REASON = msgspec.Raw(b'""')

Text = Annotated[str, Meta(max_length=NAME)]
Targets = Annotated[
    list[Annotated[str, Meta(min_length=1, max_length=NAME)]], Meta(min_length=1, max_length=TARGETS)
]

_FIELDS = {
    "stop": {"why"},
    "resume": {"why"},
    "call": {"service", "type", "args", "why"},
    "publish": {"topic", "type", "msg"},
    "set": {"name", "value"},
}
"""What goes with each kind of order."""

_NEEDED = {"call": ("service",), "publish": ("topic",), "set": ("name", "value")}


class Order(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Body of ``POST /api/v1/fleet``, but for a stop: that is :class:`FleetStopOrder`.

    :param robots: names, patterns with shell wildcards, ``group:<name>``
    :param name: of a parameter, ``<node>:<parameter>``
    :param value: of the parameter, any JSON
    :param timeout: seconds for each robot, from when its turn comes
    :param reason: JSON; of a stop anything, see :attr:`why`
    """

    robots: Targets
    do: Literal["stop", "resume", "call", "publish", "set"]
    service: Text = ""
    topic: Text = ""
    type: Text = ""
    name: Text = ""
    args: msgspec.Raw = msgspec.field(default_factory=lambda: _NOTHING)
    msg: msgspec.Raw = msgspec.field(default_factory=lambda: _NOTHING)
    value: msgspec.Raw = msgspec.field(default_factory=lambda: msgspec.Raw(b""))
    timeout: Annotated[float, Meta(ge=0.1, le=300.0)] = SECONDS
    reason: msgspec.Raw = msgspec.field(default_factory=lambda: _NO_REASON, name="why")

    @property
    def why(self) -> str:
        """The reason, as far as it can be used."""
        return reason_in(self.reason)

    def check(self) -> None:
        """:raises Invalid: a field is missing, or does not go with what is to be done; too many patterns and groups"""
        if sum(not is_name(each) for each in self.robots) > PATTERNS:
            raise Invalid(f"an order may have {PATTERNS} patterns and groups at most; of names {TARGETS}")
        if self.do != "stop" and not _sound(self.reason):
            raise Invalid(f"'why' must be a string of {WHY} characters at most")
        for field in _NEEDED.get(self.do, ()):
            if not _plain(getattr(self, field)):
                raise Invalid(f"'{self.do}' needs '{field}'")
        for field, default in _DEFAULTS.items():
            if field not in _FIELDS[self.do] and _plain(getattr(self, field)) != default:
                raise Invalid(f"'{field}' does not go with '{self.do}'")

    @property
    def subject(self) -> str:
        """What it is about: a service, a topic, a parameter, or nothing."""
        return self.service or self.topic or self.name


class FleetStopOrder(msgspec.Struct, frozen=True):
    """Body of an order to stop. Whatever else it says is passed over: nothing of it is a reason to keep moving."""

    robots: Targets
    do: Literal["stop"]
    reason: msgspec.Raw = msgspec.field(default=_NO_REASON, name="why")

    @property
    def order(self) -> Order:
        """The order, as any other."""
        return Order(self.robots, self.do, reason=self.reason)


def _sound(reason: msgspec.Raw) -> bool:
    try:
        said = jsontext.decode_any(bytes(reason))
    except SwitchboardError:
        return False
    return isinstance(said, str) and len(said) <= WHY


def _plain(value: str | msgspec.Raw) -> str | bytes:
    """A field in a form that can be compared."""
    return value if isinstance(value, str) else bytes(value)


_DEFAULTS: dict[str, str | bytes] = {
    "service": "",
    "topic": "",
    "type": "",
    "name": "",
    "args": b"{}",
    "msg": b"{}",
    "value": b"",
    "why": "",
}
