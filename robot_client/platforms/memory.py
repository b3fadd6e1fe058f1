"""A platform without a robot: topics and services in memory, for tests and for trying the link."""

from __future__ import annotations

import struct
from collections.abc import Callable

from twisted.internet.defer import Deferred, fail, succeed

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound
from robot_client.platforms.base import Facts, GraphView, Motion, OnSample, Platform
from robot_client.platforms.definitions import normalise
from robot_client.topics import TypedTopic

TWIST = "geometry_msgs/msg/Twist"
_HEADER = b"\0\1\0\0"
_TWIST = struct.Struct("<6d")


def twist(forward: float = 0.0, turn: float = 0.0) -> bytes:
    """A Twist as CDR."""
    return _HEADER + _TWIST.pack(forward, 0.0, 0.0, 0.0, 0.0, turn)


class MemorySource:
    """A subscription; samples come by :meth:`MemoryPlatform.emit`."""

    def __init__(self, platform: MemoryPlatform, topic: str, type: str, on_sample: OnSample) -> None:
        self.type = type
        self.topic = topic
        self.latched = False
        self.publishers = 1
        self.on_sample = on_sample
        self.on_change: Callable[[], None] = lambda: None
        self._platform = platform

    def close(self) -> None:
        """Stop listening."""
        self._platform.sources.remove(self)


class MemorySink:
    """A publisher; what it publishes is in :attr:`MemoryPlatform.published`."""

    def __init__(
        self, platform: MemoryPlatform, topic: str, latch: bool = False, qos: link.QoS | None = None
    ) -> None:
        self.topic = topic
        self.latch = latch
        self.qos = qos
        self._platform = platform

    def publish(self, body: bytes) -> None:
        """Record one message."""
        self._platform.published.append((self.topic, body))

    def close(self) -> None:
        """Take the publisher away."""
        self._platform.sinks.remove(self)


Service = Callable[[bytes], "bytes | Deferred[bytes]"]


class MemoryPlatform(Platform):
    """Topics, services and types as one sets them.

    :param view: the graph it shows
    """

    encoding = "cdr"

    def __init__(self, view: GraphView | None = None) -> None:
        self.view = view or GraphView()
        self.sources: list[MemorySource] = []
        self.sinks: list[MemorySink] = []
        self.published: list[tuple[str, bytes]] = []
        self.services: dict[str, Service] = {}
        self.definitions: dict[str, str] = {}
        self.charge: float | None = None
        self.running = False

    @property
    def dropped(self) -> int:
        """Never any."""
        return 0

    def start(self) -> None:
        """Be there."""
        self.running = True

    def stop(self) -> None:
        """Be gone."""
        self.running = False

    def facts(self) -> Facts:
        """What it is."""
        return Facts("memory")

    def graph(self) -> GraphView:
        """The graph set."""
        return self.view

    def emit(self, topic: str, body: bytes) -> None:
        """Let a message appear on a topic."""
        for source in list(self.sources):
            if source.topic == topic:
                source.on_sample(body)

    def subscribe(
        self,
        topic: str,
        type: str,
        qos: link.QoS | None,
        on_sample: OnSample,
        on_change: Callable[[], None],
    ) -> MemorySource:
        """Listen to what is emitted."""
        if not type:
            known = self.view.topics.get(topic)
            if known is None:
                raise NotFound(f"there is no topic {topic} in the robot's graph")
            type = known.types[0]
        source = MemorySource(self, topic, type, on_sample)
        source.on_change = on_change
        self.sources.append(source)
        return source

    def resolve(self, topic: str, type: str) -> TypedTopic:
        """Make name and type full."""
        full = "/" + topic.removeprefix("/")
        known = self.view.topics.get(full)
        if not type and known is None:
            raise Invalid(f"{topic} can't be advertised without a type")
        return TypedTopic(full, normalise(type) if type or known is None else known.types[0])

    def advertise(self, topic: str, type: str, latch: bool, qos: link.QoS | None) -> MemorySink:
        """Make a recording publisher."""
        sink = MemorySink(self, self.resolve(topic, type).topic, latch, qos)
        self.sinks.append(sink)
        return sink

    def call(self, service: str, type: str, request: bytes, timeout: float) -> Deferred[bytes]:
        """Ask the function set for a service."""
        function = self.services.get(service)
        if function is None:
            return fail(NotFound(f"there is no service {service} on this robot"))
        result = function(request)
        return result if isinstance(result, Deferred) else succeed(result)

    def definition(self, type: str) -> link.TypeDefinition:
        """The text set for a type."""
        if type not in self.definitions:
            raise NotFound(f"the type {type} is not installed on this robot")
        return link.TypeDefinition(type=type, text=self.definitions[type])

    def judge(self, type: str, body: bytes) -> Motion:
        """Look into a Twist."""
        if len(body) != len(_HEADER) + _TWIST.size:
            return Motion.INVALID
        values = _TWIST.unpack_from(body, len(_HEADER))
        if any(value != value or abs(value) == float("inf") for value in values):
            return Motion.INVALID
        return Motion.MOVING if any(values) else Motion.STILL

    def zero(self, type: str) -> bytes:
        """A Twist that stands still."""
        return twist()

    def battery(self) -> float | None:
        """The charge set."""
        return self.charge

    def trouble(self) -> str | None:
        """Never any."""
        return None
