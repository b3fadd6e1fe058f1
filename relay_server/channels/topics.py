"""One topic of one robot, on its way to the clients and from them."""

from __future__ import annotations

import enum
from collections import Counter, deque
from collections.abc import Callable
from typing import NamedTuple

from relay_protocol import link, rosbridge
from relay_protocol.link import QoS, Topic
from relay_protocol.ros_types import TypeRegistry
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.latched import KEPT_BYTES, Latched
from relay_server.channels.robot_link import Publisher, Subscriber
from relay_server.channels.samples import Converter, RenderError, Sample
from relay_server.common.clock import Clock, Timer, cancel

UNTYPED = 64
"""Most samples of one topic that wait for its type."""

TOO_LARGE, SLOW_LINK, UNREADABLE, NO_TYPE, OTHER = "too_large", "slow_link", "unreadable", "no_type", "other"
LOSSES = (TOO_LARGE, SLOW_LINK)
"""What a robot says of samples it has not sent."""


class RequestPhase(enum.Enum):
    """How far a subscription or publication has come on the robot."""

    WAITING = "waiting"
    """Not asked: the robot is away, or the topic's type is not known yet."""
    ASKED = "asked"
    ACTIVE = "active"
    FAILED = "failed"


class RobotSubscription:
    """A topic the relay subscribes to on the robot, once, for all its listeners.

    :param type_name: empty when nobody knows it yet
    :param types: gives what is known of the robot's types
    :param broken: called with the reason when a message can't be converted, the first time
    :param ask: asks the robot which samples the topic's publishers keep
    """

    def __init__(
        self,
        clock: Clock,
        number: int,
        topic: str,
        type_name: str,
        qos: QoS | None,
        types: Callable[[], TypeRegistry],
        broken: Callable[[RobotSubscription, str], None],
        ask: Callable[[RobotSubscription], None],
    ) -> None:
        self.number = number
        self.topic = topic
        self.type = type_name
        self.certain = False
        """Whether the robot has the topic with this type; else the type is what a client says."""
        self.qos = qos
        self.phase = RequestPhase.WAITING
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
        self.unmatched: list[str] = []
        """Publishers that are not heard because of the quality of service a client has asked for, with the reason."""
        self.losses: Counter[str] = Counter()
        """Samples that no client got, by the reason (SPEC section 1.7, ``lost``)."""
        self.taken = 0
        """Samples that have come."""
        self.listeners: dict[Subscriber, ClientSubscription] = {}
        self.wanted: dict[Subscriber, str] = {}
        """The type each client says the topic has; those who leave it to the graph are not here."""
        self.served: list[ClientSubscription] = []
        """Those who get the samples: not those who say another type."""
        self._live: list[ClientSubscription] = []
        """Those of :attr:`served` who get samples as they come: not those who are to get older ones first."""
        self._early: set[Subscriber] = set()
        """Those who have subscribed while the robot was away."""
        self.owed: dict[Subscriber, ClientSubscription] = {}
        """Late joiners that get the latched samples when the topic is inhibited no more."""
        self._types = types
        self._broken = broken
        self._converter = self._new_converter()
        self.kept = Latched(clock, lambda: ask(self), self._serve)
        self._untyped: deque[Sample] = deque(maxlen=UNTYPED)
        self._unready: set[Subscriber] = set()
        """Those who are to get what publishers keep when the topic's type is known."""
        self._stamp = 0
        """Of the latest sample."""
        self._since: dict[Subscriber, int] = {}
        """The latest stamp when each subscribed to a topic that was not latched then, as far as the robot had said."""

    # --- who listens --------------------------------------------------------------------------------------

    def join(self, member: Subscriber, listener: ClientSubscription, type_name: str | None) -> None:
        """A client listens, or listens otherwise than before.

        :param type_name: empty when it leaves the type to the graph, ``None`` when it is as before
        """
        if self.phase is not RequestPhase.ACTIVE and member not in self.listeners:
            self._early.add(member)
        self.listeners[member] = listener
        if type_name:
            self.wanted[member] = type_name
        elif type_name is not None:
            self.wanted.pop(member, None)
        self._serve()

    def leave(self, member: Subscriber) -> bool:
        """A client listens no more; whether it did."""
        self.wanted.pop(member, None)
        self.owed.pop(member, None)
        self._early.discard(member)
        self._unready.discard(member)
        self._since.pop(member, None)
        self.kept.leave(member)
        left = self.listeners.pop(member, None) is not None
        self._serve()
        return left

    def serves(self, member: Subscriber) -> bool:
        """Whether a client gets the samples."""
        return member in self.listeners and self.wanted.get(member, self.type) == self.type

    def mistaken(self) -> list[tuple[Subscriber, str]]:
        """Those who say another type, and which."""
        return [(member, wanted) for member, wanted in self.wanted.items() if wanted != self.type]

    def _serve(self) -> None:
        served = [member for member in self.listeners if self.serves(member)]
        self.served = [self.listeners[member] for member in served]
        self._live = [self.listeners[member] for member in served if not self.kept.holds(member)]

    def least_throttle_ms(self) -> int:
        """The throttle that still satisfies everyone who is served."""
        return int(min((listener.spared for listener in self.served), default=0.0) * 1000)

    # --- the robot's side ---------------------------------------------------------------------------------

    def asked(self) -> None:
        """The robot has been asked to subscribe."""
        self.phase = RequestPhase.ASKED
        cancel(self.retry)
        self._converter = self._new_converter()

    def activate(self, type_name: str, encoding: str, latched: bool, publishers: int, memory: str) -> None:
        """The robot has subscribed, or its publishers have changed.

        :param memory: see :attr:`Latched.memory`
        """
        begins = latched and not (self.latched and self.phase is RequestPhase.ACTIVE)
        self.phase = RequestPhase.ACTIVE
        self.refusals = 0
        if (type_name, encoding) != (self.type, self.encoding):
            self._forget()
        self.encoding = encoding
        self.latched = latched
        self.retype(type_name)
        early, self._early = self._early, set()
        if latched:
            self.kept.robot(memory, publishers)
        if begins and memory:
            self.kept.begin(self._stamp)
            self._begin_latched(early)
        if not self.untypeable:
            self._mended()

    def _begin_latched(self, early: set[Subscriber]) -> None:
        """The robot begins to send what publishers keep.

        A throttle would let nothing but the last of it through. Those who subscribed before have had some of it: what
        came since then.
        """
        since, self._since = self._since, {}
        for member, listener in list(self.listeners.items()):
            if listener.throttle or (member in early and self.kept.newest):
                self.welcome(member, listener, live=False)
            elif member in since and self.serves(member):
                self.kept.join(member, listener, live=True, since=since[member])

    def retype(self, type_name: str) -> None:
        """The topic has this type."""
        if type_name != self.type:
            self.untypeable = ""
        self.type = type_name
        self._converter = self._new_converter()
        self._serve()

    def reset(self) -> None:
        """The robot is not subscribed any more."""
        self._pause()
        self._forget()

    def lost(self) -> None:
        """The robot's side is gone; when it is back it may go on with the samples that it sent before."""
        self._pause()
        self.kept.lost()
        self._stamp = 0
        self._untyped.clear()
        self._unready.clear()
        self._since.clear()
        self._serve()

    def _pause(self) -> None:
        self.phase = RequestPhase.WAITING
        self.refusals = self.patience = 0
        self.untypeable = ""
        self.unmatched = []
        self.owed.clear()
        cancel(self.retry)
        self._mended()

    def _mended(self) -> None:
        for listener in self.listeners.values():
            listener.mended()

    def _forget(self) -> None:
        self.owed.clear()
        self.kept.forget()
        self._stamp = 0
        self._untyped.clear()
        self._unready.clear()
        self._since.clear()
        self._serve()

    def _new_converter(self) -> Converter:
        return Converter(self._types(), self.type, self.encoding, self._failed)

    def _failed(self, reason: str) -> None:
        self.losses[UNREADABLE] += 1
        if self.losses[UNREADABLE] == 1:
            self._broken(self, reason)

    def not_sent(self, loss: link.Lost) -> None:
        """The robot has not sent some samples."""
        self.losses[loss.reason if loss.reason in LOSSES else OTHER] += loss.count
        for listener in list(self.listeners.values()):
            listener.missed(loss.count)
        if loss.reason == TOO_LARGE:
            for listener in list(self.listeners.values()):
                listener.complain(
                    RenderError.NOT_SENT,
                    f"a message of {loss.size} bytes is too large to be sent. Publish it smaller, or raise "
                    "--largest-sample-mb of the relay and largest_sample_mb of the robot",
                )

    # --- samples ------------------------------------------------------------------------------------------

    def sample(self, body: bytes, time: int, stamp: int) -> None:
        """Take a sample from the robot and hand it to the listeners.

        :param time: the robot's time when it came, nanoseconds
        :param stamp: of the frame
        """
        converter = self._converter
        sample = Sample(body, time, converter)
        if self.latched:
            self.pay()
            if not self.kept.take(stamp, sample):
                return
        self.taken += 1
        self._stamp = stamp
        if converter.known or converter.knows:
            for listener in self._live:
                listener.offer(sample)
            return
        self.losses[NO_TYPE] += _keep(self._untyped, sample)
        for listener in self._live:
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
        unready, self._unready = self._unready, set()
        for member in unready:
            if self.serves(member):
                self.welcome(member, self.listeners[member], live=False)
        for sample in waiting:
            for listener in self._live:
                if not listener.raw:
                    listener.offer(sample)

    def welcome(self, member: Subscriber, listener: ClientSubscription, live: bool) -> None:
        """Give a new subscription the latched samples.

        Before the topic's type is known there is nothing to give; of a robot that can't repeat its samples they wait in
        :attr:`_untyped` for all.

        :param live: whether its member has the topic already
        """
        if not self.latched:
            self._since[member] = self._stamp
        elif self._converter.knows or listener.raw:
            self.kept.join(member, listener, live)
        elif self.kept.memory and not live:
            self._unready.add(member)

    def pay(self) -> None:
        """The topic is inhibited no more: late joiners get what the others have had."""
        if not self.owed:
            return
        owed, self.owed = self.owed, {}
        for member, listener in owed.items():
            if self.serves(member):
                self.welcome(member, listener, live=True)


def _keep(samples: deque[Sample], sample: Sample) -> int:
    """The newest count, as far as they are not too large together; how many gave way."""
    gone = int(len(samples) == samples.maxlen)
    samples.append(sample)
    while len(samples) > 1 and sum(each.size for each in samples) > KEPT_BYTES:
        samples.popleft()
        gone += 1
    return gone


Send = Callable[[bytes, int, int], None]
"""Takes a message's JSON, part of a text that was checked, its stamp (the relay's monotonic nanoseconds), and the
number of the connection it comes from, which goes with commands. Raises :class:`Invalid` when the message is not of the
topic's type."""


class QueuedMessage(NamedTuple):
    """A message that waits for the moment until it can be sent; see :meth:`Publications.publish`.

    :param id: of the client's ``publish``, for what is told about it
    :param until: seconds of the relay's clock; nobody wants it sent later
    """

    member: Publisher
    body: bytes
    stamp: int
    id: rosbridge.Id
    until: float


def unheard(nodes: list[str]) -> str:
    """What those are told whose quality of service some publishers do not offer."""
    return f"the quality of service that was asked for keeps these publishers from being heard: {', '.join(nodes)}"


def unserved(nodes: list[str]) -> str:
    """What those are told whose publisher some nodes do not hear."""
    return f"these nodes ask for another quality of service and get nothing: {', '.join(nodes)}"


class ClientPublication:
    """A topic clients publish to, advertised once on the robot."""

    def __init__(self, number: int, topic: str, type_name: str) -> None:
        self.number = number
        self.topic = topic
        self.type = type_name
        self.latch = False
        self.queue_size = 0
        self.qos: QoS | None = None
        self.phase = RequestPhase.WAITING
        self.motion = False
        """Whether the robot counts it as motion: what goes there are commands, with their source."""
        self.send: Send | None = None
        """Sends a message to the robot; ``None`` while none can be sent, and until the first after a change."""
        self.holders: dict[Subscriber, dict[rosbridge.Id, str]] = {}
        """Advertisements of each client by id, with why the robot could not, as far as its client was told."""
        self.held: deque[QueuedMessage] = deque()
        self.unmatched: list[str] = []
        """Subscribers that get nothing because of the quality of service, with the reason."""
        self.seen: Topic | None = None
        """The topic in the robot's graph when the robot was last asked."""

    def enter(self, phase: RequestPhase) -> None:
        """Go on to this phase; how messages are sent is found out anew."""
        self.phase = phase
        self.send = None
