"""Modules and processes of a robot, on the control link (SPEC 2.4): states, orders, logs, measurements."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from relay_protocol import limits
from relay_protocol.link.fields import Label, NameList, cut
from relay_protocol.message import Message

MODULE_NAME = r"^[a-z][a-z0-9_-]{0,62}\Z"
"""Regular expression of names of modules."""

ModuleName = Annotated[str, Meta(pattern=MODULE_NAME)]
ModuleAction = Literal["start", "stop", "restart"]
LogStream = Literal["out", "err", "runner"]
LogLevel = Literal["debug", "info", "warn", "error", "fatal"]

Request = Annotated[int, Meta(ge=0, le=2**32 - 1)]
"""Number of a request, chosen by the relay, that its answer repeats."""

Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Seconds = Annotated[float, Meta(ge=0, le=1e10)]


class ModuleInfo(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One module as it is now.

    :param kind: ``command``, ``python`` or ``launch``
    :param state: ``stopped``, ``waiting``, ``starting``, ``running``, ``stopping``, ``backing_off`` or ``failed``
    :param wanted: whether it is to run, by the latest order or because it starts with the daemon
    :param since: when it entered the state, Unix time at the robot, seconds
    :param pid: of its process, while it runs
    :param restarts: how often it was restarted since the daemon started
    :param last_exit: how its latest run ended, in words; empty before that
    :param after: modules that must be ready before it starts
    :param why: why it does not go on, in words: what it waits for, or which of its processes can't be ended
    """

    name: ModuleName
    kind: Label
    state: Label
    wanted: bool = False
    since: float = 0.0
    pid: Count | None = None
    restarts: Count = 0
    last_exit: str = ""
    after: NameList = msgspec.field(default_factory=list)
    why: str = ""

    def __post_init__(self) -> None:
        cut(self, "last_exit", "why")


class Modules(Message, frozen=True, kw_only=True):
    """Robot: all its modules; after ``welcome`` and after every change."""

    modules: Annotated[list[ModuleInfo], Meta(max_length=limits.MODULES)] = msgspec.field(
        default_factory=list
    )


class OrderModule(Message, frozen=True, kw_only=True):
    """Relay: start, stop or restart a module. The robot answers with :class:`ModuleOrdered`."""

    request: Request
    module: ModuleName
    action: ModuleAction


class ModuleOrdered(Message, frozen=True, kw_only=True):
    """Robot: an order was accepted, or why it was not. States follow as the order takes effect."""

    request: Request
    error: str = ""

    def __post_init__(self) -> None:
        cut(self, "error")


class ReadModuleLog(Message, frozen=True, kw_only=True):
    """Relay: read lines of a module's log. The robot answers with :class:`ModuleLog`.

    :param after: offset to begin at; without it and ``before`` the newest lines are read
    :param before: offset behind the last line; the newest lines in front of it are read. Not with ``after``
    :param level: only lines of this level or a more severe one
    :param most: most lines
    :param wait_s: while there are no lines, wait so many seconds for one
    """

    request: Request
    module: ModuleName
    after: Count | None = None
    before: Count | None = None
    level: LogLevel = "debug"
    most: Annotated[int, Meta(ge=1, le=limits.LOG_LINES)] = 100
    wait_s: Annotated[float, Meta(ge=0, le=limits.LOG_WAIT_SECONDS)] = 0.0


class LogLine(msgspec.Struct, frozen=True, kw_only=True):
    """One line of a module's log.

    :param at: when it was written, Unix time at the robot, seconds
    :param stream: where it was written; ``runner`` for remarks of the process that keeps the output
    :param level: as ROS 2 or Python writes it in the message that the line belongs to, else ``info``
    """

    at: float
    stream: LogStream
    level: LogLevel
    text: str


class ModuleLog(Message, frozen=True, kw_only=True):
    """Robot: lines of a log, oldest first. There may be none although ``next`` or ``previous`` leads to some.

    :param previous: ``before`` of the request for earlier lines; 0 if there are none
    :param next: offset behind the last line; ``after`` of the next request
    :param missed: lines between ``after`` and the first of these are no longer on disk
    :param error: why there are none
    """

    request: Request
    lines: Annotated[list[LogLine], Meta(max_length=limits.LOG_LINES)] = msgspec.field(default_factory=list)
    previous: Count = 0
    next: Count = 0
    missed: bool = False
    error: str = ""

    def __post_init__(self) -> None:
        cut(self, "error")


class MeasureProcesses(Message, frozen=True, kw_only=True):
    """Relay: measure all processes of the daemon and of the modules. The robot answers with :class:`Processes`.

    The relay asks again when it has the answer, so a thin link is never full of measurements.
    """

    request: Request


class ProcessInfo(msgspec.Struct, frozen=True, kw_only=True):
    """One process.

    :param name: the program; for an interpreter its script or module, without arguments. Where a launch file has named
        the node, ``node (program)``
    :param part: ``daemon``, ``guard``, ``camera``, or the module it belongs to
    :param state: ``running``, ``sleeping``, ``disk-sleep``, ``stopped``, ``zombie``, …
    :param busy: CPU time that it has used since it began, seconds
    :param read_at: when ``busy`` was read, seconds since the machine was started
    :param cpu_number: CPU it ran on last
    :param voluntary: context switches because it waited, since it began
    :param involuntary: context switches because its time was over, since it began
    :param created: when it began, Unix time, seconds
    :param memory: in RAM, bytes
    """

    pid: Count
    parent: Count
    name: Label
    part: ModuleName
    state: Label
    busy: Seconds = 0.0
    read_at: Seconds = 0.0
    cpu_number: Count | None = None
    nice: Annotated[int, Meta(ge=-20, le=19)] = 0
    threads: Count = 0
    voluntary: Count = 0
    involuntary: Count = 0
    created: float = 0.0
    memory: Count = 0


class Processes(Message, frozen=True, kw_only=True):
    """Robot: all processes of the daemon and of the modules.

    :param at: when they were measured, Unix time at the robot, seconds
    :param more: processes beyond these
    :param error: why there are none
    """

    request: Request
    at: float
    processes: Annotated[list[ProcessInfo], Meta(max_length=limits.PROCESSES)] = msgspec.field(
        default_factory=list
    )
    more: Count = 0
    error: str = ""

    def __post_init__(self) -> None:
        cut(self, "error")
