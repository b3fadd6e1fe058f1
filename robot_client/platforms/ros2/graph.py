"""The ROS 2 graph as the relay wants it: by node, which is cheaper than by topic.

Hidden topics are in it, since clients may subscribe to them by name; hidden nodes, services and actions are not.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any, NamedTuple

from relay_protocol import link
from robot_client.platforms.base import GraphView

GOAL = "/_action/send_goal"
"""What the service is called that takes an action's goals."""
GOAL_TYPE = "_SendGoal"
_UNKNOWN = "_NODE_NAME_UNKNOWN_"


class _Found(NamedTuple):
    types: dict[str, set[str]]
    publishers: dict[str, set[str]]
    subscribers: dict[str, set[str]]


def read(node: Any, own: tuple[str, ...]) -> GraphView:
    """Ask the middleware's cache for everything.

    :param node: an rclpy node
    :param own: how the full names of nodes begin that are left out, with all that is theirs alone
    """
    topics = _Found(defaultdict(set), defaultdict(set), defaultdict(set))
    services: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    nodes = set()
    for name, namespace in node.get_node_names_and_namespaces():
        full = full_name(name, namespace)
        if full.startswith(own) or name == _UNKNOWN:
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
    node: Any, name: str, namespace: str, full: str, topics: _Found, services: dict[str, dict[str, set[str]]]
) -> None:
    try:
        published = node.get_publisher_names_and_types_by_node(name, namespace)
        subscribed = node.get_subscriber_names_and_types_by_node(name, namespace)
        served = node.get_service_names_and_types_by_node(name, namespace)
    except Exception:  # the node left between two questions; rclpy's error for it has changed its name
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
    """Services, and actions, which are known by the service that takes their goals."""
    plain: dict[str, link.Service] = {}
    actions: dict[str, link.Service] = {}
    for name, by_type in services.items():
        providers = sorted(set().union(*by_type.values()))
        if name.endswith(GOAL):
            action = name[: -len(GOAL)]
            types = sorted(type[: -len(GOAL_TYPE)] for type in by_type if type.endswith(GOAL_TYPE))
            if types and not hidden(action):
                actions[action] = link.Service(types=types, providers=providers)
        elif not hidden(name):
            plain[name] = link.Service(types=sorted(by_type), providers=providers)
    return plain, actions


def provider(node: Any, service: str, own: tuple[str, ...]) -> str | None:
    """Which node provides a service, the full name; ``None`` if no other does.

    Asked node by node: the list of all services has those too that somebody only waits for.

    :param node: an rclpy node
    :param own: names of our own nodes, which don't count
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
    except Exception:  # the node left between two questions
        return set()


def full_name(name: str, namespace: str) -> str:
    """Name of a node with its namespace."""
    return f"{namespace.rstrip('/')}/{name}"


def hidden(name: str) -> bool:
    """Names with a part that begins with ``_`` are not for people (ROS 2 design, topic and service names)."""
    return "/_" in name
