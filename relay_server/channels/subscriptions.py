"""Topics that the relay subscribes to on a robot: each once, for all its clients."""

from __future__ import annotations

from typing import NamedTuple

from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import Invalid, Refused
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.definitions import Definitions
from relay_server.channels.latched import MAX_SAMPLES
from relay_server.channels.link_state import USER_TOPICS, RobotLinkState
from relay_server.channels.members import ChannelMember
from relay_server.channels.robot_requests import RequestPhase, RobotRequest
from relay_server.channels.robot_subscription import RobotSubscription, unmatched_publishers_text
from relay_server.common.clock import Timer, cancel
from relay_server.common.send_queue import NOT_LASTING, Lasting

RETRY_SECONDS = 0.25
LONGEST_RETRY_SECONDS = 30.0
"""First and longest pause before a robot is asked again for a topic that it has but refused; each pause doubles."""

INHIBITED_CHECK_SECONDS = 0.2
"""Seconds between checks whether a topic that late joiners wait for is still inhibited."""

SILENT_REFUSALS = 2
"""Number of refusals that clients are not notified of, when a topic has just changed its type."""


class TopicRate(NamedTuple):
    """The count of samples of one topic.

    :param number: of the subscription; with a new number, counting starts at 0 again
    :param received: samples received
    :param regular: whether samples are to be expected: the robot has subscribed, without a throttle, and the topic is
        not latched
    """

    topic: str
    type: str
    number: int
    received: int
    regular: bool


class Subscriptions:
    """Keeps the robot's subscriptions equal to those of the clients."""

    log = Logger()

    def __init__(self, link_state: RobotLinkState, definitions: Definitions) -> None:
        self._link_state = link_state
        self._definitions = definitions
        self._topics: dict[str, RobotSubscription] = {}
        self.by_number: dict[int, RobotSubscription] = {}
        self._flush_timer: Timer | None = None

    def add(
        self,
        member: ChannelMember,
        client_subscription: ClientSubscription,
        type_name: str | None,
        qos: link.QoS | None,
    ) -> None:
        """Subscribe a client to a topic, or replace its subscription.

        :param type_name: empty: the client leaves it to the graph; ``None``: as before
        :raises Invalid: the topic has another type; its type is unknown; too many topics
        :raises Refused: the user has too many topics of this robot subscribed
        """
        topic = client_subscription.topic
        has = self.check(topic, type_name or "")
        subscription = self._topics.get(topic)
        if subscription is None or member not in subscription.clients:
            self._check_room(member)
        if subscription is None:
            subscription = RobotSubscription(
                self._link_state.clock,
                number=self._link_state.new_number(),
                topic=topic,
                type_name=has or type_name or "",
                qos=qos,
                types=lambda: self._link_state.robot.types,
                on_conversion_error=self._log_conversion_error,
                request_latched=self._send,
            )
            subscription.type_confirmed = bool(has)
            self._topics[topic] = self.by_number[subscription.number] = subscription
        served_before = subscription.serves(member)
        subscription.join(member, client_subscription, type_name)
        if not subscription.type and type_name:
            subscription.retype(type_name)
        if not subscription.serves(member):
            member.notify(
                "warning",
                f"subscribe {topic}: it does not exist yet, and another client says that its type is "
                f"{subscription.type}; messages come if it turns out to be {type_name}",
                client_subscription.latest,
            )
        if subscription.phase in (RequestPhase.WAITING, RequestPhase.FAILED):
            self._subscribe_on_robot(subscription)
            return
        self._follow_throttle(subscription)
        self._notify_type_error(subscription, member)
        if subscription.unmatched and type_name is not None:
            client_subscription.warn(unmatched_publishers_text(subscription.unmatched))
        # Each subscription receives the latched samples, also a second one of a connection, as in rosbridge_suite.
        if type_name is not None and subscription.serves(member):
            if self._inhibited(topic):
                subscription.pending_latched[member] = client_subscription
                self._flush_latched_later()
            elif subscription.phase is RequestPhase.ACTIVE:
                subscription.replay_latched(member, client_subscription, live=served_before)

    def active(self) -> tuple[tuple[str, str], ...]:
        """Topics that the robot is subscribed to for the relay, with their types."""
        return tuple(
            (subscription.topic, subscription.type)
            for subscription in self._topics.values()
            if subscription.phase is RequestPhase.ACTIVE
        )

    def topic_rates(self) -> list[TopicRate]:
        """The count of samples of each topic with a subscription."""
        return [
            TopicRate(
                each.topic,
                each.type,
                each.number,
                each.received,
                each.phase is RequestPhase.ACTIVE and each.throttle_ms == 0 and not each.latched,
            )
            for each in self._topics.values()
        ]

    def unmatched(self, member: ChannelMember) -> list[tuple[str, list[str]]]:
        """A client's topics with publishers of an incompatible quality of service, and these publishers."""
        return [
            (each.topic, each.unmatched)
            for each in self._topics.values()
            if each.unmatched and member in each.clients
        ]

    def less_thinned(self, member: ChannelMember) -> list[str]:
        """A client's topics whose point clouds have more points than it wants, since other clients need them."""
        return [
            each.topic
            for each in self._topics.values()
            if each.serves(member)
            and (wanted := each.clients[member].thin) is not None
            and wanted.thins
            and each.least_thinning() != wanted
        ]

    def latched(self, topic: str) -> bool:
        """Whether publishers of a topic keep their last messages for late joiners."""
        subscription = self._topics.get(topic)
        return subscription is not None and subscription.latched

    def lasting(self, topic: str) -> Lasting:
        """The samples of a latched topic that newer ones do not replace, as its publishers keep several.

        Which publisher sent a message is not known (:mod:`relay_server.channels.latched`). These are one for each of
        several publishers, and as many as came when the robot had just subscribed.
        """
        subscription = self._topics.get(topic)
        if subscription is None or not subscription.latched:
            return NOT_LASTING
        several = max(subscription.publishers, subscription.latched_samples.kept)
        return Lasting(min(several, MAX_SAMPLES), subscription.publishers > 1) if several > 1 else NOT_LASTING

    def type_for(self, member: ChannelMember, topic: str) -> str:
        """The type that clients name for a topic that the robot does not have; empty: none."""
        subscription = self._topics.get(topic)
        return "" if subscription is None else subscription.named_types.get(member, subscription.type)

    def check(self, topic: str, type_name: str) -> str:
        """The type a topic has by the robot's graph, or empty; errors as of :meth:`add`.

        For a topic that the robot does not have yet, the types that other clients name do not count.
        """
        subscription = self._topics.get(topic)
        types = self._types_of(topic)
        if subscription is not None and subscription.type_confirmed:
            if type_name in types and type_name != subscription.type:
                raise Invalid(f"topic {topic} has several types; it is subscribed as {subscription.type} now")
            types = [subscription.type]
        if types and type_name and type_name not in types:
            raise Invalid(f"topic {topic} has the type {' or '.join(types)}, not {type_name}")
        if subscription is None and not types and not type_name and self._link_state.link is not None:
            raise Invalid(f"topic {topic} does not exist; give its type to wait for it")
        return type_name if type_name in types else next(iter(types), "")

    def _types_of(self, topic: str) -> list[str]:
        found = self._link_state.robot.graph.topics.get(topic)
        return found.types if found is not None else []

    def _check_room(self, member: ChannelMember) -> None:
        mine = sum(
            any(each.user == member.user for each in subscription.clients)
            for subscription in self._topics.values()
        )
        if mine >= USER_TOPICS:
            raise Refused(
                f"you have {USER_TOPICS} topics of this robot subscribed, the most one user may have"
            )

    def remove(self, member: ChannelMember, topic: str) -> None:
        """End a client's subscription; after the last one the robot stops sending the topic."""
        subscription = self._topics.get(topic)
        if subscription is None or not subscription.leave(member):
            return
        if not subscription.clients:
            self._unsubscribe(subscription)
            del self._topics[topic]
            del self.by_number[subscription.number]
            self._link_state.names_in_use -= 1
        elif subscription.served:
            self._follow_throttle(subscription)
        elif subscription.type_confirmed:
            self._unsubscribe(subscription)
        else:
            # No client that named this type is left; another client names a different one.
            self._retype(subscription, next(iter(subscription.named_types.values())))
            self._subscribe_on_robot(subscription)

    def forget(self, member: ChannelMember) -> None:
        """End all subscriptions of a client."""
        for topic in [
            topic for topic, subscription in self._topics.items() if member in subscription.clients
        ]:
            self.remove(member, topic)

    def opened(self) -> None:
        """Request all topics from a robot that has come online."""
        for subscription in list(self._topics.values()):
            self._update_type(subscription)
            self._subscribe_on_robot(subscription)

    def lost(self) -> None:
        """Handle that the robot is offline."""
        for subscription in self._topics.values():
            subscription.type_confirmed = False
            subscription.lost()

    def graph_changed(self) -> None:
        """Request topics that have appeared in the graph, and follow those whose type has changed."""
        topics = self._link_state.robot.graph.topics
        for subscription in list(self._topics.values()):
            self._update_type(subscription)
            if (
                subscription.phase in (RequestPhase.WAITING, RequestPhase.FAILED)
                and subscription.topic in topics
            ):
                self._subscribe_on_robot(subscription)

    def type_known(self, type_name: str) -> None:
        """Convert the samples that waited for a definition."""
        for subscription in list(self._topics.values()):
            if subscription.type == type_name:
                subscription.type_known()

    def subscribed(self, message: link.Subscribed) -> None:
        """Handle that the robot has subscribed."""
        self._link_state.robot_requests.answered(("subscribe", message.number))
        subscription = self.by_number.get(message.number)
        if subscription is not None:
            subscription.activate(
                message.type, message.encoding, message.latched, message.publishers, message.replays
            )
            if message.unmatched != subscription.unmatched:
                subscription.unmatched = message.unmatched
                for client_subscription in list(subscription.clients.values()) if message.unmatched else ():
                    client_subscription.warn(unmatched_publishers_text(message.unmatched))
            if message.encoding == "cdr":
                self._definitions.request(message.type)

    def refused(self, number: int, reason: str) -> None:
        """Handle that the robot could not subscribe."""
        self._link_state.robot_requests.answered(("subscribe", number))
        subscription = self.by_number.get(number)
        if subscription is None:
            return
        subscription.phase = RequestPhase.FAILED
        if subscription.refusals >= subscription.silent_refusals:
            for client_subscription in list(subscription.clients.values()):
                client_subscription.fail(reason)
        if subscription.type_confirmed:
            self._try_again(subscription)

    def _try_again(self, subscription: RobotSubscription) -> None:
        """Ask again later for a topic that the robot has: some middleware must remove its former type first."""
        pause = min(RETRY_SECONDS * 2.0 ** min(subscription.refusals, 10), LONGEST_RETRY_SECONDS)
        subscription.refusals += 1
        cancel(subscription.retry)
        subscription.retry = self._link_state.clock.callLater(pause, self._subscribe_on_robot, subscription)

    def type_failed(self, type_name: str, reason: str) -> None:
        """Notify clients that a type is not available. Only clients that receive raw samples can use its topics."""
        for subscription in self._topics.values():
            if subscription.type == type_name:
                subscription.type_error = reason
                for member in list(subscription.clients):
                    self._notify_type_error(subscription, member)

    @staticmethod
    def _notify_type_error(subscription: RobotSubscription, member: ChannelMember) -> None:
        client_subscription = subscription.clients.get(member)
        if (
            subscription.type_error
            and client_subscription is not None
            and subscription.serves(member)
            and not client_subscription.raw
        ):
            client_subscription.fail(subscription.type_error)

    def samples_dropped(self, loss: link.SamplesDropped) -> None:
        """Count samples that the robot has not sent."""
        subscription = self.by_number.get(loss.number)
        if subscription is not None:
            subscription.samples_dropped(loss)

    def losses(self, member: ChannelMember) -> list[tuple[str, str, int]]:
        """Samples of a client's topics that no client received: topic, reason and count."""
        return [
            (each.topic, reason, count)
            for each in self._topics.values()
            if member in each.clients
            for reason, count in each.losses.items()
            if count
        ]

    def losses_of_topics(self, member: ChannelMember, reason: str) -> dict[str, int]:
        """Samples of each of a client's topics that the robot did not send for one reason."""
        return {each.topic: each.losses[reason] for each in self._topics.values() if member in each.clients}

    # --- late joiners of inhibited topics -----------------------------------------------------------------

    def _inhibited(self, topic: str) -> bool:
        """Whether a topic is inhibited without holding its last value (SPEC 1.7)."""
        return any(
            each.resource == topic and not each.hold for each in self._link_state.robot.motion_state.inhibited
        )

    def _flush_latched_later(self) -> None:
        if self._flush_timer is None:
            self._flush_timer = self._link_state.clock.callLater(INHIBITED_CHECK_SECONDS, self._flush_latched)

    def _flush_latched(self) -> None:
        self._flush_timer = None
        for subscription in list(self._topics.values()):
            if subscription.pending_latched and not self._inhibited(subscription.topic):
                subscription.flush_latched()
        if any(subscription.pending_latched for subscription in self._topics.values()):
            self._flush_latched_later()

    def _log_conversion_error(self, subscription: RobotSubscription, reason: str) -> None:
        self.log.warn(
            "a sample of {topic} from {robot} can't be converted: {failure}",
            topic=subscription.topic,
            robot=self._link_state.robot.full,
            failure=reason,
        )

    # --- the type of a topic ------------------------------------------------------------------------------

    def _update_type(self, subscription: RobotSubscription) -> None:
        """Take the topic's type from the robot's graph."""
        types = self._types_of(subscription.topic)
        if not types:
            subscription.type_confirmed = False
            return
        if subscription.type not in types:
            declared = (wanted for wanted in subscription.named_types.values() if wanted in types)
            self._retype(subscription, next(declared, types[0]))
        self._confirm_type(subscription, subscription.type)

    def _confirm_type(self, subscription: RobotSubscription, type_name: str) -> None:
        """Notify clients that name another type than the robot's."""
        if subscription.type_confirmed:
            return
        subscription.type_confirmed = True
        for member, wanted in subscription.naming_other_types():
            client_subscription = subscription.clients[member]
            client_subscription.clear_failures()
            client_subscription.fail(
                f"it has the type {type_name}, not {wanted}; subscribe with {type_name} to get it"
            )
        if not subscription.served:
            self._unsubscribe(subscription)

    def _retype(self, subscription: RobotSubscription, type_name: str) -> None:
        """Subscribe again with another type, under a new number, as samples of the old one may still arrive."""
        had_it = subscription.phase in (RequestPhase.REQUESTED, RequestPhase.ACTIVE)
        self._unsubscribe(subscription)
        subscription.silent_refusals = SILENT_REFUSALS if had_it else 0
        del self.by_number[subscription.number]
        self._link_state.names_in_use -= 1
        subscription.number = self._link_state.new_number()
        self.by_number[subscription.number] = subscription
        subscription.type_confirmed = False
        subscription.retype(type_name)

    # --- requests to the robot ----------------------------------------------------------------------------

    def _subscribe_on_robot(self, subscription: RobotSubscription) -> None:
        """Without a link nothing is sent: :meth:`opened` asks later. Without a type :meth:`graph_changed` does."""
        if not subscription.type:
            subscription.retype(next(iter(self._types_of(subscription.topic)), ""))
        if self._link_state.link is None or not subscription.type or not subscription.served:
            return
        if self._link_state.cdr:
            self._definitions.request(subscription.type)
        subscription.requested()
        self._send(subscription)

    def _unsubscribe(self, subscription: RobotSubscription) -> None:
        known = self._link_state.robot_requests.withdraw(("subscribe", subscription.number))
        if known and subscription.phase in (RequestPhase.REQUESTED, RequestPhase.ACTIVE):
            self._link_state.send(link.Unsubscribe(number=subscription.number))
        subscription.reset()

    def _follow_throttle(self, subscription: RobotSubscription) -> None:
        if subscription.phase is not RequestPhase.WAITING and (
            subscription.least_throttle_ms(),
            subscription.least_thinning(),
        ) != (subscription.throttle_ms, subscription.thin):
            self._send(subscription)

    def _send(self, subscription: RobotSubscription) -> None:
        subscription.throttle_ms = subscription.least_throttle_ms()
        subscription.thin = subscription.least_thinning()
        latched_samples = subscription.latched_samples
        message = link.Subscribe(
            number=subscription.number,
            topic=subscription.topic,
            type=subscription.type,
            throttle_ms=subscription.throttle_ms,
            thin=subscription.thin,
            qos=subscription.qos,
            known_stamps=latched_samples.stamps if latched_samples.request_due else None,
        )
        on_sent = latched_samples.request_sent if latched_samples.request_due else lambda: None
        self._link_state.robot_requests.put(
            RobotRequest(("subscribe", subscription.number), message, on_sent)
        )
