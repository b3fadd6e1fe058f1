"""The relay's mirror of a robot's ROS graph."""

from __future__ import annotations

from relay_protocol import limits
from relay_protocol.link import Graph, Service, Topic

NAMES = 20_000
"""Most topics, services, actions and nodes, each, that are kept of one robot; further ones are passed over."""


class GraphMirror:
    """Names, types and ends of a robot's topics, services, actions and nodes, as the robot last told."""

    def __init__(self) -> None:
        self.topics: dict[str, Topic] = {}
        self.services: dict[str, Service] = {}
        self.actions: dict[str, Service] = {}
        self.nodes: set[str] = set()

    def apply(self, graph: Graph) -> None:
        """Take a full graph or a difference (SPEC section 2.3)."""
        if graph.full:
            self.clear()
        for target, changes in (
            (self.topics, graph.topics),
            (self.services, graph.services),
            (self.actions, graph.actions),
        ):
            for name, value in changes.items():
                if value is None:
                    target.pop(name, None)
                elif name in target or (len(target) < NAMES and len(name) <= limits.NAME):
                    target[name] = value  # type: ignore[assignment]
        for name, node in graph.nodes.items():
            if node is None:
                self.nodes.discard(name)
            elif len(self.nodes) < NAMES and len(name) <= limits.NAME:
                self.nodes.add(name)

    def clear(self) -> None:
        """Nothing is known any more."""
        self.topics.clear()
        self.services.clear()
        self.actions.clear()
        self.nodes.clear()

    def topic_type(self, name: str) -> str | None:
        """The type of a topic, ``None`` when it does not exist."""
        topic = self.topics.get(name)
        return topic.types[0] if topic and topic.types else None

    def service_type(self, name: str) -> str | None:
        """The type of a service, ``None`` when it does not exist."""
        service = self.services.get(name)
        return service.types[0] if service and service.types else None
