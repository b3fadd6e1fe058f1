"""Who moves the robot: what the relay orders on the control link, and what the robot tells of it (SPEC 2.4, 2.5)."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from relay_protocol import limits
from relay_protocol.link.fields import Label, Name, Reasoned, Source, cut
from relay_protocol.message import Message

Sources = Annotated[list[Source], Meta(max_length=limits.SOURCES)]
Suppression = Annotated[int, Meta(ge=0, le=limits.SUPPRESS_MS[1])]
Inhibition = Annotated[int, Meta(ge=0, le=limits.INHIBIT_MS)]
Most = Annotated[float, Meta(gt=0, le=1e6)]


class Order(Message, frozen=True, kw_only=True):
    """Something the relay wants done, answered by one ``done``.

    :param id: the relay's number for it
    """

    id: int


class Control(Order, frozen=True, kw_only=True):
    """Relay: from now on this source holds control; 0 is nobody.

    :param user: whose connection it is, for the robot's record
    :param level: that user's level on the robot, for its limits
    """

    holder: Source = 0
    user: Label = ""
    level: Label = ""
    why: str = ""

    def __post_init__(self) -> None:
        cut(self, "why")


class Stop(Order, frozen=True, kw_only=True):
    """Relay: stop, and stay so until somebody resumes.

    :param at: Unix time it was ordered, by the relay's clock; 0: now
    """

    by: Label
    why: str = ""
    at: float = 0.0

    def __post_init__(self) -> None:
        cut(self, "why")


class Resume(Order, frozen=True, kw_only=True):
    """Relay: what was stopped may move again."""

    by: Label
    why: str = ""

    def __post_init__(self) -> None:
        cut(self, "why")


class Suppress(Order, frozen=True, kw_only=True):
    """Relay: for a time only these sources command a topic (SOM4R's suppression of an input).

    :param sources: may be none: then nobody does
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


class Inhibit(Order, frozen=True, kw_only=True):
    """Relay: for a time a topic says nothing, or its last value (SOM4R's inhibition of an output).

    :param ms: milliseconds from the moment this came; 0 ends it
    :param hold: the last value in the place of each new one
    """

    resource: Name
    ms: Inhibition = 0
    hold: bool = False
    by: Label = ""


class Done(Reasoned, frozen=True, kw_only=True):
    """Robot: the order of this id has taken effect; ``reason`` says why not when ``ok`` is false."""

    id: int
    ok: bool = True
    reason: str = ""


class Stopped(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The robot is stopped until somebody resumes it.

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


class Safety(Message, frozen=True, kw_only=True):
    """Robot: who moves me, whole; sent after ``welcome`` and whenever it changes.

    :param holder: the source that holds control, 0 for nobody
    :param moving: commands keep the robot moving
    :param limits: by level
    """

    holder: Source = 0
    moving: bool = False
    stopped: Stopped | None = None
    suppressed: Annotated[list[Suppressed], Meta(max_length=limits.FACTS)] = msgspec.field(
        default_factory=list
    )
    inhibited: Annotated[list[Inhibited], Meta(max_length=limits.FACTS)] = msgspec.field(default_factory=list)
    limits: Annotated[dict[Label, Limits], Meta(max_length=limits.FACTS)] = msgspec.field(
        default_factory=dict
    )
