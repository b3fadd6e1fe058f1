"""A robot's graph as one caller sees it: with the relay in it, and without what the caller may not use.

Nodes are no resources: their names are shown to everyone with a right on the robot, what they do is not.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection, Iterable
from typing import NamedTuple
from weakref import WeakKeyDictionary

from relay_protocol import link
from relay_protocol.link import Service, Topic
from relay_protocol.rights import Operation, Rules
from relay_server.access import may_subscribe
from relay_server.relay_node.interfaces import OWN_ACTIONS, OWN_SERVICES, OWN_TOPICS, RELAY, ROSAPI
from relay_server.robots.registry import GraphMirror, OwnEndpoints, RobotState
from relay_server.sessions.context import ClientContext

CACHED_GRAPHS = 8
"""Most graphs cached of one robot: callers with the same rights share one."""


class VisibleGraph(NamedTuple):
    """Topics, services, actions and nodes, sorted by name.

    :param hidden: topics that are not listed, but that a caller may subscribe to by name
    """

    topics: dict[str, Topic]
    services: dict[str, Service]
    actions: dict[str, Service]
    nodes: list[str]
    hidden: dict[str, Topic]

    def topic(self, name: str) -> Topic | None:
        """A topic that the caller names, listed or not."""
        return self.topics.get(name) or self.hidden.get(name)


class NodeDetails(NamedTuple):
    """Names of the topics and services of a node, sorted."""

    publishes: list[str]
    subscribes: list[str]
    services: list[str]


class _CachedGraph(NamedTuple):
    version: int
    ends: OwnEndpoints
    cameras: tuple[link.Camera, ...]
    visible: VisibleGraph

    def is_of(self, graph: GraphMirror, ends: OwnEndpoints, cameras: tuple[link.Camera, ...]) -> bool:
        """Whether it was made of these."""
        return (self.version, self.ends, self.cameras) == (graph.version, ends, cameras)


_cache: WeakKeyDictionary[GraphMirror, OrderedDict[tuple[object, ...], _CachedGraph]] = WeakKeyDictionary()


def visible_graph(client: ClientContext) -> VisibleGraph:
    """The part of its robot's graph that the client may see; computed again only after a change."""
    return graph_by_rules(client.robot, client.channel.own_endpoints(), client.permit.rules)


def graph_by_rules(robot: RobotState, ends: OwnEndpoints, rules: Rules) -> VisibleGraph:
    """The part of a robot's graph that a user may see by these rules, connected or not.

    :param ends: what the relay has in the robot's graph for its clients
    """
    graph, cameras = robot.graph, robot.cameras
    cached = _cache.setdefault(graph, OrderedDict())
    key = rules.key
    found = cached.get(key)
    if found is None or not found.is_of(graph, ends, cameras):
        found = cached[key] = _CachedGraph(graph.version, ends, cameras, _compute(robot, ends, rules))
    cached.move_to_end(key)
    while len(cached) > CACHED_GRAPHS:
        cached.popitem(last=False)
    return found.visible


def node_details_of(nodes: Collection[str], visible: VisibleGraph) -> dict[str, NodeDetails]:
    """Details of some nodes, as far as they are visible; a name that is no node has empty details."""
    found = {node: NodeDetails([], [], []) for node in nodes}
    for name, topic in visible.topics.items():
        for node in found.keys() & topic.publishers:
            found[node].publishes.append(name)
        for node in found.keys() & topic.subscribers:
            found[node].subscribes.append(name)
    for name, service in visible.services.items():
        for node in found.keys() & service.providers:
            found[node].services.append(name)
    return found


def _compute(robot: RobotState, ends: OwnEndpoints, rules: Rules) -> VisibleGraph:
    graph, decide = robot.graph, rules.decide

    def may_call(name: str) -> bool:
        return decide(Operation.CALL, name).allowed

    usable = {
        name: topic
        for name, topic in sorted(_topics(graph, ends).items())
        if may_subscribe(decide, robot, name, topic.types).allowed or decide(Operation.PUBLISH, name).allowed
    }
    topics = {name: topic for name, topic in usable.items() if not hidden(name)}
    unlisted = {name: topic for name, topic in usable.items() if hidden(name)}
    services = {
        name: service
        for name, service in _services(graph.services, ends.services).items()
        if not hidden(name) and may_call(name)
    }
    actions = {
        name: action
        for name, action in sorted(_services(graph.actions, ends.actions).items())
        if not hidden(name) and may_call(name)
    }
    # The relay's own services and actions are open to everyone with a right on the robot.
    services = dict(sorted({**services, **OWN_SERVICES}.items()))
    actions = dict(sorted({**actions, **OWN_ACTIONS}.items()))
    return VisibleGraph(topics, services, actions, sorted({*graph.nodes, RELAY, ROSAPI}), unlisted)


def _topics(graph: GraphMirror, ends: OwnEndpoints) -> dict[str, Topic]:
    """The robot's topics with the relay at the ends that it has there for its clients."""
    found = dict(graph.topics)
    for name, type_name in ends.publishes:
        known = found.get(name) or Topic(types=[type_name])
        found[name] = Topic(
            types=known.types, publishers=_with_relay(known.publishers), subscribers=known.subscribers
        )
    for name, _ in ends.subscribes:
        # A topic without publishers yet is of no use to others.
        if name in found:
            known = found[name]
            found[name] = Topic(
                types=known.types, publishers=known.publishers, subscribers=_with_relay(known.subscribers)
            )
    found.update(OWN_TOPICS)
    return found


def _services(graph: dict[str, Service], offered: Iterable[tuple[str, str]]) -> dict[str, Service]:
    """The robot's services or actions, and what clients offer."""
    found = dict(graph)
    for name, type_name in offered:
        known = found.get(name) or Service(types=[type_name])
        found[name] = Service(types=known.types, providers=_with_relay(known.providers))
    return found


def _with_relay(nodes: list[str]) -> list[str]:
    return nodes if RELAY in nodes else [*nodes, RELAY]


def hidden(name: str) -> bool:
    """Names with a part that begins with ``_`` are not listed (ROS 2 design, topic and service names)."""
    return "/_" in name
