"""Subscriptions and publishers of the ROS 2 platform."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.duration import Duration

try:
    from rclpy.event_handler import SubscriptionEventCallbacks
except ImportError:  # Humble
    from rclpy.qos_event import SubscriptionEventCallbacks

from relay_protocol.link import QoS
from robot_client.platforms import ros2_qos
from robot_client.platforms.base import OnChange, OnSample
from robot_client.platforms.ros2_executor import Hop
from robot_client.platforms.ros2_types import Types
from robot_client.reactors import Clock, Timer

LINGER = 0.5

# What tells of such events ends the process when it goes at the wrong moment; see Nodes.for_actions.
_NO_EVENTS = SubscriptionEventCallbacks(use_default_callbacks=False)


class RosSource:
    """A raw subscription that follows its publishers' quality of service.

    :param ignore: how the names of nodes begin whose publishers don't count
    """

    def __init__(
        self,
        node: Any,
        hop: Hop,
        types: Types,
        topic: str,
        type: str,
        qos: QoS | None,
        on_sample: OnSample,
        on_change: OnChange,
        on_close: Callable[[RosSource], None],
        ignore: str = "",
    ) -> None:
        self.type = type
        self._node = node
        self._hop = hop
        self.topic = topic
        self._class = types.message(type)
        self._asked = qos
        self._on_sample: OnSample | None = on_sample
        self._on_change = on_change
        self._on_close = on_close
        self._ignore = ignore
        self._generation = 0
        self._subscription: Any = None
        self._former: Any = None
        self._passed_on: deque[bytes] = deque(maxlen=ros2_qos.DEPTH)
        self._match = self._look()
        self._build()

    @property
    def latched(self) -> bool:
        """Whether all publishers keep their last messages."""
        return self._match.latched

    @property
    def publishers(self) -> int:
        """How many publish now."""
        return self._match.publishers

    def refresh(self) -> None:
        """Look at the publishers again; subscribe anew if they want another quality of service."""
        old, new = self._match, self._look()
        if new == old:
            return
        if new.publishers == 0:
            # Whoever comes back is likely to be as before.
            new = old._replace(publishers=0)
        self._match = new
        if (new.reliable, new.latched) != (old.reliable, old.latched):
            self._build()
        self._on_change()

    def close(self) -> None:
        """Stop listening."""
        if self._on_sample is None:
            return
        self._on_sample = None
        self._generation += 1
        self._node.destroy_subscription(self._subscription)
        self._retire()
        self._on_close(self)

    def _look(self) -> ros2_qos.Match:
        infos = self._node.get_publishers_info_by_topic(self.topic)
        ignored = self._ignore or None
        return ros2_qos.match(
            [each.qos_profile for each in infos if not (ignored and each.node_name.startswith(ignored))]
        )

    def _build(self) -> None:
        self._generation += 1
        generation = self._generation
        profile = ros2_qos.for_subscription(self._match, self._asked)
        # Called for each sample: without a function of Python's around it.
        arrived = partial(self._hop.put, partial(self._deliver, generation), size=None)
        self._retire()
        self._passed_on.clear()
        self._former = self._subscription
        self._subscription = self._node.create_subscription(
            self._class, self.topic, arrived, profile, event_callbacks=_NO_EVENTS, raw=True
        )

    def _retire(self) -> None:
        former, self._former = self._former, None
        if former is not None:
            self._node.destroy_subscription(former)

    def _deliver(self, generation: int, body: bytes) -> None:
        if self._on_sample is None:
            return
        # Finding the publishers takes a new subscription a while: until it hears something the former one counts.
        if generation == self._generation:
            if self._former is not None:
                self._retire()
            if self._passed_on and self._repeats(body):
                return
        elif self._former is None or generation != self._generation - 1:
            return
        else:
            self._passed_on.append(body)
        self._on_sample(body)

    def _repeats(self, body: bytes) -> bool:
        """Whether the former subscription has passed this sample on already; then also what came before it."""
        if body not in self._passed_on:
            self._passed_on.clear()
            return False
        while self._passed_on.popleft() != body:
            pass
        return True


class RosSink:
    """A publisher of CDR bytes.

    :param on_close: takes the publisher over
    """

    def __init__(self, publisher: Any, on_close: Callable[[RosSink], None]) -> None:
        self.publisher = publisher
        self._on_close: Callable[[RosSink], None] | None = on_close

    def publish(self, body: bytes) -> None:
        """Publish one message."""
        self.publisher.publish(body)

    def close(self) -> None:
        """Take the publisher away."""
        if self._on_close is not None:
            on_close, self._on_close = self._on_close, None
            on_close(self)


class Lingering:
    """Publishers on their way out: a publisher that goes at once takes its last message with it, often a stop."""

    def __init__(self, node: Any, clock: Clock) -> None:
        self._node = node
        self._clock = clock
        self._timers: dict[Any, Timer] = {}

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
