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
from relay_server.relay_node.interfaces import OWN_SERVICES, OWN_TOPICS, RELAY, ROSAPI
from relay_server.robots.graph import GraphMirror, OwnEndpoints
from relay_server.robots.registry import RobotState
from relay_server.sessions.session import Session

KEPT = 8
"""Views kept of one robot: callers with the same rights share one."""


class VisibleGraph(NamedTuple):
    """What there is, by name and in order.

    :param hidden: topics that are not listed, but that a caller who names one may subscribe to
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
    """What a node does: names of topics and services, in order."""

    publishes: list[str]
    subscribes: list[str]
    services: list[str]


class _CachedGraph(NamedTuple):
    version: int
    ends: OwnEndpoints
    cameras: tuple[link.Camera, ...]
    view: VisibleGraph

    def is_of(self, graph: GraphMirror, ends: OwnEndpoints, cameras: tuple[link.Camera, ...]) -> bool:
        """Whether it was made of these."""
        return (self.version, self.ends, self.cameras) == (graph.version, ends, cameras)


_kept: WeakKeyDictionary[GraphMirror, OrderedDict[tuple[object, ...], _CachedGraph]] = WeakKeyDictionary()


def view(session: Session) -> VisibleGraph:
    """What the caller sees; made anew only after something has changed."""
    return seen(session.robot, session.channel.ends(), session.permit.rules)


def seen(robot: RobotState, ends: OwnEndpoints, rules: Rules) -> VisibleGraph:
    """What one sees by these rules, whether or not he is connected.

    :param ends: what the relay has in the robot's graph for its clients
    """
    graph, cameras = robot.graph, robot.cameras
    views = _kept.setdefault(graph, OrderedDict())
    key = rules.key
    found = views.get(key)
    if found is None or not found.is_of(graph, ends, cameras):
        found = views[key] = _CachedGraph(graph.version, ends, cameras, _made(robot, ends, rules))
    views.move_to_end(key)
    while len(views) > KEPT:
        views.popitem(last=False)
    return found.view


def node_details_of(nodes: Collection[str], seen: VisibleGraph) -> dict[str, NodeDetails]:
    """What each of some nodes does, as far as it is seen; what is no node does nothing."""
    found = {node: NodeDetails([], [], []) for node in nodes}
    for name, topic in seen.topics.items():
        for node in found.keys() & topic.publishers:
            found[node].publishes.append(name)
        for node in found.keys() & topic.subscribers:
            found[node].subscribes.append(name)
    for name, service in seen.services.items():
        for node in found.keys() & service.providers:
            found[node].services.append(name)
    return found


def _made(robot: RobotState, ends: OwnEndpoints, rules: Rules) -> VisibleGraph:
    graph, judge = robot.graph, rules.judge

    def may_call(name: str) -> bool:
        return judge(Operation.CALL, name).allowed

    usable = {
        name: topic
        for name, topic in sorted(_topics(graph, ends).items())
        if may_subscribe(judge, robot, name, topic.types).allowed or judge(Operation.PUBLISH, name).allowed
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
    # The relay's own services are open to everyone with a right on the robot.
    services = dict(sorted({**services, **OWN_SERVICES}.items()))
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
        # One that nobody publishes yet is no topic that others could use.
        if name in found:
            known = found[name]
            found[name] = Topic(
                types=known.types, publishers=known.publishers, subscribers=_with_relay(known.subscribers)
            )
    found.update(OWN_TOPICS)
    return found


def _services(told: dict[str, Service], offered: Iterable[tuple[str, str]]) -> dict[str, Service]:
    """The robot's services or actions, and what clients offer."""
    found = dict(told)
    for name, type_name in offered:
        known = found.get(name) or Service(types=[type_name])
        found[name] = Service(types=known.types, providers=_with_relay(known.providers))
    return found


def _with_relay(nodes: list[str]) -> list[str]:
    return nodes if RELAY in nodes else [*nodes, RELAY]


def hidden(name: str) -> bool:
    """Names with a part that begins with ``_`` are not listed (ROS 2 design, topic and service names)."""
    return "/_" in name
