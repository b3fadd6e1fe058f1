"""One topic of one robot, on its way to the clients and from them."""

from __future__ import annotations

import enum
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from relay_protocol import limits, rosbridge
from relay_protocol.link import QoS, Topic
from relay_protocol.ros_types import TypeRegistry
from relay_server.channel.listener import Listener
from relay_server.channel.sample import Converter, Sample
from relay_server.channel.wire import Commander, Member
from relay_server.clock import Timer, cancel

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

    :param type_name: empty when nobody knows it yet
    :param types: gives what is known of the robot's types
    :param broken: called with the reason when a message can't be converted, the first time
    """

    def __init__(
        self,
        number: int,
        topic: str,
        type_name: str,
        qos: QoS | None,
        types: Callable[[], TypeRegistry],
        broken: Callable[[TopicUplink, str], None],
    ) -> None:
        self.number = number
        self.topic = topic
        self.type = type_name
        self.certain = False
        """Whether the robot has the topic with this type; else the type is what a client says."""
        self.qos = qos
        self.phase = Phase.WAITING
        self.throttle_ms = 0
        self.encoding = "cdr"
        self.latched = False
        self.refusals = 0
        """How often the robot has refused to subscribe since it last did."""
        self.patience = 0
        """Refusals that are nothing to tell yet."""
        self.retry: Timer | None = None
        self.untypeable = ""
        """Why the type's definition is not to be had."""
        self.failures = 0
        self.taken = 0
        """Samples that have come."""
        self.listeners: dict[Member, Listener] = {}
        self.wanted: dict[Member, str] = {}
        """The type each client says the topic has; those who leave it to the graph are not here."""
        self.served: list[Listener] = []
        """Those who get the samples: not those who say another type."""
        self.owed: dict[Member, Listener] = {}
        """Late joiners that get the latched samples when the topic is inhibited no more."""
        self._types = types
        self._broken = broken
        self._converter = self._new_converter()
        self._recent: deque[Sample] = deque(maxlen=1)
        self._untyped: deque[Sample] = deque(maxlen=LATCHED_KEPT)

    # --- who listens --------------------------------------------------------------------------------------

    def join(self, member: Member, listener: Listener, type_name: str | None) -> None:
        """A client listens, or listens otherwise than before.

        :param type_name: empty when it leaves the type to the graph, ``None`` when it is as before
        """
        self.listeners[member] = listener
        if type_name:
            self.wanted[member] = type_name
        elif type_name is not None:
            self.wanted.pop(member, None)
        self._serve()

    def leave(self, member: Member) -> bool:
        """A client listens no more; whether it did."""
        self.wanted.pop(member, None)
        self.owed.pop(member, None)
        left = self.listeners.pop(member, None) is not None
        self._serve()
        return left

    def serves(self, member: Member) -> bool:
        """Whether a client gets the samples."""
        return member in self.listeners and self.wanted.get(member, self.type) == self.type

    def mistaken(self) -> list[tuple[Member, str]]:
        """Those who say another type, and which."""
        return [(member, wanted) for member, wanted in self.wanted.items() if wanted != self.type]

    def _serve(self) -> None:
        self.served = [listener for member, listener in self.listeners.items() if self.serves(member)]

    def least_throttle_ms(self) -> int:
        """The throttle that still satisfies everyone who is served."""
        return int(min((listener.spared for listener in self.served), default=0.0) * 1000)

    # --- the robot's side ---------------------------------------------------------------------------------

    def asked(self) -> None:
        """The robot has been asked to subscribe."""
        self.phase = Phase.ASKED
        cancel(self.retry)
        self._converter = self._new_converter()

    def activate(self, type_name: str, encoding: str, latched: bool, publishers: int) -> None:
        """The robot has subscribed."""
        self.phase = Phase.ACTIVE
        self.refusals = 0
        if (type_name, encoding) != (self.type, self.encoding):
            self._forget()
        self.encoding = encoding
        self.latched = latched
        self.retype(type_name)
        self._recent = deque(self._recent, maxlen=min(max(publishers, 1), LATCHED_KEPT))
        if not self.untypeable:
            self._mended()

    def retype(self, type_name: str) -> None:
        """The topic has this type."""
        if type_name != self.type:
            self.untypeable = ""
        self.type = type_name
        self._converter = self._new_converter()
        self._serve()

    def reset(self) -> None:
        """The robot's side is gone."""
        self.phase = Phase.WAITING
        self.refusals = self.patience = 0
        self.untypeable = ""
        cancel(self.retry)
        self._forget()
        self._mended()

    def _mended(self) -> None:
        for listener in self.listeners.values():
            listener.mended()

    def _forget(self) -> None:
        self.owed.clear()
        self._recent.clear()
        self._untyped.clear()

    def _new_converter(self) -> Converter:
        return Converter(self._types(), self.type, self.encoding, self._failed)

    def _failed(self, reason: str) -> None:
        self.failures += 1
        if self.failures == 1:
            self._broken(self, reason)

    # --- samples ------------------------------------------------------------------------------------------

    def sample(self, body: bytes, stamp: int) -> None:
        """Take a sample from the robot and hand it to the listeners."""
        self.taken += 1
        converter = self._converter
        sample = Sample(body, stamp, converter)
        if self.latched:
            self.pay()
            _keep(self._recent, sample)
        if converter.known or converter.knows:
            for listener in self.served:
                listener.offer(sample)
            return
        _keep(self._untyped, sample)
        for listener in self.served:
            if listener.raw:
                listener.offer(sample)

    def typed(self) -> None:
        """The type's definition has come, or another one: hand on what waited for it."""
        self._converter = self._new_converter()
        if self.untypeable:
            self.untypeable = ""
            self._mended()
        waiting = list(self._untyped)
        self._untyped.clear()
        for sample in waiting:
            for listener in self.served:
                if not listener.raw:
                    listener.offer(sample)

    def replay(self, listener: Listener) -> None:
        """Give a late joiner the latched samples the others have had."""
        if self._converter.knows or listener.raw:
            for sample in list(self._recent):
                listener.replay(sample)

    def pay(self) -> None:
        """The topic is inhibited no more: late joiners get what the others have had."""
        if not self.owed:
            return
        owed, self.owed = self.owed, {}
        for member, listener in owed.items():
            if self.serves(member):
                self.replay(listener)


def _keep(samples: deque[Sample], sample: Sample) -> None:
    """The newest count, as far as they are not too large together."""
    samples.append(sample)
    while sum(each.size for each in samples) > KEPT_BYTES:
        samples.popleft()


Send = Callable[[bytes, int, int], None]
"""Takes a message's JSON, part of a text that was checked, its stamp (the relay's monotonic nanoseconds), and the
number of the connection it comes from, which goes with commands. Raises :class:`Invalid` when the message is not of the
topic's type."""


class Held(NamedTuple):
    """A message that waits for the moment until it can be sent; see :meth:`Publications.publish`.

    :param id: of the client's ``publish``, for what is told about it
    :param until: seconds of the relay's clock; nobody wants it sent later
    """

    member: Commander
    body: bytes
    stamp: int
    id: rosbridge.Id
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
        self.motion = False
        """Whether the robot counts it as motion: what goes there are commands, with their source."""
        self.send: Send | None = None
        """Sends a message to the robot; ``None`` while none can be sent, and until the first after a change."""
        self.holders: dict[Member, dict[rosbridge.Id, str]] = {}
        """Advertisements of each client by id, with why the robot could not, as far as its client was told."""
        self.held: deque[Held] = deque()
        self.seen: Topic | None = None
        """The topic in the robot's graph when the robot was last asked."""

    def enter(self, phase: Phase) -> None:
        """Go on to this phase; how messages are sent is found out anew."""
        self.phase = phase
        self.send = None
