"""Topics as channels: what a client may subscribe to is advertised with its definition, and samples go out as CDR."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

from relay_protocol import rosbridge
from relay_server.access import keep_newest, may_subscribe
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.samples import Sample
from relay_server.foxglove import messages
from relay_server.foxglove.advertisements import Advertisement, Advertisements
from relay_server.foxglove.context import FoxgloveContext
from relay_server.foxglove.statuses import SUBSCRIPTION_PREFIX
from relay_server.relay_node.interfaces import OWN_TOPICS
from relay_server.relay_node.visible_graph import visible_graph
from relay_server.robots.message_types import CUMULATIVE_TYPES
from relay_server.sessions.subscriptions import SUBSCRIPTIONS

CLOUD = "sensor_msgs/msg/PointCloud2"


class TopicChannels(Advertisements):
    """The channels of one client, and its subscriptions to them."""

    own_names = OWN_TOPICS
    parts = ("",)

    def __init__(self, context: FoxgloveContext) -> None:
        super().__init__(
            context,
            "topic-types",
            encode=lambda entries: messages.text("advertise", channels=entries),
            encode_withdrawal=lambda numbers: messages.text("unadvertise", channelIds=numbers),
        )
        self._subscribed: dict[str, int] = {}
        """The client's number of the subscription, by topic."""
        self._topics: dict[int, str] = {}
        """The topic, by the client's number of the subscription."""
        self._throttled: dict[str, Advertisement] = {}
        """Channels that are subscribed with a throttle, by topic."""
        self._ended: OrderedDict[int, None] = OrderedDict()
        """Subscriptions that ended with their channels; apps unsubscribe them afterwards."""

    # --- channels -----------------------------------------------------------------------------------------

    def update(self) -> None:
        """Advertise what the client may use now, and adapt throttles to the graph."""
        super().update()
        self._lift_throttles()

    def _wanted(self) -> dict[str, list[str]]:
        client = self._context.client
        robot, decide = client.robot, client.permit.rules.decide
        found = {name: topic.types for name, topic in visible_graph(client).topics.items() if topic.types}
        if not robot.graph.known:
            # The robot is offline, or has just registered: its channels stay until its graph is known.
            found = {**{each.name: [each.type] for each in self._by_name.values()}, **found}
        return {
            topic: types
            for topic, types in found.items()
            if may_subscribe(decide, robot, topic, types).allowed
        }

    def _encoding_of(self, name: str) -> str:
        return "json" if name in OWN_TOPICS else super()._encoding_of(name)

    def _entry(self, advertised: Advertisement, *texts: str) -> dict[str, Any]:
        return {
            "id": advertised.number,
            "topic": advertised.name,
            "encoding": advertised.encoding,
            "schemaName": advertised.type,
            "schemaEncoding": advertised.schema_encoding,
            "schema": texts[0],
        }

    def _withdrawn(self, advertised: Advertisement) -> None:
        if advertised.name in self._subscribed:
            keep_newest(self._ended, self._subscribed[advertised.name], None, SUBSCRIPTIONS)
            self._end(advertised.name)

    # --- subscriptions ------------------------------------------------------------------------------------

    def subscribe(self, operation: messages.SubscribeOp) -> None:
        """Subscribe to channels; what can't be is refused one by one, up to as many as one connection may have."""
        for entry in self._context.first_entries(operation.subscriptions, SUBSCRIPTIONS, "subscribe"):
            self._subscribe(entry)

    def _subscribe(self, entry: messages.SubscriptionEntry) -> None:
        channel = self._by_number.get(entry.channel_id)
        if channel is None:
            self._context.deny(f"there is no channel {entry.channel_id}", "subscribe")
            return
        if entry.id in self._topics:
            self._context.deny(f"the subscription id {entry.id} is in use", "subscribe")
            return
        if channel.name in self._subscribed:
            self._context.deny(f"{channel.name} is subscribed already", "subscribe", "warning")
            return
        # First, because latched samples come at once.
        self._topics[entry.id], self._subscribed[channel.name] = channel.name, entry.id
        self._context.statuses.remove(_subscription_id(channel.name))
        if not self._request(channel):
            del self._topics[entry.id], self._subscribed[channel.name]
            self._throttled.pop(channel.name, None)

    def _request(self, channel: Advertisement) -> bool:
        """Subscribe to a channel by the session, or change its throttle; returns whether it was not refused."""
        throttle = self._throttle_of(channel)
        if throttle:
            self._throttled[channel.name] = channel
        return self._context.perform(
            rosbridge.Subscribe(
                topic=channel.name,
                type=channel.type,
                compression="cbor-raw",
                throttle_rate=throttle,
                thin=self._context.options.thin if channel.type == CLOUD else None,
                id=_subscription_id(channel.name),
            )
        )

    def _throttle_of(self, channel: Advertisement) -> float:
        """The throttle of a channel by the publishers that it has now, milliseconds."""
        topic = self._context.client.robot.graph.topics.get(channel.name)
        publishers = 0 if topic is None else len(topic.publishers)
        return self._context.options.throttle_of(channel.name, channel.type, publishers)

    def _lift_throttles(self) -> None:
        """Request every message of topics that have a second publisher now; it stays so until they are unsubscribed."""
        for channel in [each for each in self._throttled.values() if not self._throttle_of(each)]:
            # A refusal, as when the user's quota is used up, is tried again with the next update.
            if self._request(channel):
                del self._throttled[channel.name]

    def is_cumulative(self, topic: str) -> bool:
        """Whether the newest message of a topic does not replace the others."""
        channel = self._by_name.get(topic)
        return channel is not None and channel.type in CUMULATIVE_TYPES

    def unsubscribe(self, operation: messages.UnsubscribeOp) -> None:
        """End subscriptions."""
        for id in self._context.first_entries(operation.subscription_ids, SUBSCRIPTIONS, "unsubscribe"):
            topic = self._topics.get(id)
            if topic is not None:
                self._end(topic)
            elif id in self._ended:
                del self._ended[id]
            else:
                self._context.deny(f"there is no subscription {id}", "subscribe", "warning")

    def _end(self, topic: str) -> None:
        self._throttled.pop(topic, None)
        del self._topics[self._subscribed.pop(topic)]
        id = _subscription_id(topic)
        self._context.perform(rosbridge.Unsubscribe(topic=topic, id=id))
        self._context.statuses.end_later(id)

    def frame(self, subscription: ClientSubscription, sample: Sample) -> bytes | None:
        """The websocket frame of a sample; ``None``: its topic is not subscribed any more."""
        id = self._subscribed.get(subscription.topic)
        if id is None:
            return None
        return messages.sample(id, self._log_time_ns(sample), sample.body)

    def _log_time_ns(self, sample: Sample) -> int:
        client, time_ns = self._context.client, sample.ros_time_ns
        if not client.robot.description.sim_time:
            return time_ns or client.channel.now_ns()
        now_ns = client.channel.now_ns()
        # A sample that waited, or is latched, may be of a time from which the simulated one has jumped back.
        return min(time_ns, now_ns) if time_ns and now_ns else time_ns or now_ns


def _subscription_id(topic: str) -> str:
    """The id of the session's subscription, and of its statuses."""
    return SUBSCRIPTION_PREFIX + topic
