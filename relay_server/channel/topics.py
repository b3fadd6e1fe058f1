"""One topic of one robot, on its way to the clients and from them."""

from __future__ import annotations

import enum
from collections import deque
from collections.abc import Callable
from typing import NamedTuple, Protocol

from relay_protocol import jsontext, limits, rosbridge
from relay_protocol.errors import Invalid, Refused, SwitchboardError
from relay_protocol.link import QoS
from relay_protocol.ros_types import TypeRegistry
from relay_server.channel.wire import Member
from relay_server.clock import Clock, Timer

LATCHED_KEPT = 64
"""Most latched samples kept for late joiners of one topic (one for each publisher)."""

KEPT_BYTES = limits.ROBOT_FRAME
"""Most bytes of latched samples kept for one topic, and most that wait for its type."""

THROTTLE_SECONDS = 3600.0
"""Longest throttle; a client that asks for more gets this."""

ASKS = 64
"""Subscriptions of one client to one topic, merged into one listener."""


class Sample:
    """One message from the robot. It is converted at most once, and only if somebody takes it."""

    __slots__ = ("_body", "_convert", "_encoded", "_payloads", "failure", "size")

    def __init__(self, body: bytes, convert: Callable[[bytes], bytes]) -> None:
        self._body = body
        self._convert = convert
        self.size = len(body)
        self._encoded: bytes | None = None
        self._payloads: dict[str, bytes] = {}
        self.failure: str = ""

    def payload(self, topic: str) -> bytes | None:
        """The rosbridge ``publish`` for a client that calls the topic so; ``None`` when it can't be converted."""
        found = self._payloads.get(topic)
        if found is None:
            if self._encoded is None:
                if self.failure:
                    return None
                try:
                    self._encoded = self._convert(self._body)
                except SwitchboardError as error:
                    self.failure = str(error)
                    return None
            found = self._payloads[topic] = rosbridge.publish(topic, self._encoded)
        return found


def converter(types: TypeRegistry, type_name: str, encoding: str) -> Callable[[bytes], bytes]:
    """What turns a sample's body into JSON."""
    if encoding == "json":
        return _json_anew
    return lambda body: types.to_json(type_name, body)


def _json_anew(body: bytes) -> bytes:
    """A robot's own JSON, decoded and written anew: what goes out is well-formed whatever came in."""
    if len(body) > limits.JSON_BODY:
        raise Invalid(f"JSON of {len(body)} bytes; a sample in JSON may have {limits.JSON_BODY}")
    return jsontext.encode(jsontext.decode_any(body))


class Receiver(Protocol):
    """A session, as a topic's listeners use it."""

    def deliver(self, topic: str, payload: bytes, depth: int) -> None:
        """Queue a sample for the client."""


class Listener:
    """One client's interest in one topic: its subscriptions merged, as rosbridge does.

    :param name: the topic as the client writes it
    """

    def __init__(self, clock: Clock, receiver: Receiver, name: str) -> None:
        self._clock = clock
        self._receiver = receiver
        self.name = name
        self.throttle = 0.0
        """Least seconds between two samples: the least any of the subscriptions asks for."""
        self.depth = 0
        """Samples that may wait for this client; 0 leaves it to the relay."""
        self._asks: dict[rosbridge.Id, rosbridge.Subscribe] = {}
        self._next_at = 0.0
        self._waiting: Sample | None = None
        self._timer: Timer | None = None

    def add(self, ask: rosbridge.Subscribe) -> None:
        """One more subscription, or another one under the same id.

        :raises Refused: too many on this topic
        """
        if ask.id not in self._asks and len(self._asks) >= ASKS:
            raise Refused(f"at most {ASKS} subscriptions to one topic can be held on one connection")
        self._asks[ask.id] = ask
        self._merge()

    def remove(self, id: rosbridge.Id) -> bool:
        """One subscription less; whether any are left."""
        self._asks.pop(id, None)
        self._merge()
        return bool(self._asks)

    def _merge(self) -> None:
        asks = self._asks.values()
        least = min((ask.throttle_rate for ask in asks), default=0.0) / 1000
        self.throttle = min(max(0.0, least), THROTTLE_SECONDS)
        self.depth = max(0, max((ask.queue_length for ask in asks), default=0))

    def offer(self, sample: Sample) -> None:
        """A new sample. Within the throttle the newest waits, so the last of a burst always arrives."""
        throttle = self.throttle
        if throttle:
            now = self._clock.seconds()
            if now < self._next_at:
                self._waiting = sample
                if self._timer is None:
                    self._timer = self._clock.callLater(self._next_at - now, self._due)
                return
            self._next_at = now + throttle
        # What waited under a longer throttle is older than this one.
        self.close()
        self._send(sample)

    def replay(self, sample: Sample) -> None:
        """A latched sample for a late joiner; each is of another publisher, so no throttle drops any."""
        self._send(sample)

    def close(self) -> None:
        """Stop; nothing more is sent."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._waiting = None

    def _due(self) -> None:
        self._timer = None
        sample, self._waiting = self._waiting, None
        if sample is not None:
            self._next_at = self._clock.seconds() + self.throttle
            self._send(sample)

    def _send(self, sample: Sample) -> None:
        payload = sample.payload(self.name)
        if payload is not None:
            self._receiver.deliver(self.name, payload, self.depth)


class Phase(enum.Enum):
    """How far a subscription or publication has come on the robot."""

    WAITING = "waiting"
    """Not asked: the robot is away, or the topic's type is not known yet."""
    ASKED = "asked"
    ACTIVE = "active"
    FAILED = "failed"


class TopicUplink:
    """A topic the relay subscribes to on the robot, once, for all its listeners.

    :param type_name: as the first client gave it, or from the graph; empty when nobody knows it yet
    """

    def __init__(self, number: int, topic: str, type_name: str, qos: QoS | None) -> None:
        self.number = number
        self.topic = topic
        self.type = type_name
        self.qos = qos
        self.phase = Phase.WAITING
        self.throttle_ms = 0
        self.encoding = "cdr"
        self.latched = False
        self.listeners: dict[Member, Listener] = {}
        self._recent: deque[Sample] = deque(maxlen=1)
        self._untyped: deque[bytes] = deque(maxlen=LATCHED_KEPT)
        self.failures = 0

    def activate(self, type_name: str, encoding: str, latched: bool, publishers: int) -> None:
        """The robot has subscribed."""
        self.phase = Phase.ACTIVE
        self.type = type_name
        self.encoding = encoding
        self.latched = latched
        self._recent = deque(self._recent, maxlen=min(max(publishers, 1), LATCHED_KEPT))

    def reset(self) -> None:
        """The robot's side is gone."""
        self.phase = Phase.WAITING
        self._recent.clear()
        self._untyped.clear()

    def least_throttle_ms(self) -> int:
        """The throttle that still satisfies every listener."""
        return int(min((listener.throttle for listener in self.listeners.values()), default=0.0) * 1000)

    def sample(self, body: bytes, types: TypeRegistry) -> Sample | None:
        """Take a sample from the robot and hand it to the listeners."""
        if self.encoding == "cdr" and not types.knows(self.type):
            self._untyped.append(body)
            while sum(map(len, self._untyped)) > KEPT_BYTES:
                self._untyped.popleft()
            return None
        sample = Sample(body, converter(types, self.type, self.encoding))
        if self.latched:
            self._recent.append(sample)
            while sum(each.size for each in self._recent) > KEPT_BYTES:
                self._recent.popleft()
        for listener in list(self.listeners.values()):
            listener.offer(sample)
        return sample

    def typed(self, types: TypeRegistry) -> None:
        """The type's definition has come: hand on what waited for it."""
        waiting = list(self._untyped)
        self._untyped.clear()
        for body in waiting:
            self.sample(body, types)

    def replay(self, listener: Listener) -> None:
        """Give a late joiner the latched samples the others have had."""
        for sample in list(self._recent):
            listener.replay(sample)


class Held(NamedTuple):
    """A message that waits for the moment until it can be sent; see :meth:`Publications.publish`.

    :param until: seconds of the relay's clock; nobody wants it sent later
    """

    member: Member
    body: bytes
    stamp: int
    failed: Callable[[str], None]
    until: float


class Publication:
    """A topic clients publish to, advertised once on the robot."""

    def __init__(self, number: int, topic: str, type_name: str) -> None:
        self.number = number
        self.topic = topic
        self.type = type_name
        self.latch = False
        self.queue_size = 0
        self.qos: QoS | None = None
        self.phase = Phase.WAITING
        self.holders: dict[Member, set[rosbridge.Id]] = {}
        self.held: deque[Held] = deque()
