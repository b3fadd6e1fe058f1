"""The relay's mirror of a robot's ROS graph."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, TypeVar

from relay_protocol import limits
from relay_protocol.errors import MalformedMessage
from relay_protocol.link import Graph, Service, Topic

NAMES = 20_000
"""Most topics, services, actions and nodes, each, that are kept of one robot; further ones are passed over."""

_NODE = 100
_ENTRY = 300
_STRING = 56
"""What a node, an entry and a string take in memory, bytes, beside the characters."""

Entry = TypeVar("Entry", Topic, Service)


class OwnEndpoints(NamedTuple):
    """What the relay's own node does in a robot's graph for its clients; the robot leaves it out of what it tells.

    Each is a name and its type.
    """

    publishes: tuple[tuple[str, str], ...] = ()
    subscribes: tuple[tuple[str, str], ...] = ()
    services: tuple[tuple[str, str], ...] = ()
    actions: tuple[tuple[str, str], ...] = ()


class GraphMirror:
    """Names, types and ends of a robot's topics, services, actions and nodes, as the robot last told."""

    def __init__(self) -> None:
        self.version = 0
        """Another one after every change."""
        self.told = False
        """Whether the robot has told anything since it was last forgotten."""
        self.topics: dict[str, Topic] = {}
        self.services: dict[str, Service] = {}
        self.actions: dict[str, Service] = {}
        self.nodes: set[str] = set()
        self._bytes = 0

    def apply(self, graph: Graph) -> None:
        """Take a full graph or a difference (SPEC section 2.4).

        :raises MalformedMessage: the whole would take more memory than one robot gets
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
        self.told = True

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
        """Nothing is known any more."""
        self.version += 1
        self.told = False
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
    """About what a name and its entry, or a node, take in memory, bytes."""
    if entry is None:
        return _NODE + _STRING + len(name.encode())
    lists = (
        (entry.types, entry.publishers, entry.subscribers)
        if isinstance(entry, Topic)
        else (entry.types, entry.providers)
    )
    return _ENTRY + sum(_STRING + len(text.encode()) for each in ([name], *lists) for text in each)
