"""An order to many robots, as it is asked for."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from relay_protocol.errors import Invalid
from relay_protocol.limits import NAME

ROBOTS = 64
"""Names, patterns and groups in one order."""

SECONDS = 10.0
"""What a robot has when nothing is said."""

_NOTHING = msgspec.Raw(b"{}")

Text = Annotated[str, Meta(max_length=NAME)]

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
    """Body of ``POST /api/v1/fleet``.

    :param robots: names, patterns with shell wildcards, ``group:<name>``
    :param name: of a parameter, ``<node>:<parameter>``
    :param value: of the parameter, any JSON
    :param timeout: seconds for each robot, from when its turn comes
    """

    robots: Annotated[
        list[Annotated[str, Meta(min_length=1, max_length=NAME)]], Meta(min_length=1, max_length=ROBOTS)
    ]
    do: Literal["stop", "resume", "call", "publish", "set"]
    service: Text = ""
    topic: Text = ""
    type: Text = ""
    name: Text = ""
    args: msgspec.Raw = _NOTHING
    msg: msgspec.Raw = _NOTHING
    value: msgspec.Raw = msgspec.Raw(b"")
    timeout: Annotated[float, Meta(ge=0.1, le=300.0)] = SECONDS
    why: Annotated[str, Meta(max_length=500)] = ""

    def check(self) -> None:
        """:raises Invalid: a field is missing, or does not go with what is to be done"""
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
