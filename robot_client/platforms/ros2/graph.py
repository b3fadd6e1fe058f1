"""The ROS 2 graph, read node by node, which is cheaper than by topic.

Hidden topics are included, since clients may subscribe to them by name; hidden nodes, services and actions
are not.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from typing import Any, NamedTuple

from relay_protocol import link
from relay_protocol.link.motion import SEND_GOAL
from robot_client.platforms.base import GraphView

GOAL_TYPE = "_SendGoal"
UNKNOWN = "_NODE_NAME_UNKNOWN_"
"""Name of the node of an endpoint whose node is not discovered yet, or which has none."""


class _Topics(NamedTuple):
    types: dict[str, set[str]]
    publishers: dict[str, set[str]]
    subscribers: dict[str, set[str]]


def read(node: Any, own: tuple[str, ...]) -> GraphView:
    """Read the whole graph from the middleware's cache.

    :param node: an rclpy node
    :param own: prefixes of the full names of nodes that are left out, with everything that only they have
    """
    topics = _Topics(defaultdict(set), defaultdict(set), defaultdict(set))
    services: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    nodes = set()
    for name, namespace in node.get_node_names_and_namespaces():
        full = full_name(name, namespace)
        if full.startswith(own) or name == UNKNOWN:
            continue
        if not hidden(full):
            nodes.add(full)
        _read_node(node, name, namespace, full, topics, services)
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


def _read_node(
    node: Any, name: str, namespace: str, full: str, topics: _Topics, services: dict[str, dict[str, set[str]]]
) -> None:
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
    services: dict[str, dict[str, set[str]]],
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


def provider(node: Any, service: str, own: tuple[str, ...]) -> str | None:
    """Full name of the node that provides a service; ``None`` if no other node does.

    Read node by node: the list of all services also has those for which there are only clients.

    :param node: an rclpy node
    :param own: names of our own nodes, which are ignored
    """
    for name, namespace in node.get_node_names_and_namespaces():
        if name in own:
            continue
        if service in _served(node, name, namespace):
            return full_name(name, namespace)
    return None


def _served(node: Any, name: str, namespace: str) -> set[str]:
    try:
        return {each for each, _ in node.get_service_names_and_types_by_node(name, namespace)}
    except Exception:  # the node left between two calls
        return set()


def endpoint_ids(endpoints: Iterable[Any]) -> frozenset[bytes]:
    """GIDs of endpoints (``TopicEndpointInfo``); an endpoint that is created again has another one."""
    return frozenset(bytes(bytearray(each.endpoint_gid)) for each in endpoints)


def full_name(name: str, namespace: str) -> str:
    """Name of a node with its namespace."""
    return f"{namespace.rstrip('/')}/{name}"


def hidden(name: str) -> bool:
    """Whether a part of the name begins with ``_`` (ROS 2 design, topic and service names)."""
    return "/_" in name
