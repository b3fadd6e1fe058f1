"""The control link (SPEC 2.4), the first link of a robot: what it reports, and the relay's orders to open channels.

Control of motion is in :mod:`relay_protocol.link.motion`.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import Meta

from relay_protocol import limits
from relay_protocol.link.common import Bye, Ping, Pong
from relay_protocol.link.fields import Label, Name, NodeList, cut
from relay_protocol.link.files import OpenFileLink, RequestFileLink
from relay_protocol.link.modules import (
    MeasureProcesses,
    ModuleLog,
    ModuleOrdered,
    Modules,
    OrderModule,
    Processes,
    ReadModuleLog,
)
from relay_protocol.link.motion import (
    ControlGrant,
    Inhibit,
    MotionPolicy,
    MotionState,
    OrderResult,
    Resume,
    Stop,
    Suppress,
)
from relay_protocol.link.video import Cameras, CloseVideo, OpenVideo
from relay_protocol.message import Message


class Describe(Message, frozen=True, kw_only=True):
    """Robot: all facts about itself; sent after ``welcome`` and after every change.

    :param platform: ``ros2``, ``mqtt``, …
    :param distro: ROS distribution, e.g. ``jazzy``
    :param started: when the daemon started, Unix time, seconds
    :param sim_time: the robot uses ``/clock`` (``use_sim_time``)
    :param extra: further facts for display
    """

    host: Label = ""
    platform: Label = ""
    distro: Label = ""
    os: Label = ""
    agent: Label = ""
    started: float = 0.0
    sim_time: bool = False
    motion: MotionPolicy = msgspec.field(default_factory=MotionPolicy)
    extra: Annotated[dict[Label, Label], Meta(max_length=limits.LIST_ITEMS)] = msgspec.field(
        default_factory=dict
    )


class Topic(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One topic of the graph: its types (usually one) and the full names of its nodes."""

    types: NodeList
    publishers: NodeList = msgspec.field(default_factory=list)
    subscribers: NodeList = msgspec.field(default_factory=list)


class Service(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One service (or action) of the graph and the nodes that provide it."""

    types: NodeList
    providers: NodeList = msgspec.field(default_factory=list)


class Graph(Message, frozen=True, kw_only=True):
    """Robot: the ROS graph, or its changes.

    With ``full`` the maps are complete. Otherwise each map holds the names that changed, with ``null`` for a removed
    name. Nodes are keys with an empty object. The daemon's own node is left out.
    """

    full: bool = False
    topics: dict[Name, Topic | None] = msgspec.field(default_factory=dict)
    services: dict[Name, Service | None] = msgspec.field(default_factory=dict)
    actions: dict[Name, Service | None] = msgspec.field(default_factory=dict)
    nodes: dict[Name, dict[str, Any] | None] = msgspec.field(default_factory=dict)


class Health(Message, frozen=True, kw_only=True):
    """Robot: measurements, every few seconds. Counts start with the daemon.

    :param battery: charge, 0 to 1; ``None`` when unknown
    :param cpu: load of the whole machine, 0 to 1
    :param memory: memory in use, 0 to 1
    :param rtt_ms: round trip to the relay, measured by the robot, milliseconds
    :param stale_commands: motion commands dropped because they were too old
    :param invalid_commands: motion commands and goals dropped because their values are invalid
    :param unguarded_commands: motion commands dropped because the guard process was not ready to stop them
    :param refused_commands: motion commands dropped because their source does not hold control
    :param limited_commands: motion commands reduced to the speed limits
    :param watchdog_stops: times the watchdog published zero velocity because commands ceased
    :param dropped_samples: samples dropped because the uplink was full
    """

    battery: float | None = None
    cpu: float | None = None
    memory: float | None = None
    rtt_ms: float | None = None
    stale_commands: int = 0
    invalid_commands: int = 0
    unguarded_commands: int = 0
    refused_commands: int = 0
    limited_commands: int = 0
    watchdog_stops: int = 0
    dropped_samples: int = 0


class DeviceReport(Message, frozen=True, kw_only=True):
    """Robot: what its device manager has measured; after ``welcome`` and after every measurement.

    :param at: Unix time at the robot, seconds
    :param readings: by component: ``battery``, ``cpu``, ``memory`` and ``disk`` in per cent, ``temperature`` in degrees
        Celsius, ``signal`` (wireless) in dBm, and its ``quality``; what can't be read is left out
    :param critical: whether each component is critical, by the robot's settings
    """

    at: float
    readings: Annotated[dict[Label, float], Meta(max_length=limits.LIST_ITEMS)] = msgspec.field(
        default_factory=dict
    )
    critical: Annotated[dict[Label, bool], Meta(max_length=limits.LIST_ITEMS)] = msgspec.field(
        default_factory=dict
    )


class Alert(Message, frozen=True, kw_only=True):
    """Robot: an alert, or its end.

    :param level: ``info``, ``warning`` or ``error``
    :param kind: ``battery``, ``diagnostics``, ``module``, …
    :param about: the component it concerns
    :param over: the alert of this kind and component has ended
    """

    level: Label
    text: str
    kind: Label = ""
    about: Label = ""
    over: bool = False

    def __post_init__(self) -> None:
        cut(self, "text")


class ActiveAlertsSent(Message, frozen=True, kw_only=True):
    """Robot: all lasting alerts were sent since ``welcome``; other open ones of modules and diagnostics have ended."""


class OpenChannel(Message, frozen=True, kw_only=True):
    """Relay: dial and ``join`` with this ticket.

    :param address: ``host:port`` to dial; empty for the address of the control link
    """

    channel: str
    ticket: str
    address: str = ""


class CloseChannel(Message, frozen=True, kw_only=True):
    """Relay: this channel has no sessions any more."""

    channel: str


RobotControl = (
    Describe
    | Graph
    | Cameras
    | Health
    | DeviceReport
    | Alert
    | ActiveAlertsSent
    | MotionState
    | OrderResult
    | Modules
    | ModuleOrdered
    | ModuleLog
    | Processes
    | RequestFileLink
    | Ping
    | Pong
    | Bye
)
RelayControl = (
    OpenChannel
    | CloseChannel
    | OpenVideo
    | CloseVideo
    | ControlGrant
    | Stop
    | Resume
    | Suppress
    | Inhibit
    | OrderModule
    | ReadModuleLog
    | MeasureProcesses
    | OpenFileLink
    | Ping
    | Pong
    | Bye
)
