"""Subscriptions of a client: to topics of the robot, and to the relay's own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import Refused
from relay_protocol.rights import Decision, Operation
from relay_protocol.ros_types import TypeRegistry
from relay_server.access import may_subscribe
from relay_server.channels import encodings
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.names import normal_type, resolve
from relay_server.channels.samples import Converter, Sample
from relay_server.common.clock import Clock, PeriodicTimer, PeriodicTimers
from relay_server.sessions.context import ClientContext, LocalNode

SUBSCRIPTIONS = 1024
"""Most topics that are subscribed on one connection."""

OWN_TOPICS_SECONDS = 1.0
"""Seconds between messages of the relay's own topics."""

_JSON = Converter(TypeRegistry(), "", "json", lambda reason: None)
"""Converter of the relay's own topics, whose messages are JSON."""


class SubscriptionHandler:
    """The subscriptions of one session."""

    def __init__(self, client: ClientContext, clock: Clock, local: LocalNode, timers: PeriodicTimers) -> None:
        self._client = client
        self._clock = clock
        self._local = local
        self._by_topic: dict[str, ClientSubscription] = {}
        self._timers = timers
        self._own_timer: PeriodicTimer | None = None

    def end(self) -> None:
        """The client is gone."""
        self._stop_own_timer()
        for subscription in self._by_topic.values():
            subscription.close()

    def subscribe(self, operation: rosbridge.Subscribe) -> None:
        """Subscribe to a topic; several subscriptions to one topic are merged."""
        client = self._client
        topic = resolve(operation.topic)
        type_name = normal_type(operation.type)
        decision = self._decide(topic, type_name)
        if not decision.allowed:
            raise Refused(decision.reason)
        encoding = encodings.requested_encoding(operation, client.notify, topic=True)
        subscription = self._by_topic.get(topic)
        if subscription is None:
            if len(self._by_topic) >= SUBSCRIPTIONS:
                raise Refused(f"at most {SUBSCRIPTIONS} topics can be subscribed on one connection")
            subscription = ClientSubscription(self._clock, client, topic)
        if self._local.topic(topic) is not None:
            subscription.add(operation, encoding)
            self._by_topic[topic] = subscription
            if self._local.pushed(topic):
                client.controller.changes.follow(client, self._publish_pushed)
                self._publish_pushed()
            elif self._own_timer is None:
                self._own_timer = PeriodicTimer(self._publish_periodic, OWN_TOPICS_SECONDS)
                self._timers.start(self._own_timer)
            return
        of_robot = client.channel.subscriptions
        of_robot.check(topic, type_name)
        subscription.add(operation, encoding)
        of_robot.add(client, subscription, type_name, operation.qos)
        self._by_topic[topic] = subscription

    def unsubscribe(self, operation: rosbridge.Unsubscribe) -> None:
        """End one subscription, or all to a topic."""
        topic = resolve(operation.topic)
        subscription = self._by_topic.get(topic)
        if subscription is None:
            return
        if operation.id is not None and subscription.remove(operation.topic, operation.id):
            if self._local.topic(topic) is None:
                self._client.channel.subscriptions.add(self._client, subscription, None, None)
            return
        self._end(topic)

    def is_subscribed(self, topic: str) -> bool:
        """Whether a topic is still subscribed."""
        return topic in self._by_topic

    def recheck_rights(self) -> None:
        """End subscriptions that are no longer allowed, as rights or the types of topics have changed."""
        for topic in list(self._by_topic):
            decision = self._decide(topic)
            if not decision.allowed:
                ids = self._by_topic[topic].ids
                self._end(topic)
                for id in ids:
                    self._client.notify("error", f"unsubscribed from {topic}: {decision.reason}", id)

    def _decide(self, topic: str, type_name: str = "") -> Decision:
        client = self._client
        if self._local.topic(topic) is not None:
            return client.permit.decide(Operation.SUBSCRIBE, topic)
        named = type_name or client.channel.subscriptions.type_for(client, topic)
        return may_subscribe(client.permit.decide, client.robot, topic, [named] if named else ())

    def _end(self, topic: str) -> None:
        subscription = self._by_topic.pop(topic)
        subscription.close()
        self._client.port.forget(subscription)
        self._client.channel.subscriptions.remove(self._client, topic)

    def _publish_periodic(self) -> None:
        if not self._publish_own(pushed=False):
            self._stop_own_timer()

    def _publish_pushed(self) -> None:
        if not self._publish_own(pushed=True):
            self._client.controller.changes.forget(self._client)
        elif self._client.controller.snapshot.stopped is not None:
            # The pong proves that what the client sends next is newer than the stop, so it may resume at once.
            self._client.port.ping()

    def _publish_own(self, *, pushed: bool) -> bool:
        """Publish the relay's own topics of one kind; returns whether any is subscribed."""
        makers: list[tuple[str, Callable[[ClientContext], dict[str, Any]] | None]] = [
            (name, self._local.topic(name)) for name in self._by_topic if self._local.pushed(name) is pushed
        ]
        for name, make in makers:
            if make is not None:
                body = jsontext.encode(make(self._client))
                subscription, sample = self._by_topic[name], Sample(body, 0, _JSON)
                # A throttle must not delay a change of control.
                subscription.replay(sample) if pushed else subscription.receive(sample)
        return any(make for _, make in makers)

    def _stop_own_timer(self) -> None:
        if self._own_timer is not None:
            self._own_timer.stop()
            self._own_timer = None
