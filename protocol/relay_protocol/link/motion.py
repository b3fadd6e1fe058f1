"""Motion: what moves the robot, orders about control, and what the robot reports of them (SPEC 2.4, 2.5)."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import Annotated

import msgspec
from msgspec import Meta

from relay_protocol import limits
from relay_protocol.errors import Invalid
from relay_protocol.limits import COMMAND_DEADLINE_MS, STOP_WITHIN_MS
from relay_protocol.link.fields import Label, Name, NameList, Reasoned, Source, cut
from relay_protocol.message import Message
from relay_protocol.wildcards import check_pattern

Sources = Annotated[list[Source], Meta(max_length=limits.SOURCES)]
Suppression = Annotated[int, Meta(ge=0, le=limits.SUPPRESS_MS[1])]
Inhibition = Annotated[int, Meta(ge=0, le=limits.INHIBIT_MS)]
Most = Annotated[float, Meta(gt=0, le=1e6)]


SEND_GOAL = "/_action/send_goal"
"""Suffix of the name of the service that accepts the goals of an action (design.ros2.org, actions)."""


class MotionPolicy(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What the robot treats as motion, and its time limits. The robot decides both.

    :param types: message types whose topics are motion topics
    :param topics: further motion topics, by name patterns (shell wildcards, as in rights)
    :param services: patterns of services that move the robot
    :param actions: patterns of actions that move the robot
    :param deadline_ms: older commands are dropped, milliseconds
    :param stop_within_ms: the robot stands still this long after its last valid command, milliseconds
    """

    types: NameList = msgspec.field(default_factory=list)
    topics: NameList = msgspec.field(default_factory=list)
    services: NameList = msgspec.field(default_factory=list)
    actions: NameList = msgspec.field(default_factory=list)
    deadline_ms: int = COMMAND_DEADLINE_MS
    stop_within_ms: int = STOP_WITHIN_MS

    def __post_init__(self) -> None:
        try:
            for each in (*self.topics, *self.services, *self.actions):
                check_pattern(each)
        except Invalid as error:
            # msgspec reports a ValueError as a fault of the message.
            raise ValueError(str(error)) from None

    def moves_by_topic(self, topic: str, type: str) -> bool:
        """Whether messages on this topic move the robot."""
        return type in self.types or _any(self.topics, topic)

    def moves_by_service(self, service: str) -> bool:
        """Whether calls of this service move the robot. One that accepts the goals of an action moves it as they do."""
        return _any(self.services, service) or (
            service.endswith(SEND_GOAL) and self.moves_by_action(service.removesuffix(SEND_GOAL))
        )

    def moves_by_action(self, action: str) -> bool:
        """Whether goals of this action move the robot."""
        return _any(self.actions, action)


def _any(patterns: list[str], name: str) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


class ControlOrder(Message, frozen=True, kw_only=True):
    """An order about control, answered by one ``order_result``.

    :param id: the relay's number for it
    """

    id: int


class ControlGrant(ControlOrder, frozen=True, kw_only=True):
    """Relay: from now on this source holds control; 0 is none.

    :param user: whose connection it is, for the robot's record
    :param level: that user's level on the robot, for its limits
    """

    holder: Source = 0
    user: Label = ""
    level: Label = ""
    why: str = ""

    def __post_init__(self) -> None:
        cut(self, "why")


class Stop(ControlOrder, frozen=True, kw_only=True):
    """Relay: stop, and stay so until it is resumed.

    :param at: Unix time it was ordered, by the relay's clock; 0: now
    """

    by: Label
    why: str = ""
    at: float = 0.0

    def __post_init__(self) -> None:
        cut(self, "why")


class Resume(ControlOrder, frozen=True, kw_only=True):
    """Relay: what was stopped may move again."""

    by: Label
    why: str = ""

    def __post_init__(self) -> None:
        cut(self, "why")


class Suppress(ControlOrder, frozen=True, kw_only=True):
    """Relay: for a time only these sources command a topic (SOM4R's suppression of an input).

    :param sources: an empty list: no source commands it
    :param ms: milliseconds from the moment this came, 50 to 200; 0 ends it
    """

    resource: Name
    sources: Sources = msgspec.field(default_factory=list)
    ms: Suppression = 0
    by: Label = ""

    def __post_init__(self) -> None:
        least = limits.SUPPRESS_MS[0]
        if 0 < self.ms < least:
            raise ValueError(f"ms must be 0, or {least} to {limits.SUPPRESS_MS[1]}, not {self.ms}")


class Inhibit(ControlOrder, frozen=True, kw_only=True):
    """Relay: for a time a topic says nothing, or its last value (SOM4R's inhibition of an output).

    :param ms: milliseconds from the moment this came; 0 ends it
    :param hold: the last value in the place of each new one
    """

    resource: Name
    ms: Inhibition = 0
    hold: bool = False
    by: Label = ""


class OrderResult(Reasoned, frozen=True, kw_only=True):
    """Robot: the order of this id has taken effect; ``reason`` says why not when ``ok`` is false."""

    id: int
    ok: bool = True
    reason: str = ""


class Stopped(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The robot is stopped until it is resumed.

    :param since: Unix time at the robot, seconds
    """

    by: Label
    since: float
    why: str = ""

    def __post_init__(self) -> None:
        cut(self, "why")


class Suppressed(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A topic commanded by others than the holder.

    :param ms: milliseconds that are left
    """

    resource: Name
    ms: int
    sources: Sources = msgspec.field(default_factory=list)
    by: Label = ""


class Inhibited(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A topic that says nothing, or its last value.

    :param ms: milliseconds that are left
    """

    resource: Name
    ms: int
    hold: bool = False
    by: Label = ""


class Limits(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How fast a level may move the robot; ``None`` is without a limit.

    :param linear: metres per second
    :param angular: radians per second
    :param linear_acceleration: metres per second, each second
    :param angular_acceleration: radians per second, each second
    """

    linear: Most | None = None
    angular: Most | None = None
    linear_acceleration: Most | None = None
    angular_acceleration: Most | None = None


class MotionState(Message, frozen=True, kw_only=True):
    """Robot: who moves me, whole; sent after ``welcome`` and whenever it changes.

    :param holder: the source that holds control, 0 for none
    :param moving: commands keep the robot moving
    :param limits: by level
    """

    holder: Source = 0
    moving: bool = False
    stopped: Stopped | None = None
    suppressed: Annotated[list[Suppressed], Meta(max_length=limits.LIST_ITEMS)] = msgspec.field(
        default_factory=list
    )
    inhibited: Annotated[list[Inhibited], Meta(max_length=limits.LIST_ITEMS)] = msgspec.field(
        default_factory=list
    )
    limits: Annotated[dict[Label, Limits], Meta(max_length=limits.LIST_ITEMS)] = msgspec.field(
        default_factory=dict
    )
