"""One topic of one robot, on its way to the clients and from them."""

from __future__ import annotations

import enum
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from relay_protocol import limits, rosbridge
from relay_protocol.link import QoS
from relay_protocol.ros_types import TypeRegistry
from relay_server.channel.listener import Listener
from relay_server.channel.sample import Sample, converter
from relay_server.channel.wire import Member

LATCHED_KEPT = 64
"""Most latched samples kept for late joiners of one topic (one for each publisher)."""

KEPT_BYTES = limits.ROBOT_FRAME
"""Most bytes of latched samples kept for one topic, and most that wait for its type."""


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
