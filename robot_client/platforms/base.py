"""What a robot platform offers to the daemon: ROS 2 is one, memory another.

All methods are called on the reactor's thread, all callbacks come there. Requests that can't be done raise
one of :mod:`relay_protocol.errors` with a sentence for the client.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from typing import NamedTuple, Protocol, TypeVar

import msgspec
from twisted.internet.defer import Deferred

from relay_protocol import link
from robot_client.topics import TypedTopic

OnSample = Callable[[bytes], None]
Entry = TypeVar("Entry", link.Topic, link.Service)


class Facts(NamedTuple):
    """What a platform knows of itself, for ``describe``."""

    platform: str
    distro: str = ""
    extra: dict[str, str] = {}  # noqa: RUF012  (NamedTuple default, never changed)


class GraphView(msgspec.Struct, frozen=True, kw_only=True):
    """The whole graph at one moment, without the daemon's own nodes."""

    topics: dict[str, link.Topic] = msgspec.field(default_factory=dict)
    services: dict[str, link.Service] = msgspec.field(default_factory=dict)
    actions: dict[str, link.Service] = msgspec.field(default_factory=dict)
    nodes: frozenset[str] = frozenset()


class Motion(enum.Enum):
    """What a command would do."""

    STILL = "still"
    MOVING = "moving"
    INVALID = "invalid"
    """No message of its type, or with a number that is none (NaN, infinity)."""


class Source(Protocol):
    """A topic the daemon listens to."""

    type: str

    @property
    def latched(self) -> bool:
        """Whether its publishers keep their last messages for late joiners."""

    @property
    def publishers(self) -> int:
        """How many publish now."""

    def close(self) -> None:
        """Stop listening; no sample comes any more."""


class Sink(Protocol):
    """A topic the daemon publishes."""

    def publish(self, body: bytes) -> None:
        """Publish one message in the platform's encoding."""

    def close(self) -> None:
        """Take the publisher away."""


class Platform(Protocol):
    """One robot's middleware."""

    encoding: str

    @property
    def dropped(self) -> int:
        """Samples that never reached the reactor, since start."""

    def start(self) -> None:
        """Connect to the middleware.

        :raises Unavailable: it is not there, in words
        """

    def stop(self) -> None:
        """Leave it; every source and sink is closed."""

    def facts(self) -> Facts:
        """What it is."""

    def graph(self) -> GraphView:
        """What there is now."""

    def subscribe(
        self,
        topic: str,
        type: str,
        qos: link.QoS | None,
        on_sample: OnSample,
        on_change: Callable[[], None],
    ) -> Source:
        """Listen to a topic, present or not yet.

        :param type: empty to take the topic's one type from the graph
        :param on_change: called when :attr:`Source.latched` or :attr:`Source.publishers` changed
        """

    def resolve(self, topic: str, type: str) -> TypedTopic:
        """Name and type that :meth:`advertise` would use, however they are spelled.

        :param type: empty to take the topic's one type from the graph
        """

    def advertise(self, topic: str, type: str, latch: bool, qos: link.QoS | None) -> Sink:
        """Make a publisher."""

    def call(self, service: str, type: str, request: bytes, timeout: float) -> Deferred[bytes]:
        """Call a service once; fails with a sentence. Cancelling the result gives the call up."""

    def definition(self, type: str) -> link.TypeDefinition:
        """The text of a type and all it contains."""

    def judge(self, type: str, body: bytes) -> Motion:
        """What this command would do."""

    def zero(self, type: str) -> bytes:
        """The message of this type that stands still, stamped now where it has a header."""

    def battery(self) -> float | None:
        """Charge, 0 to 1, where known."""

    def trouble(self) -> str | None:
        """A sentence when the middleware is stuck, else ``None``."""


def difference(old: GraphView, new: GraphView) -> link.Graph | None:
    """What changed between two views, as a message; ``None`` if nothing did."""
    nodes: dict[str, dict[str, object] | None] = {name: {} for name in new.nodes - old.nodes}
    nodes.update(dict.fromkeys(old.nodes - new.nodes))
    changes = link.Graph(
        topics=_changed(old.topics, new.topics),
        services=_changed(old.services, new.services),
        actions=_changed(old.actions, new.actions),
        nodes=nodes,
    )
    return changes if changes.topics or changes.services or changes.actions or changes.nodes else None


def whole(view: GraphView) -> link.Graph:
    """A view as a full ``graph`` message."""
    return link.Graph(
        full=True,
        topics=dict(view.topics),
        services=dict(view.services),
        actions=dict(view.actions),
        nodes={name: {} for name in view.nodes},
    )


def _changed(old: dict[str, Entry], new: dict[str, Entry]) -> dict[str, Entry | None]:
    changed: dict[str, Entry | None] = {name: entry for name, entry in new.items() if old.get(name) != entry}
    changed.update(dict.fromkeys(old.keys() - new.keys()))
    return changed
