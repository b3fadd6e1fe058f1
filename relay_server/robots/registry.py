"""The robots that the relay knows, and the mirror of each robot's ROS graph."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, TypeVar

from twisted.internet.defer import Deferred

from relay_protocol import limits, link
from relay_protocol.errors import MalformedMessage
from relay_protocol.link import Graph, Service, Topic
from relay_protocol.realms import full_name
from relay_protocol.ros_types import TypeRegistry
from relay_server.robots.link_quality import NO_LINK, LinkQuality

NAMES = 20_000
"""Most topics, services, actions and nodes, each, that are kept per robot; further ones are ignored."""

_NODE = 100
_ENTRY = 300
_STRING = 56
"""Memory of a node, an entry and a string beside its characters, in bytes."""

Entry = TypeVar("Entry", Topic, Service)


class OwnEndpoints(NamedTuple):
    """The endpoints that the relay's node has in a robot's graph for its clients, each a name and its type.

    The robot leaves them out of the graph that it sends.
    """

    publishes: tuple[tuple[str, str], ...] = ()
    subscribes: tuple[tuple[str, str], ...] = ()
    services: tuple[tuple[str, str], ...] = ()
    actions: tuple[tuple[str, str], ...] = ()


class GraphMirror:
    """Names, types and endpoints of a robot's topics, services, actions and nodes, as the robot last sent them."""

    def __init__(self) -> None:
        self.version = 0
        """Increases with every change."""
        self.known = False
        """Whether the robot has sent a graph since the last :meth:`clear`."""
        self.topics: dict[str, Topic] = {}
        self.services: dict[str, Service] = {}
        self.actions: dict[str, Service] = {}
        self.nodes: set[str] = set()
        self._bytes = 0

    def apply(self, graph: Graph) -> None:
        """Apply a full graph or a difference (SPEC 2.4).

        :raises MalformedMessage: the graph would take more than :data:`~relay_protocol.limits.GRAPH_BYTES`
        """
        self.version += 1
        if graph.full:
            self.clear()
        self._take(self.topics, graph.topics)
        self._take(self.services, graph.services)
        self._take(self.actions, graph.actions)
        for name, node in graph.nodes.items():
            if node is None:
                if name in self.nodes:
                    self.nodes.discard(name)
                    self._count(-_size(name))
            elif name not in self.nodes and len(self.nodes) < NAMES:
                self._count(_size(name))
                self.nodes.add(name)
        self.known = True

    def _take(self, target: dict[str, Entry], changes: Mapping[str, Entry | None]) -> None:
        for name, value in changes.items():
            former = target.get(name)
            if value is not None and (former is not None or len(target) < NAMES):
                self._count(_size(name, value))
                target[name] = value
            elif value is None:
                target.pop(name, None)
            if former is not None:
                self._count(-_size(name, former))

    def _count(self, size: int) -> None:
        self._bytes += size
        if self._bytes > limits.GRAPH_BYTES:
            self.clear()
            raise MalformedMessage(
                f"the robot's graph takes more than {limits.GRAPH_BYTES // limits.MIB} MiB here; "
                "run its nodes in domains of their own"
            )

    def clear(self) -> None:
        """Forget the graph."""
        self.version += 1
        self.known = False
        self.topics.clear()
        self.services.clear()
        self.actions.clear()
        self.nodes.clear()
        self._bytes = 0

    def topic_type(self, name: str) -> str | None:
        """The type of a topic, ``None`` when it does not exist."""
        topic = self.topics.get(name)
        return topic.types[0] if topic and topic.types else None

    def service_type(self, name: str) -> str | None:
        """The type of a service, ``None`` when it does not exist."""
        service = self.services.get(name)
        return service.types[0] if service and service.types else None

    def action_type(self, name: str) -> str | None:
        """The type of an action, ``None`` when it does not exist."""
        action = self.actions.get(name)
        return action.types[0] if action and action.types else None


def _size(name: str, entry: Topic | Service | None = None) -> int:
    """Estimated memory of a name and its entry, or of a node, in bytes."""
    if entry is None:
        return _NODE + _STRING + len(name.encode())
    lists = (
        (entry.types, entry.publishers, entry.subscribers)
        if isinstance(entry, Topic)
        else (entry.types, entry.providers)
    )
    return _ENTRY + sum(_STRING + len(text.encode()) for each in ([name], *lists) for text in each)


SETTLING_SECONDS = 10.0
"""After registering, a robot discovers existing nodes one by one; they are not reported as new until then."""

REPLACE_SECONDS = 3.0
"""A registration younger than this is not replaced."""


class ControlLinkPort(Protocol):
    """A robot's control link, as the registry and channels use it; it carries all that belongs to no channel."""

    def send(self, message: link.Message) -> None:
        """Queue a message."""

    def close(self, reason: str) -> None:
        """Send ``bye`` and end the connection."""

    def close_replaced(self, reason: str, answers: Callable[[], None]) -> None:
        """End the connection as :meth:`close` does, because the robot has a newer one.

        :param answers: called if a ping sent now is answered, which means that two daemons use the robot's key
        """

    def round_trip(self) -> Deferred[float]:
        """Ping the robot; seconds, or :class:`Unavailable` when the connection ends first."""

    def link_quality(self) -> LinkQuality:
        """The quality of the link to the robot."""


class Availability(str, enum.Enum):
    """The availability of a robot, as users see it."""

    OFFLINE = "offline"
    ONLINE = "online"
    IN_USE = "in_use"


class RobotObserver(Protocol):
    """Observes one robot: its channel, a camera stream, its controller."""

    def robot_online(self) -> None:
        """The robot has registered (again)."""

    def robot_offline(self) -> None:
        """The control link is gone."""

    def graph_changed(self) -> None:
        """The mirror of its graph has changed."""

    def described(self) -> None:
        """The robot has sent facts about itself, or its list of cameras."""


class ViewerInfo(Protocol):
    """One user viewing one camera."""

    @property
    def name(self) -> str:
        """The user's name."""

    @property
    def camera(self) -> str:
        """The camera's name."""

    @property
    def address(self) -> str:
        """The user's network address, for display."""


NodeChanges = Callable[["RobotState", list[str], list[str]], None]
"""Called with a robot, the nodes that appeared in its graph, and those that disappeared."""


@dataclass
class RobotState:
    """One robot as the relay sees it now.

    :param registered_at: monotonic seconds of the latest registration
    :param replace_after: seconds for which that registration is not replaced
    :param realm: the robot's own realm
    :param shared: other realms it is shared with
    :param elsewhere: whether it is connected to another relay of the cluster
    :param control_link: its connection for messages of the link protocol, of which motion control is one kind;
        ``None``: the robot is offline
    :param streams: most camera streams it encodes at a time; 0: the robot has sent none
    :param online_since: Unix time of the latest registration
    :param registrations: how often the robot has registered
    :param rtt: round trip relay–robot of the latest ping, seconds
    :param last_seen: Unix time of the latest byte, ``None`` when never seen since the start
    :param viewers: Unix time at which each began to view
    """

    robot_id: int
    name: str
    realm: str
    shared: frozenset[str] = frozenset()
    elsewhere: bool = False
    control_link: ControlLinkPort | None = None
    registered_at: float = 0.0
    online_since: float = 0.0
    registrations: int = 0
    replace_after: float = REPLACE_SECONDS
    session: str = ""
    key: str = ""
    address: str = ""
    encodings: tuple[str, ...] = ()
    description: link.Describe = field(default_factory=link.Describe)
    health: link.Health = field(default_factory=link.Health)
    impossible_charge: float | None = None
    """A battery's charge that the robot reports and that is not from 0 to 1; ``health`` has it as unknown."""
    device: link.DeviceReport | None = None
    motion_state: link.MotionState = field(default_factory=link.MotionState)
    cameras: tuple[link.Camera, ...] = ()
    streams: int = 0
    graph: GraphMirror = field(default_factory=GraphMirror)
    types: TypeRegistry = field(default_factory=TypeRegistry)
    rtt: float | None = None
    last_seen: float | None = None
    users: int = 0
    viewers: dict[ViewerInfo, float] = field(default_factory=dict)
    observers: list[RobotObserver] = field(default_factory=list)

    @property
    def full(self) -> str:
        """Its name for the whole relay: ``mobile@lab2``."""
        return full_name(self.name, self.realm)

    @property
    def realms(self) -> frozenset[str]:
        """All realms it belongs to."""
        return self.shared | {self.realm}

    def name_of(self, user: str, realm: str) -> str:
        """The user's name as shown at this robot, with the realm where users of several realms may be connected.

        A user of another realm keeps it while they are still connected after sharing ended.
        """
        return f"{user}@{realm}" if self.shared or realm != self.realm else user

    @property
    def state(self) -> Availability:
        """Offline, online, or in use: a client is connected or a camera is viewed."""
        if self.control_link is None:
            return Availability.ONLINE if self.elsewhere else Availability.OFFLINE
        return Availability.IN_USE if self.users or self.viewers else Availability.ONLINE

    @property
    def absence(self) -> str:
        """Why this relay does not reach it, in words that follow "the robot is"."""
        return "connected to another relay" if self.elsewhere else "offline"

    def link_quality(self) -> LinkQuality:
        """The quality of the link between relay and robot."""
        return NO_LINK if self.control_link is None else self.control_link.link_quality()

    def is_motion(self, topic: str, type_name: str) -> bool:
        """Whether messages on this topic move the robot, by its own description."""
        return self.description.motion.moves_by_topic(topic, type_name)


class RobotRegistry:
    """All robots that were online or asked for since the relay started.

    :param wall: Unix time in seconds
    """

    def __init__(self, wall: Callable[[], float]) -> None:
        self._wall = wall
        self._robots: dict[int, RobotState] = {}
        self._shares: dict[int, frozenset[str]] = {}
        self._elsewhere: set[int] = set()
        self._listeners: list[Callable[[], None]] = []
        self._node_listeners: list[NodeChanges] = []

    def __iter__(self) -> Iterator[RobotState]:
        return iter(list(self._robots.values()))

    def robot(self, robot_id: int, name: str, realm: str) -> RobotState:
        """The state of a robot, made on first use.

        :param realm: the robot's own
        """
        found = self._robots.get(robot_id)
        if found is None:
            shared = self._shares.get(robot_id, frozenset())
            found = RobotState(robot_id, name, realm, shared, self.is_elsewhere(robot_id))
            self._robots[robot_id] = found
        return found

    def share(self, shares: dict[int, frozenset[str]]) -> None:
        """Replace the realms that robots are shared with.

        :param shares: realms by robot id
        """
        self._shares = shares
        for robot in self:
            robot.shared = shares.get(robot.robot_id, frozenset())

    def set_elsewhere(self, robot_id: int, *, elsewhere: bool) -> None:
        """Whether a robot is connected to another relay of the cluster."""
        if elsewhere == (robot_id in self._elsewhere):
            return
        (self._elsewhere.add if elsewhere else self._elsewhere.discard)(robot_id)
        robot = self._robots.get(robot_id)
        if robot is not None:
            robot.elsewhere = elsewhere
        self.changed()

    def is_elsewhere(self, robot_id: int) -> bool:
        """Whether a robot is connected to another relay of the cluster."""
        return robot_id in self._elsewhere

    def connected(self, robot_id: int) -> bool:
        """Whether a robot is connected to this relay."""
        robot = self._robots.get(robot_id)
        return robot is not None and robot.control_link is not None

    def find(self, robot_id: int) -> RobotState | None:
        """The state of a robot, if there is one."""
        return self._robots.get(robot_id)

    def registered(
        self, robot: RobotState, control: ControlLinkPort, used_twice: Callable[[], None] = lambda: None
    ) -> None:
        """A robot has proved its identity on this link. An older link of it is closed.

        :param used_twice: called if a daemon still answers on the older link
        """
        older = robot.control_link
        robot.control_link = control
        robot.types = TypeRegistry()
        robot.cameras = ()
        robot.graph.clear()
        robot.health = link.Health()
        robot.impossible_charge = None
        robot.device = None
        robot.rtt = None
        robot.online_since = self._wall()
        robot.registrations += 1
        self.seen(robot)
        if older is not None:
            for observer in list(robot.observers):
                observer.robot_offline()
            older.close_replaced("the robot has connected again", used_twice)
        for observer in list(robot.observers):
            observer.robot_online()
        self.changed()

    def lost(self, robot: RobotState, control: ControlLinkPort) -> None:
        """A control link has ended. A link that was already replaced changes nothing."""
        if robot.control_link is not control:
            return
        robot.control_link = None
        robot.rtt = None
        robot.graph.clear()
        for observer in list(robot.observers):
            observer.robot_offline()
        self.changed()

    def seen(self, robot: RobotState) -> None:
        """Bytes were received from the robot."""
        robot.last_seen = self._wall()

    def graph(self, robot: RobotState, graph: link.Graph) -> None:
        """The robot sent its graph, or changes of it."""
        report = robot.graph.known and self._wall() - robot.online_since >= SETTLING_SECONDS
        before = _nodes(robot, graph)
        robot.graph.apply(graph)
        after = _nodes(robot, graph)
        if report and before != after:
            for listener in self._node_listeners:
                listener(robot, sorted(after - before), sorted(before - after))
        for observer in list(robot.observers):
            observer.graph_changed()

    def described(self, robot: RobotState, description: link.Describe) -> None:
        """The robot sent facts about itself."""
        robot.description = description
        for observer in list(robot.observers):
            observer.described()
        self.changed()

    def cameras(self, robot: RobotState, cameras: link.Cameras) -> None:
        """The robot sent its list of cameras."""
        robot.cameras = tuple(cameras.cameras)
        robot.streams = cameras.streams
        for observer in list(robot.observers):
            observer.described()
        self.changed()

    def viewer_joined(self, robot: RobotState, viewer: ViewerInfo) -> None:
        """A user begins to view a camera."""
        robot.viewers[viewer] = self._wall()
        self.changed()

    def viewer_left(self, robot: RobotState, viewer: ViewerInfo) -> None:
        """A user no longer views a camera."""
        robot.viewers.pop(viewer, None)
        self.changed()

    def forget(self, robot_id: int) -> None:
        """The robot was removed; its links are closed."""
        robot = self._robots.pop(robot_id, None)
        if robot is not None and robot.control_link is not None:
            robot.control_link.close("this robot was removed from the relay")

    def on_change(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call ``listener`` after every change that users can see.

        :returns: a function that ends this
        """
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def on_nodes(self, listener: NodeChanges) -> None:
        """Call ``listener`` when nodes appear or disappear while their robot is online."""
        self._node_listeners.append(listener)

    def changed(self) -> None:
        """Something users can see has changed."""
        for listener in list(self._listeners):
            listener()


def _nodes(robot: RobotState, graph: link.Graph) -> set[str]:
    """The robot's nodes that this message may change, without hidden ones."""
    nodes = robot.graph.nodes
    return {each for each in (nodes if graph.full else nodes & graph.nodes.keys()) if "/_" not in each}
