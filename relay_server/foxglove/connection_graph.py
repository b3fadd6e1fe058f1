"""The robot's graph as a client may see it: whole at first, then differences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from relay_protocol.limits import KIB
from relay_protocol.link import Service, Topic
from relay_server.foxglove import messages
from relay_server.foxglove.context import FoxgloveContext
from relay_server.relay_node.visible_graph import VisibleGraph, hidden, visible_graph

WAITING_BYTES = 128 * KIB
"""While more bytes wait for the client, differences wait too."""

Ends = dict[str, tuple[str, ...]]
"""Full names of nodes, by the name of a topic or service."""


class ConnectionGraph:
    """The subscription of one client to the graph."""

    def __init__(self, context: FoxgloveContext) -> None:
        self._context = context
        self._sent: tuple[Ends, Ends, Ends] | None = None
        """Publishers, subscribers and providers that the client knows; ``None``: the graph is not subscribed."""
        self._seen: VisibleGraph | None = None

    def subscribe(self) -> None:
        """Send the whole graph, and differences from now on."""
        self._sent, self._seen = ({}, {}, {}), None
        self._send_difference(always=True)

    def unsubscribe(self) -> None:
        """Send no more differences."""
        self._sent = None

    def update(self) -> None:
        """Send what has changed, if the graph is subscribed; while the client does not read, changes are joined."""
        if self._sent is not None and self._context.send_queue.waiting_bytes < WAITING_BYTES:
            self._send_difference(always=False)

    def _send_difference(self, *, always: bool) -> None:
        graph = visible_graph(self._context.client)
        if graph is self._seen:
            return
        self._seen = graph
        publishers, subscribers, providers = now = _ends_of(graph)
        before = self._sent or ({}, {}, {})
        self._sent = now
        topics = {*before[0], *before[1]} - {*publishers, *subscribers}
        services = [name for name in before[2] if name not in providers]
        changes: dict[str, Any] = {
            "publishedTopics": _changes(before[0], publishers, "publisherIds", topics),
            "subscribedTopics": _changes(before[1], subscribers, "subscriberIds", topics),
            "advertisedServices": _changes(before[2], providers, "providerIds", set(services)),
            "removedTopics": sorted(topics),
            "removedServices": services,
        }
        if always or any(changes.values()):
            self._context.send(messages.text("connectionGraphUpdate", **changes))


def _ends_of(graph: VisibleGraph) -> tuple[Ends, Ends, Ends]:
    topics: Mapping[str, Topic] = graph.topics
    services: Mapping[str, Service] = graph.services
    return (
        {name: nodes for name, topic in topics.items() if (nodes := _listed(topic.publishers))},
        {name: nodes for name, topic in topics.items() if (nodes := _listed(topic.subscribers))},
        {name: _listed(service.providers) for name, service in services.items()},
    )


def _listed(nodes: list[str]) -> tuple[str, ...]:
    """Nodes without hidden ones, such as that of ros2cli's daemon."""
    return tuple(node for node in nodes if not hidden(node))


def _changes(before: Ends, now: Ends, key: str, removed: set[str]) -> list[dict[str, Any]]:
    """Entries that are new or different; one that has lost its last node is empty, unless its name was removed."""
    found = [{"name": name, key: list(ids)} for name, ids in now.items() if before.get(name) != ids]
    found += [{"name": name, key: []} for name in before if name not in now and name not in removed]
    return found
