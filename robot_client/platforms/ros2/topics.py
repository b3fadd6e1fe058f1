"""Subscriptions and publishers of the ROS 2 platform."""

from __future__ import annotations

import contextlib
import inspect
import secrets
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from rclpy.duration import Duration
from rclpy.subscription import Subscription
from twisted.logger import Logger

try:
    from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
except ImportError:  # Humble
    from rclpy.qos_event import PublisherEventCallbacks, SubscriptionEventCallbacks

from relay_protocol.limits import MIB
from relay_protocol.link import QoS
from robot_client.platforms.base import OnChange, OnKept, OnSample
from robot_client.platforms.ros2 import qos as ros2_qos
from robot_client.platforms.ros2.executor import ReactorBridge
from robot_client.platforms.ros2.types import Types
from robot_client.twisted_types import DelayedCall, ReactorClock

LINGER = 0.5

RENEW_EVERY = 0.02
RENEW_SECONDS = 1.0
"""How often it is looked whether a new publisher has found its subscribers, and for how long at most."""

KEPT_BYTES = 4 * MIB
"""Most bytes of messages of one publisher that the next one is given to keep; the latest may be larger."""

RECALL_SECONDS = 5.0
"""How long publishers have to send what they keep: a lost packet of discovery is sent again after 3 s (Fast DDS)."""

KNOWN = 2048
"""Messages of a topic that are known again when they come once more."""

KNOWN_TOPICS = 256

TELLS_APART = hasattr(Subscription, "CallbackType")
"""Whether this rclpy gives callbacks what tells one message from another (since Iron)."""

_TWO = inspect.signature(lambda message, info: None)

# What tells of such events ends the process when it goes at the wrong moment; see Nodes.for_actions. So the graph is
# looked at instead to find out who is not matched.
_NO_EVENTS = SubscriptionEventCallbacks(use_default_callbacks=False)

# The executor would hold on to a publisher by its events after its end, and with it to the topic's type.
_NO_EVENTS_OF_OURS = PublisherEventCallbacks(use_default_callbacks=False)


_LATCHED = "transient_local"

Identity = tuple[int, int | None]
"""What tells a message from all others of its topic, also when the middleware delivers it again: when its publisher
sent it, nanoseconds, and how many it had sent by then (``rmw_message_info_t``)."""

Arrived = tuple[bytes, Identity | None]


class Stamps:
    """Which stamp each latched message was first passed on by, for as long as the daemon lives.

    After the loss of a link the relay subscribes again, and the middleware delivers again what publishers keep: the
    relay knows by the stamp which of it its clients have had.
    """

    def __init__(self, wall: Callable[[], int] = time.time_ns) -> None:
        self.memory = secrets.token_hex(8)
        """A name for this memory: after a restart the same message has another stamp."""
        self._wall = wall
        self._latest = 0
        self._topics: OrderedDict[str, OrderedDict[Identity, int]] = OrderedDict()

    def now(self) -> int:
        """The wall clock, nanoseconds since 1970; stamps of latched messages will be greater."""
        now = self._wall()
        self._latest = max(self._latest, now)
        return now

    def of(self, topic: str, identity: Identity) -> int:
        """The stamp of a message: now, when it was not passed on before; later ones are never less."""
        known = self._topics.setdefault(topic, OrderedDict())
        self._topics.move_to_end(topic)
        if len(self._topics) > KNOWN_TOPICS:
            self._topics.popitem(last=False)
        stamp = known.get(identity)
        if stamp is None:
            stamp = self._latest = known[identity] = max(self._wall(), self._latest + 1)
            if len(known) > KNOWN:
                known.popitem(last=False)
        return stamp


class RosSource:
    """A raw subscription that follows its publishers' quality of service.

    Two publishers of one topic may offer different qualities, and a subscription matches only those that offer what it
    asks for. So it asks for what all offer. What the latched ones among them keep comes by a second subscription, which
    lives for :data:`RECALL_SECONDS`.

    :param stamps: of latched messages
    :param ignore: how the names of nodes begin whose publishers don't count
    """

    def __init__(
        self,
        node: Any,
        hop: ReactorBridge,
        types: Types,
        topic: str,
        type: str,
        qos: QoS | None,
        on_sample: OnSample,
        on_change: OnChange,
        on_close: Callable[[RosSource], None],
        clock: ReactorClock,
        stamps: Stamps,
        ignore: str = "",
    ) -> None:
        self.type = type
        self.stamp = 0
        self._node = node
        self._hop = hop
        self.topic = topic
        self._class = types.message(type)
        self._asked = qos
        self._on_sample: OnSample | None = on_sample
        self._on_change = on_change
        self._on_close = on_close
        self._clock = clock
        self._stamps = stamps
        self._ignore = ignore
        self._generation = 0
        self._subscription: Any = None
        self._former: Any = None
        self._recall: _Recall | None = None
        self._known: OrderedDict[Identity, int] = OrderedDict()
        """Stamps of the latest messages that were passed on."""
        self.unmatched: list[str] = []
        self._profile: Any = None
        self._infos: list[Any] = []
        self._match = self._look()
        self._build()
        self._recall_some()
        self.unmatched = ros2_qos.named(self._unmatched())
        self._seen = self.unmatched
        """What was found at the latest look; what is found twice is told."""

    @property
    def latched(self) -> bool:
        """Whether there are publishers that keep their last messages."""
        return self._match.latched and (self._asked is None or self._asked.durability != "volatile")

    @property
    def publishers(self) -> int:
        """How many publish now."""
        return self._match.publishers

    @property
    def replays(self) -> str:
        """The memory of stamps, where this rclpy tells messages apart (Iron and later)."""
        return self._stamps.memory if TELLS_APART else ""

    def refresh(self) -> None:
        """Look at the publishers again; subscribe anew if they want another quality of service."""
        old, new = self._match, self._look()
        before, self._seen = self._seen, self._unmatched()
        settled = self._seen if self._seen == before else self.unmatched
        if new == old and settled == self.unmatched:
            return
        self.unmatched = settled
        if new.publishers == 0:
            # Those that come back are likely to be as before.
            new = old._replace(publishers=0)
        self._match = new
        if (new.reliable, new.all_latched) != (old.reliable, old.all_latched):
            self._build()
        if new.publishers > old.publishers or not old.latched:
            self._recall_some()
        self._on_change()

    def recall(self, on_kept: OnKept, on_end: Callable[[], None]) -> None:
        """Ask the publishers for what they keep: the middleware sends it to each new subscription."""
        self._end_recall()
        recall = _Recall(on_kept, on_end)
        recall.subscription = self._subscribe(partial(self._recalled, recall), ros2_qos.for_recall())
        recall.timer = self._clock.callLater(RECALL_SECONDS, self._end_recall)
        self._recall = recall

    def close(self) -> None:
        """Stop listening."""
        if self._on_sample is None:
            return
        self._on_sample = None
        self._generation += 1
        self._node.destroy_subscription(self._subscription)
        self._retire()
        self._drop_recall()
        self._on_close(self)

    def _look(self) -> ros2_qos.Match:
        infos = self._node.get_publishers_info_by_topic(self.topic)
        ignored = self._ignore or None
        self._infos = [each for each in infos if not (ignored and each.node_name.startswith(ignored))]
        return ros2_qos.match([each.qos_profile for each in self._infos])

    def _unmatched(self) -> list[str]:
        """Publishers that offer less than a client has asked for."""
        return ros2_qos.unmatched(self._infos, [], self._profile) if self._asked is not None else []

    def _build(self) -> None:
        self._generation += 1
        self._profile = ros2_qos.for_subscription(self._match, self._asked)
        self._retire()
        self._former = self._subscription
        self._subscription = self._subscribe(partial(self._deliver, self._generation), self._profile)

    def _subscribe(self, deliver: Callable[[Arrived], None], profile: Any) -> Any:
        return self._node.create_subscription(
            self._class,
            self.topic,
            _with_identity(self._hop.put, deliver),
            profile,
            event_callbacks=_NO_EVENTS,
            raw=True,
        )

    def _retire(self) -> None:
        former, self._former = self._former, None
        if former is not None:
            self._node.destroy_subscription(former)

    def _deliver(self, generation: int, arrived: Arrived) -> None:
        if self._on_sample is None:
            return
        # Finding the publishers takes a new subscription a while: until it hears something the former one counts.
        if generation == self._generation:
            if self._former is not None:
                self._retire()
        elif self._former is None or generation != self._generation - 1:
            return
        body, identity = arrived
        if self._is_new(identity):
            self._on_sample(body)

    def _is_new(self, identity: Identity | None) -> bool:
        """Whether a message has not been passed on; its stamp is in :attr:`stamp` then."""
        if identity is None:
            self.stamp = 0
            return True
        known = self._known.get(identity)
        if known is not None:
            self.stamp = known
            return False
        stamps = self._stamps
        self.stamp = stamps.of(self.topic, identity) if self._match.latched else stamps.now()
        self._known[identity] = self.stamp
        if len(self._known) > KNOWN:
            self._known.popitem(last=False)
        return True

    # --- what publishers keep -----------------------------------------------------------------------------

    def _recall_some(self) -> None:
        """Where not all publishers are latched, the subscription gets nothing that was published before it."""
        if self.latched and not self._match.all_latched and TELLS_APART and self._recall is None:
            self.recall(lambda stamp, body: None, lambda: None)

    def _recalled(self, recall: _Recall, arrived: Arrived) -> None:
        if recall is not self._recall or self._on_sample is None:
            return
        body, identity = arrived
        if self._is_new(identity):
            self._on_sample(body)
        recall.on_kept(self.stamp, body)

    def _end_recall(self) -> None:
        recall = self._recall
        self._drop_recall()
        if recall is not None:
            recall.on_end()

    def _drop_recall(self) -> None:
        recall, self._recall = self._recall, None
        if recall is not None:
            if recall.timer is not None and recall.timer.active():
                recall.timer.cancel()
            self._node.destroy_subscription(recall.subscription)


class _Recall:
    """A subscription that lives for a moment, to get what publishers keep."""

    subscription: Any
    timer: DelayedCall | None = None

    def __init__(self, on_kept: OnKept, on_end: Callable[[], None]) -> None:
        self.on_kept = on_kept
        self.on_end = on_end


def _with_identity(put: Callable[..., None], deliver: Callable[[Arrived], None]) -> Callable[..., None]:
    """A callback of a raw subscription that has each message delivered on the reactor's thread."""

    def arrived(message: Any, info: Any = None) -> None:
        if type(message) is tuple:
            # What the EventsExecutor of rclpy 7.1 calls with: both in one.
            message, info = message
        sent = info["source_timestamp"] if info is not None else 0
        identity = (sent, info.get("publication_sequence_number")) if sent else None
        put(deliver, (message, identity), len(message))

    if TELLS_APART:
        # rclpy gives the second argument to a callback that can't be called with one (PEP 362).
        arrived.__signature__ = _TWO  # type: ignore[attr-defined]
    return arrived


class Offered(NamedTuple):
    """How something is to be published; see :func:`ros2_qos.for_publisher`."""

    latch: bool
    asked: QoS | None
    queue_size: int


class RosSink:
    """A publisher of CDR bytes that follows what the subscribers of its topic ask for.

    :param subscriptions: what the graph tells of the topic's subscriptions, without our own
    :param on_change: called when :attr:`unmatched` has changed
    :param on_close: takes publishers over that are not needed any more
    :raises Invalid: a wish that can't be met
    """

    def __init__(
        self,
        node: Any,
        clock: ReactorClock,
        kind: Any,
        topic: str,
        offered: Offered,
        subscriptions: Callable[[], list[Any]],
        on_change: OnChange,
        on_close: Callable[[RosSink, list[Any]], None],
    ) -> None:
        self.topic = topic
        self._node = node
        self._clock = clock
        self._kind = kind
        self._offered = offered
        self._subscriptions = subscriptions
        self._on_change = on_change
        self._on_close: Callable[[RosSink, list[Any]], None] | None = on_close
        self._log = Logger("ros2")
        self._latched = offered.latch or (offered.asked is not None and offered.asked.durability == _LATCHED)
        self._kept: deque[bytes] = deque()
        """Latched messages, for the next publisher to keep."""
        self._next: Any = None
        self._lacking = 0
        """How many of :attr:`_kept`, from the end, the next publisher does not have."""
        self._until = 0.0
        self._timer: DelayedCall | None = None
        self._profile = self._fit(subscriptions())
        self.publisher = self._make(self._profile)
        self.unmatched = ros2_qos.named(ros2_qos.unmatched([], subscriptions(), self._profile))
        self._seen = self.unmatched
        """What was found at the latest look; what is found twice is told."""

    @property
    def closed(self) -> bool:
        """Whether it has ended."""
        return self._on_close is None

    def publish(self, body: bytes) -> None:
        """Publish one message."""
        self.publisher.publish(body)
        if self._latched:
            self._keep(body)

    def refresh(self) -> None:
        """Look at the subscribers again; publish anew where there is one that the publisher does not serve."""
        if self._on_close is None:
            return
        infos = self._subscriptions()
        if self._next is None and ros2_qos.unmatched([], infos, self._profile):
            profile = self._fit(infos)
            if len(ros2_qos.unmatched([], infos, profile)) < len(
                ros2_qos.unmatched([], infos, self._profile)
            ):
                self._renew(profile)
        before, self._seen = self._seen, ros2_qos.unmatched([], infos, self._profile)
        if self._seen == before != self.unmatched:
            self.unmatched = self._seen
            self._on_change()

    def close(self) -> None:
        """Take the publisher away."""
        if self._on_close is not None:
            on_close, self._on_close = self._on_close, None
            if self._timer is not None and self._timer.active():
                self._timer.cancel()
            on_close(self, [each for each in (self.publisher, self._next) if each is not None])

    def _fit(self, infos: list[Any]) -> Any:
        return ros2_qos.for_publisher([each.qos_profile for each in infos], *self._offered)

    def _make(self, profile: Any) -> Any:
        return self._node.create_publisher(
            self._kind, self.topic, profile, event_callbacks=_NO_EVENTS_OF_OURS
        )

    def _keep(self, body: bytes) -> None:
        self._kept.append(body)
        self._lacking += 1
        size = sum(map(len, self._kept))
        while len(self._kept) > 1 and (len(self._kept) > self._profile.depth or size > KEPT_BYTES):
            size -= len(self._kept.popleft())

    def _renew(self, profile: Any) -> None:
        """Make a stricter publisher. Until it has found the subscribers the former one publishes.

        What is latched goes to the next one too: nodes that ask for it may get it twice then, as of a node that starts
        again.
        """
        try:
            self._next = self._make(profile)
        except Exception:  # the subscribers that the former one serves must not lose it
            self._log.failure("{topic} can't be published otherwise", topic=self.topic)
            return
        self._profile = profile
        self._lacking = len(self._kept)
        self._pass_on()
        self._until = self._clock.seconds() + RENEW_SECONDS
        self._look()

    def _pass_on(self) -> None:
        """Have the next publisher keep what the former one keeps."""
        for body in list(self._kept)[max(0, len(self._kept) - self._lacking) :]:
            self._next.publish(body)
        self._lacking = 0

    def _look(self) -> None:
        self._timer = None
        found = self._next.get_subscription_count()
        if found < self._node.count_subscribers(self.topic) and self._clock.seconds() < self._until:
            self._timer = self._clock.callLater(RENEW_EVERY, self._look)
            return
        self._pass_on()
        former, self.publisher, self._next = self.publisher, self._next, None
        if self._on_close is not None:
            self._on_close(self, [former])


class Lingering:
    """Publishers on their way out: a publisher that goes at once takes its last message with it, often a stop."""

    def __init__(self, node: Any, clock: ReactorClock) -> None:
        self._node = node
        self._clock = clock
        self._timers: dict[Any, DelayedCall] = {}

    def take(self, publisher: Any) -> None:
        """Destroy this one in a while."""
        self._timers[publisher] = self._clock.callLater(LINGER, self._destroy, publisher)

    def give_way(self, topic: str, kind: Any) -> None:
        """Destroy those of this topic that have another type: some middleware allows one type of a topic in a process.

        :param kind: class of the message
        """
        for publisher, timer in list(self._timers.items()):
            if publisher.topic_name == topic and publisher.msg_type is not kind:
                timer.cancel()
                self._destroy(publisher)

    def end(self, seconds: float) -> None:
        """Destroy all, once what they said has arrived, or after ``seconds``."""
        deadline = self._clock.seconds() + seconds
        for publisher, timer in list(self._timers.items()):
            timer.cancel()
            left = max(0.0, deadline - self._clock.seconds())
            with contextlib.suppress(Exception):  # not every middleware can tell
                publisher.wait_for_all_acked(Duration(nanoseconds=int(left * 1e9)))
            self._destroy(publisher)

    def _destroy(self, publisher: Any) -> None:
        del self._timers[publisher]
        self._node.destroy_publisher(publisher)
