"""Subscriptions and publishers of the ROS 2 platform."""

from __future__ import annotations

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
from robot_client.platforms.base import OnChange, OnDropped, OnLatched, OnSample
from robot_client.platforms.ros2 import qos as ros2_qos
from robot_client.platforms.ros2.executor import ReactorBridge
from robot_client.platforms.ros2.types import Types
from robot_client.twisted_types import DelayedCall, ReactorClock

LINGER = 0.5
"""Seconds between the end of a publisher and its destruction, and between later looks whether it can be destroyed."""

LONGEST_LINGER = 5.0
"""Seconds for which a publisher waits for subscribers that have not confirmed its messages, because they have not
discovered it yet, or are gone."""

REPLACE_POLL = 0.02
REPLACE_SECONDS = 1.0
"""Seconds between checks whether a replacing publisher has matched the subscribers, and the longest time
for that."""

MAX_LATCHED_BYTES = 4 * MIB
"""Most bytes of latched messages that are copied to a replacing publisher; the latest may be larger."""

REQUEST_SECONDS = 5.0
"""Seconds in which publishers must send latched samples: Fast DDS resends a lost discovery packet after 3
s."""

MAX_KNOWN = 2048
"""Messages of a topic that are recognised when they arrive again."""

MAX_KNOWN_TOPICS = 256

IDENTIFIES_MESSAGES = hasattr(Subscription, "CallbackType")
"""Whether this rclpy gives callbacks the message info that identifies a message (since Iron)."""

_TWO_ARGUMENTS = inspect.signature(lambda message, info: None)

# Event handlers are waitables, which can crash the process when they are destroyed; see Nodes.for_actions. So unmatched
# endpoints are found in the graph instead.
_NO_SUBSCRIPTION_EVENTS = SubscriptionEventCallbacks(use_default_callbacks=False)

# Through event handlers the executor would keep a publisher alive after its end, and with it the topic's type.
_NO_PUBLISHER_EVENTS = PublisherEventCallbacks(use_default_callbacks=False)


_TRANSIENT_LOCAL = "transient_local"

Identity = tuple[int, int | None]
"""Identifies a message within its topic, also if the middleware delivers it again: source timestamp,
nanoseconds, and sequence number of the publisher (``rmw_message_info_t``)."""

Arrived = tuple[bytes, Identity | None]


class LatchedStamps:
    """Stamps with which latched messages were first passed on, while the daemon lives.

    After the loss of a link the relay subscribes again, and the middleware delivers latched messages again.
    By their stamps the relay knows which of them its clients have received.
    """

    def __init__(self, wall: Callable[[], int] = time.time_ns) -> None:
        self.id = secrets.token_hex(8)
        """Id of this record: after a restart the same message has another stamp."""
        self._wall = wall
        self._latest = 0
        self._topics: OrderedDict[str, OrderedDict[Identity, int]] = OrderedDict()

    def now(self) -> int:
        """The wall clock, nanoseconds since 1970. Later stamps of latched messages are greater."""
        now = self._wall()
        self._latest = max(self._latest, now)
        return now

    def stamp_of(self, topic: str, identity: Identity) -> int:
        """The stamp of a message; a new one for messages that were not passed on before. Stamps increase."""
        known = self._topics.setdefault(topic, OrderedDict())
        self._topics.move_to_end(topic)
        if len(self._topics) > MAX_KNOWN_TOPICS:
            self._topics.popitem(last=False)
        stamp = known.get(identity)
        if stamp is None:
            stamp = self._latest = known[identity] = max(self._wall(), self._latest + 1)
            if len(known) > MAX_KNOWN:
                known.popitem(last=False)
        return stamp


class RosSubscription:
    """A raw subscription that adapts to its publishers' quality of service.

    Publishers of one topic may offer different qualities of service, and a subscription matches only publishers whose
    offer is at least as strict as its request. So it requests the weakest of all offers. Latched samples of stricter
    publishers arrive through a second subscription, which lives for :data:`REQUEST_SECONDS`.

    :param ignore: prefix of the names of nodes whose publishers are ignored
    """

    def __init__(
        self,
        node: Any,
        bridge: ReactorBridge,
        types: Types,
        topic: str,
        type: str,
        qos: QoS | None,
        on_sample: OnSample,
        on_change: OnChange,
        on_close: Callable[[RosSubscription], None],
        clock: ReactorClock,
        stamps: LatchedStamps,
        ignore: str = "",
    ) -> None:
        self.type = type
        self.stamp = 0
        self._node = node
        self._bridge = bridge
        self.topic = topic
        self._class = types.message(type)
        self._requested_qos = qos
        self._on_sample: OnSample | None = on_sample
        self._on_change = on_change
        self._on_close = on_close
        self._clock = clock
        self._stamps = stamps
        self._ignore = ignore
        self._generation = 0
        self._subscription: Any = None
        self._former: Any = None
        """The replaced subscription, used until the new one has received a message."""
        self._request: _LatchedRequest | None = None
        self._known: OrderedDict[Identity, int] = OrderedDict()
        """Stamps of the latest messages that were passed on, by identity."""
        self.on_dropped: OnDropped = lambda count: None
        self.unmatched: list[str] = []
        self._profile: Any = None
        self._infos: list[Any] = []
        self._match = self._read_publishers()
        self._resubscribe()
        self._request_if_needed()
        self.unmatched = ros2_qos.with_known_names(self._unmatched())
        self._last_unmatched = self.unmatched
        """Result of the latest check; a change is reported if two checks agree."""

    @property
    def latched(self) -> bool:
        """Whether a publisher keeps its last messages for late joiners."""
        return self._match.latched and (
            self._requested_qos is None or self._requested_qos.durability != "volatile"
        )

    @property
    def publishers(self) -> int:
        """Number of publishers now."""
        return self._match.publishers

    @property
    def stamps_id(self) -> str:
        """Id of the record of stamps, if this rclpy identifies messages (Iron and later)."""
        return self._stamps.id if IDENTIFIES_MESSAGES else ""

    def refresh(self) -> None:
        """Read the publishers again, and subscribe again if they need another quality of service."""
        old, new = self._match, self._read_publishers()
        before, self._last_unmatched = self._last_unmatched, self._unmatched()
        confirmed = self._last_unmatched if self._last_unmatched == before else self.unmatched
        if new == old and confirmed == self.unmatched:
            return
        self.unmatched = confirmed
        if new.publishers == 0:
            # Publishers that return are likely to be the same.
            new = old._replace(publishers=0)
        self._match = new
        if (new.reliable, new.all_latched) != (old.reliable, old.all_latched):
            self._resubscribe()
        if new.publishers > old.publishers or not old.latched:
            self._request_if_needed()
        self._on_change()

    def request_latched(self, on_latched: OnLatched, on_end: Callable[[], None]) -> None:
        """See :meth:`robot_client.platforms.base.SubscriptionHandle.request_latched`. The middleware sends
        latched samples to each new subscription.
        """
        self._end_request()
        request = _LatchedRequest(on_latched, on_end)
        request.subscription = self._subscribe(
            partial(self._latched_arrived, request), ros2_qos.for_latched()
        )
        request.timer = self._clock.callLater(REQUEST_SECONDS, self._end_request)
        self._request = request

    def close(self) -> None:
        """See :meth:`robot_client.platforms.base.SubscriptionHandle.close`."""
        if self._on_sample is None:
            return
        self._on_sample = None
        self._generation += 1
        self._node.destroy_subscription(self._subscription)
        self._destroy_former()
        self._cancel_request()
        self._on_close(self)

    def _read_publishers(self) -> ros2_qos.Match:
        infos = self._node.get_publishers_info_by_topic(self.topic)
        ignored = self._ignore or None
        self._infos = [each for each in infos if not (ignored and each.node_name.startswith(ignored))]
        return ros2_qos.match([each.qos_profile for each in self._infos])

    def _unmatched(self) -> list[str]:
        """Publishers that offer less than a client requested."""
        return ros2_qos.unmatched(self._infos, [], self._profile) if self._requested_qos is not None else []

    def _resubscribe(self) -> None:
        self._generation += 1
        self._profile = ros2_qos.for_subscription(self._match, self._requested_qos)
        self._destroy_former()
        self._former = self._subscription
        self._subscription = self._subscribe(partial(self._deliver, self._generation), self._profile)

    def _subscribe(self, deliver: Callable[[Arrived], None], profile: Any) -> Any:
        return self._node.create_subscription(
            self._class,
            self.topic,
            _raw_callback(self._bridge.put, deliver, self._dropped),
            profile,
            event_callbacks=_NO_SUBSCRIPTION_EVENTS,
            raw=True,
        )

    def _destroy_former(self) -> None:
        former, self._former = self._former, None
        if former is not None:
            self._node.destroy_subscription(former)

    def _dropped(self, count: int) -> None:
        if self._on_sample is not None:
            self.on_dropped(count)

    def _deliver(self, generation: int, arrived: Arrived) -> None:
        if self._on_sample is None:
            return
        # A new subscription must discover the publishers first; until it receives a message the former one is used.
        if generation == self._generation:
            if self._former is not None:
                self._destroy_former()
        elif self._former is None or generation != self._generation - 1:
            return
        body, identity = arrived
        if self._is_new(identity):
            self._on_sample(body)

    def _is_new(self, identity: Identity | None) -> bool:
        """Whether a message was not passed on before; sets :attr:`stamp` to its stamp."""
        if identity is None:
            self.stamp = 0
            return True
        known = self._known.get(identity)
        if known is not None:
            self.stamp = known
            return False
        stamps = self._stamps
        self.stamp = stamps.stamp_of(self.topic, identity) if self._match.latched else stamps.now()
        self._known[identity] = self.stamp
        if len(self._known) > MAX_KNOWN:
            self._known.popitem(last=False)
        return True

    # --- latched samples -----------------------------------------------------------------------------------

    def _request_if_needed(self) -> None:
        """If not all publishers are latched, the subscription is volatile and gets no latched samples by
        itself."""
        if self.latched and not self._match.all_latched and IDENTIFIES_MESSAGES and self._request is None:
            self.request_latched(lambda stamp, body: None, lambda: None)

    def _latched_arrived(self, request: _LatchedRequest, arrived: Arrived) -> None:
        if request is not self._request or self._on_sample is None:
            return
        body, identity = arrived
        if self._is_new(identity):
            self._on_sample(body)
        request.on_latched(self.stamp, body)

    def _end_request(self) -> None:
        request = self._request
        self._cancel_request()
        if request is not None:
            request.on_end()

    def _cancel_request(self) -> None:
        request, self._request = self._request, None
        if request is not None:
            if request.timer is not None and request.timer.active():
                request.timer.cancel()
            self._node.destroy_subscription(request.subscription)


class _LatchedRequest:
    """A short-lived subscription for latched samples."""

    subscription: Any
    timer: DelayedCall | None = None

    def __init__(self, on_latched: OnLatched, on_end: Callable[[], None]) -> None:
        self.on_latched = on_latched
        self.on_end = on_end


def _raw_callback(
    put: Callable[..., None], deliver: Callable[[Arrived], None], dropped: OnDropped
) -> Callable[..., None]:
    """A callback of a raw subscription that delivers each message on the reactor's thread."""

    def arrived(message: Any, info: Any = None) -> None:
        if type(message) is tuple:
            # The EventsExecutor of rclpy 7.1 passes both in one argument.
            message, info = message
        sent = info["source_timestamp"] if info is not None else 0
        identity = (sent, info.get("publication_sequence_number")) if sent else None
        put(deliver, (message, identity), len(message), dropped)

    if IDENTIFIES_MESSAGES:
        # rclpy passes the info only if the signature has two required parameters (PEP 362).
        arrived.__signature__ = _TWO_ARGUMENTS  # type: ignore[attr-defined]
    return arrived


class PublisherOptions(NamedTuple):
    """Requested properties of a publisher; see :func:`ros2_qos.for_publisher`."""

    latch: bool
    qos: QoS | None
    queue_size: int


class RosPublisher:
    """A publisher of CDR bytes that adapts to the requests of its topic's subscribers.

    :param subscriptions: returns the topic's subscriptions in the graph, without our own
    :param on_change: called when :attr:`unmatched` changed
    :param on_unused: takes over publishers that are no longer needed
    :raises Invalid: a requested policy is not possible
    """

    def __init__(
        self,
        node: Any,
        clock: ReactorClock,
        message_class: Any,
        topic: str,
        options: PublisherOptions,
        subscriptions: Callable[[], list[Any]],
        on_change: OnChange,
        on_unused: Callable[[RosPublisher, list[Any]], None],
    ) -> None:
        self.topic = topic
        self._node = node
        self._clock = clock
        self._class = message_class
        self._options = options
        self._subscriptions = subscriptions
        self._on_change = on_change
        self._on_unused: Callable[[RosPublisher, list[Any]], None] | None = on_unused
        self._log = Logger("ros2")
        self._latched = options.latch or (
            options.qos is not None and options.qos.durability == _TRANSIENT_LOCAL
        )
        self._latched_bodies: deque[bytes] = deque()
        """Latched messages, for a replacing publisher."""
        self._replacement: Any = None
        self._missing = 0
        """Number of :attr:`_latched_bodies`, from the end, that the replacement does not have."""
        self._replace_deadline = 0.0
        self._timer: DelayedCall | None = None
        self._profile = self._matching_profile(subscriptions())
        self.publisher = self._create(self._profile)
        self.unmatched = ros2_qos.with_known_names(ros2_qos.unmatched([], subscriptions(), self._profile))
        self._last_unmatched = self.unmatched
        """Result of the latest check; a change is reported if two checks agree."""

    @property
    def closed(self) -> bool:
        """Whether it was closed."""
        return self._on_unused is None

    def publish(self, body: bytes) -> None:
        """Publish one message."""
        self.publisher.publish(body)
        if self._latched:
            self._store_latched(body)

    def refresh(self) -> None:
        """Read the subscribers again; replace the publisher if that matches more of them."""
        if self._on_unused is None:
            return
        infos = self._subscriptions()
        if self._replacement is None and ros2_qos.unmatched([], infos, self._profile):
            profile = self._matching_profile(infos)
            if len(ros2_qos.unmatched([], infos, profile)) < len(
                ros2_qos.unmatched([], infos, self._profile)
            ):
                self._replace(profile)
        before, self._last_unmatched = self._last_unmatched, ros2_qos.unmatched([], infos, self._profile)
        if self._last_unmatched == before != self.unmatched:
            self.unmatched = self._last_unmatched
            self._on_change()

    def close(self) -> None:
        """See :meth:`robot_client.platforms.base.PublisherHandle.close`."""
        if self._on_unused is not None:
            on_unused, self._on_unused = self._on_unused, None
            if self._timer is not None and self._timer.active():
                self._timer.cancel()
            on_unused(self, [each for each in (self.publisher, self._replacement) if each is not None])

    def _matching_profile(self, infos: list[Any]) -> Any:
        return ros2_qos.for_publisher([each.qos_profile for each in infos], *self._options)

    def _create(self, profile: Any) -> Any:
        return self._node.create_publisher(
            self._class, self.topic, profile, event_callbacks=_NO_PUBLISHER_EVENTS
        )

    def _store_latched(self, body: bytes) -> None:
        self._latched_bodies.append(body)
        self._missing += 1
        size = sum(map(len, self._latched_bodies))
        bodies = self._latched_bodies
        while len(bodies) > 1 and (len(bodies) > self._profile.depth or size > MAX_LATCHED_BYTES):
            size -= len(bodies.popleft())

    def _replace(self, profile: Any) -> None:
        """Create a stricter publisher. The former one publishes until the new one has matched the
        subscribers.

        Latched messages are published by the new one too. Late joiners may receive them twice, as from a
        node that restarts.
        """
        try:
            self._replacement = self._create(profile)
        except Exception:  # subscribers of the former one must not lose it
            self._log.failure("{topic} can't be published with another quality of service", topic=self.topic)
            return
        self._profile = profile
        self._missing = len(self._latched_bodies)
        self._publish_latched()
        self._replace_deadline = self._clock.seconds() + REPLACE_SECONDS
        self._check_replacement()

    def _publish_latched(self) -> None:
        """Publish latched messages that the replacement does not have."""
        for body in list(self._latched_bodies)[max(0, len(self._latched_bodies) - self._missing) :]:
            self._replacement.publish(body)
        self._missing = 0

    def _check_replacement(self) -> None:
        self._timer = None
        found = self._replacement.get_subscription_count()
        if (
            found < self._node.count_subscribers(self.topic)
            and self._clock.seconds() < self._replace_deadline
        ):
            self._timer = self._clock.callLater(REPLACE_POLL, self._check_replacement)
            return
        self._publish_latched()
        former, self.publisher, self._replacement = self.publisher, self._replacement, None
        if self._on_unused is not None:
            self._on_unused(self, [former])


class LingeringPublishers:
    """Publishers that are destroyed later: destroying one at once can lose its last message, which is often zero
    velocity."""

    def __init__(self, node: Any, clock: ReactorClock) -> None:
        self._node = node
        self._clock = clock
        self._timers: dict[Any, DelayedCall] = {}

    def add(self, publisher: Any) -> None:
        """Destroy this publisher after :data:`LINGER`, and once its messages are acknowledged."""
        end = self._clock.seconds() + LONGEST_LINGER
        self._timers[publisher] = self._clock.callLater(LINGER, self._destroy_acknowledged, publisher, end)

    def _destroy_acknowledged(self, publisher: Any, end: float) -> None:
        if self._clock.seconds() >= end or _is_acknowledged(publisher, 0.0):
            self._destroy(publisher)
        else:
            self._timers[publisher] = self._clock.callLater(
                LINGER, self._destroy_acknowledged, publisher, end
            )

    def destroy_other_types(self, topic: str, message_class: Any) -> None:
        """Destroy publishers of this topic with another type: some middleware allows one type per topic and
        process.

        :param message_class: class of the messages
        """
        for publisher, timer in list(self._timers.items()):
            if publisher.topic_name == topic and publisher.msg_type is not message_class:
                timer.cancel()
                self._destroy(publisher)

    def destroy_all(self, timeout: float) -> None:
        """Destroy all publishers, once their messages are acknowledged, or after ``timeout`` seconds."""
        deadline = self._clock.seconds() + timeout
        for publisher, timer in list(self._timers.items()):
            timer.cancel()
            left = max(0.0, deadline - self._clock.seconds())
            _is_acknowledged(publisher, left)
            self._destroy(publisher)

    def _destroy(self, publisher: Any) -> None:
        del self._timers[publisher]
        self._node.destroy_publisher(publisher)


def _is_acknowledged(publisher: Any, timeout: float) -> bool:
    """Whether all subscribers have confirmed all messages within some seconds, as far as the middleware knows."""
    try:
        return bool(publisher.wait_for_all_acked(Duration(nanoseconds=int(timeout * 1e9))))
    except Exception:
        return True  # not supported by every middleware
