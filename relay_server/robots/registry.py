"""Who is there: every robot the relay knows, whether it is online, and what it last told about itself."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Protocol

from twisted.internet.defer import Deferred

from relay_protocol import link
from relay_protocol.realms import full_name
from relay_protocol.ros_types import TypeRegistry
from relay_server.robots.graph import GraphMirror
from relay_server.robots.link_quality import NO_LINK, LinkQuality

SETTLING_SECONDS = 10.0
"""After it has registered a robot finds the nodes that were there before, one by one: those are no news."""

REPLACE_SECONDS = 3.0
"""A registration younger than this is not replaced."""


class ControlPort(Protocol):
    """A robot's control link, as the registry and channels use it."""

    def send(self, message: link.Message) -> None:
        """Queue a message."""

    def close(self, reason: str) -> None:
        """Say ``bye`` and end the connection."""

    def replaced(self, reason: str, answers: Callable[[], None]) -> None:
        """End the connection as :meth:`close`, because there is a newer one of the robot.

        :param answers: called if a ping sent now is answered: then the robot's key is used by two daemons
        """

    def round_trip(self) -> Deferred[float]:
        """Ping the robot; seconds, or :class:`Unavailable` when the connection ends first."""

    def reading(self) -> LinkQuality:
        """How good the way to the robot is."""


class Availability(str, enum.Enum):
    """What a user sees of a robot."""

    OFFLINE = "offline"
    ONLINE = "online"
    IN_USE = "in_use"


class RobotObserver(Protocol):
    """Something that follows one robot: its channel, a stream of a camera."""

    def robot_online(self) -> None:
        """The robot has registered (again)."""

    def robot_offline(self) -> None:
        """The control link is gone."""

    def graph_changed(self) -> None:
        """The mirror of its graph has changed."""

    def described(self) -> None:
        """It has told facts about itself, or which cameras it has."""


class CameraViewers(Protocol):
    """Somebody who watches a camera."""

    @property
    def name(self) -> str:
        """The user's."""

    @property
    def camera(self) -> str:
        """What is watched."""

    @property
    def address(self) -> str:
        """Where he is, for people."""


Modules = Callable[["RobotState", list[str], list[str]], None]
"""Is told of a robot whose nodes were others a moment ago: which have come, and which have gone."""


@dataclass
class RobotState:
    """One robot as the relay sees it now.

    :param registered_at: monotonic seconds of the latest registration
    :param patience: seconds for which that registration is not replaced
    :param realm: its own
    :param shared: the realms it is shared with
    :param streams: most streams of cameras it makes at a time; 0 when it did not say
    :param came: Unix time of the latest registration
    :param rtt: round trip relay–robot of the latest ping, seconds
    :param last_seen: Unix time of the latest byte, ``None`` when never seen since the start
    :param onlookers: since when each watches, Unix time
    """

    robot_id: int
    name: str
    realm: str
    shared: frozenset[str] = frozenset()
    control: ControlPort | None = None
    registered_at: float = 0.0
    came: float = 0.0
    patience: float = REPLACE_SECONDS
    session: str = ""
    key: str = ""
    address: str = ""
    encodings: tuple[str, ...] = ()
    description: link.Describe = field(default_factory=link.Describe)
    health: link.Health = field(default_factory=link.Health)
    safety: link.Safety = field(default_factory=link.Safety)
    cameras: tuple[link.Camera, ...] = ()
    streams: int = 0
    graph: GraphMirror = field(default_factory=GraphMirror)
    types: TypeRegistry = field(default_factory=TypeRegistry)
    rtt: float | None = None
    last_seen: float | None = None
    users: int = 0
    onlookers: dict[CameraViewers, float] = field(default_factory=dict)
    watchers: list[RobotObserver] = field(default_factory=list)

    @property
    def full(self) -> str:
        """Its name for the whole relay: ``mobile@lab2``."""
        return full_name(self.name, self.realm)

    @property
    def realms(self) -> frozenset[str]:
        """All that it is of."""
        return self.shared | {self.realm}

    def name_of(self, user: str, realm: str) -> str:
        """What a user is called at this robot: with the realm where people of several realms may be there.

        So also who still is there, or is there already, when it is shared no more, or not yet to the relay's knowledge.
        """
        return f"{user}@{realm}" if self.shared or realm != self.realm else user

    @property
    def state(self) -> Availability:
        """Offline, online, or online with somebody who works with it or watches its cameras."""
        if self.control is None:
            return Availability.OFFLINE
        return Availability.IN_USE if self.users or self.onlookers else Availability.ONLINE

    def reading(self) -> LinkQuality:
        """How good the way from the relay to the robot is."""
        return NO_LINK if self.control is None else self.control.reading()

    def is_motion(self, topic: str, type_name: str) -> bool:
        """Whether the robot's own safety counts this topic as motion."""
        return self.description.motion.moves_by_topic(topic, type_name)


class RobotRegistry:
    """All robots that have shown up or were asked for since the start.

    :param wall: Unix time in seconds
    """

    def __init__(self, wall: Callable[[], float]) -> None:
        self._wall = wall
        self._robots: dict[int, RobotState] = {}
        self._shares: dict[int, frozenset[str]] = {}
        self._listeners: list[Callable[[], None]] = []
        self._modules: list[Modules] = []

    def __iter__(self) -> Iterator[RobotState]:
        return iter(list(self._robots.values()))

    def presence(self, robot_id: int, name: str, realm: str) -> RobotState:
        """The entry of a robot, made when it is the first time.

        :param realm: its own
        """
        found = self._robots.get(robot_id)
        if found is None:
            shared = self._shares.get(robot_id, frozenset())
            found = self._robots[robot_id] = RobotState(robot_id, name, realm, shared)
        return found

    def share(self, shares: dict[int, frozenset[str]]) -> None:
        """Which realms robots are shared with, by their numbers, and no others from now on."""
        self._shares = shares
        for robot in self:
            robot.shared = shares.get(robot.robot_id, frozenset())

    def find(self, robot_id: int) -> RobotState | None:
        """The entry of a robot, if there is one."""
        return self._robots.get(robot_id)

    def registered(
        self, robot: RobotState, control: ControlPort, used_twice: Callable[[], None] = lambda: None
    ) -> None:
        """A robot has proved itself on this link. An older link of it gives way.

        :param used_twice: called when a daemon still answers on the older one
        """
        older = robot.control
        robot.control = control
        robot.types = TypeRegistry()
        robot.cameras = ()
        robot.graph.clear()
        robot.health = link.Health()
        robot.rtt = None
        robot.came = self._wall()
        self.seen(robot)
        if older is not None:
            for watcher in list(robot.watchers):
                watcher.robot_offline()
            older.replaced("the robot has connected anew", used_twice)
        for watcher in list(robot.watchers):
            watcher.robot_online()
        self.changed()

    def lost(self, robot: RobotState, control: ControlPort) -> None:
        """A control link has ended. One that was replaced already changes nothing."""
        if robot.control is not control:
            return
        robot.control = None
        robot.rtt = None
        robot.graph.clear()
        for watcher in list(robot.watchers):
            watcher.robot_offline()
        self.changed()

    def seen(self, robot: RobotState) -> None:
        """Bytes came from it."""
        robot.last_seen = self._wall()

    def graph(self, robot: RobotState, graph: link.Graph) -> None:
        """The robot told of its graph, or of changes in it."""
        told = robot.graph.told and self._wall() - robot.came >= SETTLING_SECONDS
        before = _nodes(robot, graph)
        robot.graph.apply(graph)
        after = _nodes(robot, graph)
        if told and before != after:
            for listener in self._modules:
                listener(robot, sorted(after - before), sorted(before - after))
        for watcher in list(robot.watchers):
            watcher.graph_changed()

    def described(self, robot: RobotState, description: link.Describe) -> None:
        """The robot told facts about itself."""
        robot.description = description
        for watcher in list(robot.watchers):
            watcher.described()
        self.changed()

    def cameras(self, robot: RobotState, cameras: link.Cameras) -> None:
        """The robot told which cameras it has."""
        robot.cameras = tuple(cameras.cameras)
        robot.streams = cameras.streams
        for watcher in list(robot.watchers):
            watcher.described()
        self.changed()

    def looks_on(self, robot: RobotState, onlooker: CameraViewers) -> None:
        """Somebody begins to watch."""
        robot.onlookers[onlooker] = self._wall()
        self.changed()

    def looks_away(self, robot: RobotState, onlooker: CameraViewers) -> None:
        """Somebody watches no more."""
        robot.onlookers.pop(onlooker, None)
        self.changed()

    def forget(self, robot_id: int) -> None:
        """The robot was removed; its links are closed."""
        robot = self._robots.pop(robot_id, None)
        if robot is not None and robot.control is not None:
            robot.control.close("this robot was removed from the relay")

    def on_change(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call ``listener`` after any change users can see; returns what ends that."""
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def on_modules(self, listener: Modules) -> None:
        """Have somebody told of nodes that come and go while their robot is online."""
        self._modules.append(listener)

    def changed(self) -> None:
        """Something users can see has changed."""
        for listener in list(self._listeners):
            listener()


def _nodes(robot: RobotState, graph: link.Graph) -> set[str]:
    """Those of a robot's nodes that are listed and that a message about its graph may change."""
    nodes = robot.graph.nodes
    return {each for each in (nodes if graph.full else nodes & graph.nodes.keys()) if "/_" not in each}
