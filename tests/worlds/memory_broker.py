"""An MQTT broker in memory, as the gateway sees it: a test publishes, and reads what was published."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from relay_protocol.errors import Unavailable
from robot_client.platforms.mqtt.broker import BrokerListener, MqttMessage


def matches(pattern: str, topic: str) -> bool:
    """Whether a subscription with ``+`` matches a topic."""
    wanted, parts = pattern.split("/"), topic.split("/")
    return len(wanted) == len(parts) and all(a in ("+", b) for a, b in zip(wanted, parts, strict=True))


class MemoryBroker:
    """Retained messages, subscriptions and messages of the gateway."""

    listener: BrokerListener

    def __init__(self) -> None:
        self.dropped = 0
        self.running = False
        self.connected = False
        self.retained: dict[str, bytes] = {}
        self.subscribed: set[str] = set()
        self.published: list[tuple[str, str, int, bool]] = []
        self._waiting: deque[MqttMessage] = deque()

    def start(self) -> None:
        self.running = True

    def stop(self) -> None:
        self.running = False

    def connect(self) -> None:
        """Accepts the connection."""
        self.connected = True
        self.listener.on_connected()

    def lose(self, reason: str = "the connection was lost") -> None:
        """Ends the connection."""
        self.connected = False
        self.subscribed.clear()
        self.listener.on_lost(reason)

    def send(self, topic: str, payload: str | bytes, retain: bool = False) -> None:
        """Publishes as a device."""
        body = payload.encode() if isinstance(payload, str) else payload
        if retain:
            self.retained[topic] = body
        if any(matches(each, topic) for each in self.subscribed):
            self._deliver(topic, body)

    def _deliver(self, topic: str, body: bytes) -> None:
        self._waiting.append(MqttMessage(topic, body))
        self.listener.on_waiting()

    def take(self) -> MqttMessage | None:
        return self._waiting.popleft() if self._waiting else None

    def subscribe(self, topics: Iterable[str]) -> None:
        if not self.connected:
            return
        for pattern in topics:
            self.subscribed.add(pattern)
            for topic, body in list(self.retained.items()):
                if matches(pattern, topic):
                    self._deliver(topic, body)

    def unsubscribe(self, topics: Iterable[str]) -> None:
        self.subscribed.difference_update(topics)

    def publish(
        self, topic: str, payload: str, qos: int = 0, retain: bool = False, *, stops: bool = False
    ) -> None:
        if not self.connected:
            raise Unavailable("the gateway is not connected to the MQTT broker")
        self.published.append((topic, payload, qos, retain))
