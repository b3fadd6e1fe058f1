"""Modules and processes, as the HTTP API answers with them."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from relay_protocol import limits, link
from relay_protocol.errors import Invalid

FASTEST_SECONDS = 0.1
SLOWEST_SECONDS = 10.0
"""Bounds of the interval between two measurements of processes for one client."""


class PendingModuleOrder(msgspec.Struct, frozen=True, kw_only=True):
    """An order that is carried out as soon as the robot is online.

    :param by: the user
    :param at: Unix time of the order, seconds
    """

    action: Literal["start", "stop"]
    by: str
    at: float


class RefusedModuleOrder(msgspec.Struct, frozen=True, kw_only=True):
    """An order that was pending, and was refused when the robot was back.

    It is shown for a day, or until the next order to the module.

    :param by: the user
    :param at: Unix time of the order, seconds
    :param why: the robot's reason, or that the user may no longer manage the module
    """

    action: Literal["start", "stop"]
    by: str
    at: float
    why: str


class ModuleStatus(link.ModuleInfo, frozen=True, kw_only=True, omit_defaults=False):
    """One module of a robot. While the robot is offline, as it was last.

    :param kind: ``command``, ``python`` or ``launch``; ``unknown``: an order names the module, and the latest report
        of the robot does not
    :param state: also ``unknown``, for the same reason
    :param pending: an order that waits for the robot
    :param refused: such an order that the robot has refused
    """

    pending: PendingModuleOrder | None = None
    refused: RefusedModuleOrder | None = None


class ModuleList(msgspec.Struct, frozen=True, kw_only=True):
    """The modules of a robot that the caller may manage.

    :param current: whether their states are those of now; else they are those of `reported_at`
    :param reported_at: when they were last known to be so, Unix time, seconds; null: the robot has never reported its
        modules, so it is not known which it has
    :param may_manage_processes: whether the caller may read the robot's processes
    """

    robot: str
    online: bool
    current: bool
    reported_at: float | None
    may_manage_processes: bool
    modules: list[ModuleStatus]


class ModuleOrderResult(msgspec.Struct, frozen=True, kw_only=True):
    """The result of an order.

    :param pending: the robot is offline or did not answer. A late answer ends the order; otherwise it is sent when the
        robot is back
    :param why: of a pending order, in words
    """

    module: str
    action: link.ModuleAction
    pending: bool
    why: str = ""


class LogQuery(msgspec.Struct, frozen=True, kw_only=True):
    """Which lines of a log are wanted; without `after` and `before` the newest.

    :param after: `next` of an earlier answer: lines from there on
    :param before: `previous` of an earlier answer: the lines in front of it
    :param level: only lines of this level or a more severe one
    :param limit: most lines
    :param wait: seconds to wait for a line, where there is none
    """

    after: Annotated[int, Meta(ge=0)] | None = None
    before: Annotated[int, Meta(ge=0)] | None = None
    level: link.LogLevel = "debug"
    limit: Annotated[int, Meta(ge=1, le=limits.LOG_LINES)] = 100
    wait: Annotated[float, Meta(ge=0, le=limits.LOG_WAIT_SECONDS)] = 0.0

    def check(self) -> None:
        """:raises Invalid: it has parameters that do not go together"""
        if self.before is not None and (self.after is not None or self.wait):
            other = "wait" if self.after is None else "after"
            raise Invalid(f"'before' does not go with '{other}'; leave one out")


class ModuleLogPage(msgspec.Struct, frozen=True, kw_only=True):
    """Lines of a module's log, oldest first. With `level` there may be none, though further pages have some.

    :param previous: `before` of the request for earlier lines; 0 if there are none
    :param next: `after` of the next request
    :param missed: lines between `after` and the first of these are no longer there
    """

    lines: list[link.LogLine]
    previous: int
    next: int
    missed: bool


class ProcessStatus(link.ProcessInfo, frozen=True, kw_only=True):
    """One process of a robot.

    :param cpu: share of one CPU since the client's previous measurement, per cent; null in its first
    """

    cpu: float | None = None


class ProcessList(msgspec.Struct, frozen=True, kw_only=True):
    """Processes of a robot's daemon and modules.

    :param at: when they were measured, Unix time at the robot, seconds
    :param more: processes beyond these
    """

    at: float
    processes: list[ProcessStatus]
    more: int
