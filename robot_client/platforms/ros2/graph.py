"""The ROS 2 graph, read node by node, which is cheaper than by topic.

Nodes with one full name are read by topic: by node, the middleware answers for one of them only.

Hidden topics are included, since clients may subscribe to them by name; hidden nodes, services and actions
are not.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from typing import Any, NamedTuple

from relay_protocol import link
from relay_protocol.link.motion import SEND_GOAL
from robot_client.platforms.base import GraphView

GOAL_TYPE = "_SendGoal"
NAMESAKES_EVERY = 3
"""Reads of the graph after which endpoints of nodes with one full name are read again."""

UNKNOWN = "_NODE_NAME_UNKNOWN_"
"""Name of the node of an endpoint whose node is not discovered yet, or which has none."""


_Services = dict[str, dict[str, set[str]]]
"""Full names of the nodes that provide a service, by its name and type."""


class _Topics(NamedTuple):
    types: dict[str, set[str]]
    publishers: dict[str, set[str]]
    subscribers: dict[str, set[str]]


class Namesakes:
    """Endpoints of all nodes with the same full names.

    A node that was killed is one of them until its lease ends, and the one that replaces it is another. They take some
    ten times as long to read as other nodes (the endpoints of all topics), so not each read of the graph does it.
    """

    def __init__(self) -> None:
        self._names: frozenset[str] = frozenset()
        self._age = 0
        self._publishers: set[tuple[str, str, str]] = set()
        self._subscribers: set[tuple[str, str, str]] = set()
        self._servers: set[tuple[str, str, str]] = set()
        """Of each endpoint the topic or service, its type, and the full name of its node."""

    def add_to(self, node: Any, names: frozenset[str], topics: _Topics, services: _Services) -> None:
        """Add the endpoints of nodes with these full names."""
        self._age += 1
        if names != self._names or self._age >= NAMESAKES_EVERY:
            self._names, self._age = names, 0
            self._publishers, self._subscribers, self._servers = set(), set(), set()
            if names:
                self._read(node)
        for ends, found in ((topics.publishers, self._publishers), (topics.subscribers, self._subscribers)):
            for topic, type, full in found:
                topics.types[topic].add(type)
                ends[topic].add(full)
        for service, type, full in self._servers:
            services[service][type].add(full)

    def _read(self, node: Any) -> None:
        for topic, _ in node.get_topic_names_and_types():
            for ends, found in (
                (self._publishers, node.get_publishers_info_by_topic(topic)),
                (self._subscribers, node.get_subscriptions_info_by_topic(topic)),
            ):
                ends.update((topic, each.topic_type, full) for each, full in self._of_them(found))
        for service, types in node.get_service_names_and_types():
            found = self._of_them(servers(node, service))
            self._servers.update((service, type, full) for _, full in found for type in types)

    def _of_them(self, endpoints: Iterable[Any]) -> list[tuple[Any, str]]:
        named = ((each, full_name(each.node_name, each.node_namespace)) for each in endpoints)
        return [(each, full) for each, full in named if full in self._names]


def read(node: Any, own: tuple[str, ...], of_namesakes: Namesakes) -> GraphView:
    """Read the whole graph from the middleware's cache.

    :param node: an rclpy node
    :param own: prefixes of the full names of nodes that are left out, with everything that only they have
    :param of_namesakes: is kept from one read to the next
    """
    topics = _Topics(defaultdict(set), defaultdict(set), defaultdict(set))
    services: _Services = defaultdict(lambda: defaultdict(set))
    found = Counter(node.get_node_names_and_namespaces())
    nodes, namesakes = set(), set()
    for (name, namespace), count in found.items():
        full = full_name(name, namespace)
        if full.startswith(own) or name == UNKNOWN:
            continue
        if not hidden(full):
            nodes.add(full)
        if count > 1:
            namesakes.add(full)
        _read_node(node, name, namespace, full, topics, services)
    of_namesakes.add_to(node, frozenset(namesakes), topics, services)
    plain, actions = _split(services)
    return GraphView(
        topics={
            topic: link.Topic(
                types=sorted(types),
                publishers=sorted(topics.publishers.get(topic, ())),
                subscribers=sorted(topics.subscribers.get(topic, ())),
            )
            for topic, types in topics.types.items()
        },
        services=plain,
        actions=actions,
        nodes=frozenset(nodes),
    )


def _read_node(node: Any, name: str, namespace: str, full: str, topics: _Topics, services: _Services) -> None:
    try:
        published = node.get_publisher_names_and_types_by_node(name, namespace)
        subscribed = node.get_subscriber_names_and_types_by_node(name, namespace)
        served = node.get_service_names_and_types_by_node(name, namespace)
    except Exception:  # the node left between two calls; the class of rclpy's error differs between releases
        return
    for ends, found in ((topics.publishers, published), (topics.subscribers, subscribed)):
        for topic, types in found:
            topics.types[topic].update(types)
            ends[topic].add(full)
    for service, types in served:
        for type in types:
            services[service][type].add(full)


def _split(
    services: _Services,
) -> tuple[dict[str, link.Service], dict[str, link.Service]]:
    """Split into services and actions, which are recognised by the service that receives their goals."""
    plain: dict[str, link.Service] = {}
    actions: dict[str, link.Service] = {}
    for name, by_type in services.items():
        providers = sorted(set().union(*by_type.values()))
        if name.endswith(SEND_GOAL):
            action = name[: -len(SEND_GOAL)]
            types = sorted(type[: -len(GOAL_TYPE)] for type in by_type if type.endswith(GOAL_TYPE))
            if types and not hidden(action):
                actions[action] = link.Service(types=types, providers=providers)
        elif not hidden(name):
            plain[name] = link.Service(types=sorted(by_type), providers=providers)
    return plain, actions


def servers(node: Any, service: str) -> list[Any]:
    """Endpoints that receive the requests of a service; the list of all services also has those for which
    there are only clients.

    :param node: an rclpy node
    :param service: its full name
    """
    return list(node.get_subscriptions_info_by_topic(f"rq{service}Request", no_mangle=True))


def provider(node: Any, service: str, own: tuple[str, ...]) -> str | None:
    """Full name of the node that provides a service; ``None`` if no other node does.

    :param node: an rclpy node
    :param own: names of our own nodes, which are ignored
    """
    for each in servers(node, service):
        # An endpoint whose node is unknown may be our own.
        if each.node_name not in (*own, UNKNOWN):
            return full_name(each.node_name, each.node_namespace)
    return None


def endpoint_ids(endpoints: Iterable[Any]) -> frozenset[bytes]:
    """GIDs of endpoints (``TopicEndpointInfo``); an endpoint that is created again has another one."""
    return frozenset(bytes(bytearray(each.endpoint_gid)) for each in endpoints)


def full_name(name: str, namespace: str) -> str:
    """Name of a node with its namespace."""
    return f"{namespace.rstrip('/')}/{name}"


def hidden(name: str) -> bool:
    """Whether a part of the name begins with ``_`` (ROS 2 design, topic and service names)."""
    return "/_" in name
