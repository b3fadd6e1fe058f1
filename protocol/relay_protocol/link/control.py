"""The control link: what a robot tells of itself, and the relay's orders to open channels."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from relay_protocol import limits
from relay_protocol.errors import Invalid
from relay_protocol.limits import COMMAND_DEADLINE_MS, STOP_WITHIN_MS
from relay_protocol.link.common import Bye, Ping, Pong
from relay_protocol.link.fields import Ends, Few, Label, Name, cut
from relay_protocol.link.motion import Control, Done, Inhibit, Resume, Safety, Stop, Suppress
from relay_protocol.link.video import Cameras, CloseVideo, OpenVideo
from relay_protocol.message import Message
from relay_protocol.wildcards import see_cheap


class MotionPolicy(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What the robot's own safety counts as motion, and its times. The robot is the authority on it.

    :param types: message types whose topics are motion topics
    :param topics: further topics, by patterns of their names (shell wildcards, like those of rights)
    :param services: patterns of the services that move the robot
    :param actions: patterns of the actions that do
    :param deadline_ms: a command older than this is dropped
    :param stop_within_ms: the robot stands still this long after the last valid command
    """

    types: Few = msgspec.field(default_factory=list)
    topics: Few = msgspec.field(default_factory=list)
    services: Few = msgspec.field(default_factory=list)
    actions: Few = msgspec.field(default_factory=list)
    deadline_ms: int = COMMAND_DEADLINE_MS
    stop_within_ms: int = STOP_WITHIN_MS

    def __post_init__(self) -> None:
        try:
            for each in (*self.topics, *self.services, *self.actions):
                see_cheap(each)
        except Invalid as error:
            # As msgspec tells what is wrong with a message.
            raise ValueError(str(error)) from None

    def moves_by_topic(self, topic: str, type: str) -> bool:
        """Whether what is published there moves the robot."""
        return type in self.types or _any(self.topics, topic)

    def moves_by_service(self, service: str) -> bool:
        """Whether calls of it do."""
        return _any(self.services, service)

    def moves_by_action(self, action: str) -> bool:
        """Whether goals of it do."""
        return _any(self.actions, action)


def _any(patterns: list[str], name: str) -> bool:
    return any(fnmatchcase(name, pattern) for pattern in patterns)


class Describe(Message, frozen=True, kw_only=True):
    """Robot: facts about myself, whole; sent after ``welcome`` and whenever they change.

    :param platform: ``ros2``, ``mqtt``, …
    :param distro: ROS distribution, e.g. ``jazzy``
    :param started: Unix time the daemon started, seconds
    :param sim_time: the robot's time is what ``/clock`` says (``use_sim_time``)
    :param extra: anything else worth showing, text by text
    """

    host: Label = ""
    platform: Label = ""
    distro: Label = ""
    os: Label = ""
    agent: Label = ""
    started: float = 0.0
    sim_time: bool = False
    motion: MotionPolicy = msgspec.field(default_factory=MotionPolicy)
    extra: Annotated[dict[Label, Label], Meta(max_length=limits.FACTS)] = msgspec.field(default_factory=dict)


class Topic(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One topic of the graph: its types (usually one) and the full names of the nodes at its ends."""

    types: Ends
    publishers: Ends = msgspec.field(default_factory=list)
    subscribers: Ends = msgspec.field(default_factory=list)


class Service(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One service (or action) of the graph and the nodes that provide it."""

    types: Ends
    providers: Ends = msgspec.field(default_factory=list)


class Graph(Message, frozen=True, kw_only=True):
    """Robot: the ROS graph, or what has changed in it.

    With ``full`` the maps are all there is. Otherwise each map holds the names that changed, with ``null``
    for a name that is gone. Nodes are keys with an empty object. The daemon's own node is left out.
    """

    full: bool = False
    topics: dict[Name, Topic | None] = msgspec.field(default_factory=dict)
    services: dict[Name, Service | None] = msgspec.field(default_factory=dict)
    actions: dict[Name, Service | None] = msgspec.field(default_factory=dict)
    nodes: dict[Name, dict[str, Any] | None] = msgspec.field(default_factory=dict)


class Health(Message, frozen=True, kw_only=True):
    """Robot: how I am, every few seconds.

    :param battery: charge, 0 to 1; ``None`` when unknown
    :param cpu: load of the whole machine, 0 to 1
    :param memory: memory in use, 0 to 1
    :param rtt_ms: round trip to the relay as the robot measures it, milliseconds
    :param stale_commands: motion commands dropped because they were too old, since start
    :param invalid_commands: motion commands and goals dropped because they make no sense, since start
    :param unguarded_commands: motion commands dropped because the guard could not have stopped them, since start
    :param refused_commands: motion commands dropped because their source does not move the robot now, since start
    :param limited_commands: motion commands made slower, since start
    :param watchdog_stops: times the watchdog sent zero because commands ceased, since start
    :param dropped_samples: samples dropped because the uplink was full, since start
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


class Alert(Message, frozen=True, kw_only=True):
    """Robot: something a person should know.

    :param level: ``info``, ``warning`` or ``error``
    :param kind: ``battery``, ``diagnostics``, ``module``, …
    :param about: the part of the robot it comes from
    :param over: what was told under this kind and part is well again
    """

    level: Label
    text: str
    kind: Label = ""
    about: Label = ""
    over: bool = False

    def __post_init__(self) -> None:
        cut(self, "text")


class AlertsTold(Message, frozen=True, kw_only=True):
    """Robot: every alert that lasts was told since ``welcome``; the others of its modules and diagnostics are over."""


class OpenChannel(Message, frozen=True, kw_only=True):
    """Relay: dial and ``join`` with this ticket.

    :param address: ``host:port`` to dial; empty for the address of the control link
    """

    channel: str
    ticket: str
    address: str = ""


class CloseChannel(Message, frozen=True, kw_only=True):
    """Relay: nobody is left on this channel."""

    channel: str


RobotControl = Describe | Graph | Cameras | Health | Alert | AlertsTold | Safety | Done | Ping | Pong | Bye
RelayControl = (
    OpenChannel
    | CloseChannel
    | OpenVideo
    | CloseVideo
    | Control
    | Stop
    | Resume
    | Suppress
    | Inhibit
    | Ping
    | Pong
    | Bye
)
