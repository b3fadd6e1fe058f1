"""Topics the relay subscribes to on a robot: each once, for all clients that want it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import Invalid, Refused
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.definitions import Definitions
from relay_server.channels.robot_link import USER_TOPICS, Request, RobotLinkState, Subscriber
from relay_server.channels.topics import RequestPhase, RobotSubscription, unheard
from relay_server.common.clock import Timer, cancel

RETRY_SECONDS = 0.25
LONGEST_RETRY_SECONDS = 30.0
"""Pauses before a robot that refused a topic it has is asked again; each is twice the one before."""

LOOK_SECONDS = 0.2
"""How often it is looked whether a topic that late joiners wait for is still inhibited."""

PATIENCE = 2
"""Refusals that are told to nobody when a topic has just got another type."""


class TopicRate(NamedTuple):
    """How a topic comes.

    :param number: of the subscription; with another one counting begins anew
    :param taken: samples that have come
    :param regular: whether there is reason to expect any: not of latched topics, nor before the robot has subscribed
    """

    topic: str
    type: str
    number: int
    taken: int
    regular: bool


class Subscriptions:
    """Keeps the robot's subscriptions in step with what the clients want."""

    log = Logger()

    def __init__(self, wire: RobotLinkState, definitions: Definitions) -> None:
        self._wire = wire
        self._definitions = definitions
        self._topics: dict[str, RobotSubscription] = {}
        self._numbers: dict[int, RobotSubscription] = {}
        self._looking: Timer | None = None

    def add(
        self, member: Subscriber, listener: ClientSubscription, type_name: str | None, qos: link.QoS | None
    ) -> None:
        """A client wants a topic, or wants it otherwise than before.

        :param type_name: empty when the client leaves it to the graph, ``None`` when it is as before
        :raises Invalid: the topic has another type; nobody knows its type; too many topics
        :raises Refused: the user has too many topics of this robot subscribed
        """
        topic = listener.topic
        has = self.check(topic, type_name or "")
        uplink = self._topics.get(topic)
        if uplink is None or member not in uplink.listeners:
            self._check_room(member)
        if uplink is None:
            uplink = RobotSubscription(
                self._wire.clock,
                self._wire.number(),
                topic,
                has or type_name or "",
                qos,
                lambda: self._wire.robot.types,
                self._broken,
                self._send,
            )
            uplink.certain = bool(has)
            self._topics[topic] = self._numbers[uplink.number] = uplink
        served_before = uplink.serves(member)
        uplink.join(member, listener, type_name)
        if not uplink.type and type_name:
            uplink.retype(type_name)
        if not uplink.serves(member):
            member.tell(
                "warning",
                f"subscribe {topic}: it does not exist yet, and another client says that its type is "
                f"{uplink.type}; messages come if it turns out to be {type_name}",
                listener.latest,
            )
        if uplink.phase in (RequestPhase.WAITING, RequestPhase.FAILED):
            self._ask(uplink)
            return
        self._follow_throttle(uplink)
        self._tell_untypeable(uplink, member)
        if uplink.unmatched and type_name is not None:
            listener.warn(unheard(uplink.unmatched))
        # Each subscription gets what is latched, also a further one of the same connection, as with rosbridge_suite.
        if type_name is not None and uplink.serves(member):
            if self._silent(topic):
                uplink.owed[member] = listener
                self._look_later()
            elif uplink.phase is RequestPhase.ACTIVE:
                uplink.welcome(member, listener, live=served_before)

    def active(self) -> tuple[tuple[str, str], ...]:
        """Topics the robot is subscribed to for us, with their types."""
        return tuple(
            (uplink.topic, uplink.type)
            for uplink in self._topics.values()
            if uplink.phase is RequestPhase.ACTIVE
        )

    def flows(self) -> list[TopicRate]:
        """How each topic comes that anybody listens to."""
        return [
            TopicRate(
                each.topic,
                each.type,
                each.number,
                each.taken,
                each.phase is RequestPhase.ACTIVE and each.throttle_ms == 0 and not each.latched,
            )
            for each in self._topics.values()
        ]

    def unmatched(self, member: Subscriber) -> list[tuple[str, list[str]]]:
        """Topics of a client some of whose publishers are not heard, with these."""
        return [
            (each.topic, each.unmatched)
            for each in self._topics.values()
            if each.unmatched and member in each.listeners
        ]

    def latched(self, topic: str) -> bool:
        """Whether publishers of a topic keep their last messages for late joiners."""
        uplink = self._topics.get(topic)
        return uplink is not None and uplink.latched

    def type_for(self, member: Subscriber, topic: str) -> str:
        """The type a topic would come in to a client, while the robot does not have it; empty when nobody says one."""
        uplink = self._topics.get(topic)
        return "" if uplink is None else uplink.wanted.get(member, uplink.type)

    def check(self, topic: str, type_name: str) -> str:
        """The type a topic has for certain, or none; see :meth:`add` for what is refused.

        What other clients say of a topic that the robot does not have yet, binds nobody.
        """
        uplink = self._topics.get(topic)
        types = self._types_of(topic)
        if uplink is not None and uplink.certain:
            if type_name in types and type_name != uplink.type:
                raise Invalid(f"topic {topic} has several types; it is subscribed as {uplink.type} now")
            types = [uplink.type]
        if types and type_name and type_name not in types:
            raise Invalid(f"topic {topic} has the type {' or '.join(types)}, not {type_name}")
        if uplink is None and not types and not type_name and self._wire.link is not None:
            raise Invalid(f"topic {topic} does not exist; give its type to wait for it")
        return type_name if type_name in types else next(iter(types), "")

    def _types_of(self, topic: str) -> list[str]:
        found = self._wire.robot.graph.topics.get(topic)
        return found.types if found is not None else []

    def _check_room(self, member: Subscriber) -> None:
        mine = sum(
            any(each.user == member.user for each in uplink.listeners) for uplink in self._topics.values()
        )
        if mine >= USER_TOPICS:
            raise Refused(
                f"you have {USER_TOPICS} topics of this robot subscribed, the most one user may have"
            )

    def remove(self, member: Subscriber, topic: str) -> None:
        """A client wants a topic no more; the robot stops sending it after the last."""
        uplink = self._topics.get(topic)
        if uplink is None or not uplink.leave(member):
            return
        if not uplink.listeners:
            self._unsubscribe(uplink)
            del self._topics[topic]
            del self._numbers[uplink.number]
            self._wire.names -= 1
        elif uplink.served:
            self._follow_throttle(uplink)
        elif uplink.certain:
            self._unsubscribe(uplink)
        else:
            # Nobody is left who said this type: it was a guess, and the next one has another.
            self._retype(uplink, next(iter(uplink.wanted.values())))
            self._ask(uplink)

    def forget(self, member: Subscriber) -> None:
        """A client has gone."""
        for topic in [topic for topic, uplink in self._topics.items() if member in uplink.listeners]:
            self.remove(member, topic)

    def opened(self) -> None:
        """The robot is there: ask for everything that is wanted."""
        for uplink in list(self._topics.values()):
            self._settle(uplink)
            self._ask(uplink)

    def lost(self) -> None:
        """The robot's side is gone."""
        for uplink in self._topics.values():
            uplink.certain = False
            uplink.lost()

    def graph_changed(self) -> None:
        """What waited for a topic to appear may go on; a topic that has another type now is followed."""
        topics = self._wire.robot.graph.topics
        for uplink in list(self._topics.values()):
            self._settle(uplink)
            if uplink.phase in (RequestPhase.WAITING, RequestPhase.FAILED) and uplink.topic in topics:
                self._ask(uplink)

    def typed(self, type_name: str) -> None:
        """A definition has come: samples that waited for it can be converted."""
        for uplink in list(self._topics.values()):
            if uplink.type == type_name:
                uplink.typed()

    def subscribed(self, message: link.Subscribed) -> None:
        """The robot has subscribed."""
        self._wire.asks.answered(("subscribe", message.number))
        uplink = self._numbers.get(message.number)
        if uplink is not None:
            uplink.activate(
                message.type, message.encoding, message.latched, message.publishers, message.replays
            )
            if message.unmatched != uplink.unmatched:
                uplink.unmatched = message.unmatched
                for listener in list(uplink.listeners.values()) if message.unmatched else ():
                    listener.warn(unheard(message.unmatched))
            if message.encoding == "cdr":
                self._definitions.want(message.type)

    def refused(self, number: int, reason: str) -> None:
        """The robot could not subscribe."""
        self._wire.asks.answered(("subscribe", number))
        uplink = self._numbers.get(number)
        if uplink is None:
            return
        uplink.phase = RequestPhase.FAILED
        if uplink.refusals >= uplink.patience:
            for listener in list(uplink.listeners.values()):
                listener.fail(reason)
        if uplink.certain:
            self._try_again(uplink)

    def _try_again(self, uplink: RobotSubscription) -> None:
        """A topic that is there as we say can be had later: some middleware must let go of its former type first."""
        pause = min(RETRY_SECONDS * 2.0 ** min(uplink.refusals, 10), LONGEST_RETRY_SECONDS)
        uplink.refusals += 1
        cancel(uplink.retry)
        uplink.retry = self._wire.clock.callLater(pause, self._ask, uplink)

    def type_refused(self, type_name: str, reason: str) -> None:
        """A type is not to be had: its topics can't be shown, but to those who want them as they are."""
        for uplink in self._topics.values():
            if uplink.type == type_name:
                uplink.untypeable = reason
                for member in list(uplink.listeners):
                    self._tell_untypeable(uplink, member)

    @staticmethod
    def _tell_untypeable(uplink: RobotSubscription, member: Subscriber) -> None:
        listener = uplink.listeners.get(member)
        if uplink.untypeable and listener is not None and uplink.serves(member) and not listener.raw:
            listener.fail(uplink.untypeable)

    def sample(self, number: int, body: bytes, time: int, stamp: int) -> None:
        """Take a sample from the robot; one of a subscription that has ended is dropped.

        :param time: the robot's time when it came, nanoseconds
        :param stamp: of the frame
        """
        uplink = self._numbers.get(number)
        if uplink is not None:
            uplink.sample(body, time, stamp)

    def not_sent(self, loss: link.Lost) -> None:
        """The robot has not sent some samples."""
        uplink = self._numbers.get(loss.number)
        if uplink is not None:
            uplink.not_sent(loss)

    def losses(self, topic: str) -> Mapping[str, int]:
        """How many samples of a topic no client got, by the reason."""
        uplink = self._topics.get(topic)
        return {} if uplink is None else uplink.losses

    # --- late joiners of what is inhibited ----------------------------------------------------------------

    def _silent(self, topic: str) -> bool:
        """Whether nobody is to get samples of a topic now, not even its last one (SPEC section 1.7)."""
        return any(each.resource == topic and not each.hold for each in self._wire.robot.safety.inhibited)

    def _look_later(self) -> None:
        if self._looking is None:
            self._looking = self._wire.clock.callLater(LOOK_SECONDS, self._look)

    def _look(self) -> None:
        self._looking = None
        for uplink in list(self._topics.values()):
            if uplink.owed and not self._silent(uplink.topic):
                uplink.pay()
        if any(uplink.owed for uplink in self._topics.values()):
            self._look_later()

    def _broken(self, uplink: RobotSubscription, reason: str) -> None:
        self.log.warn(
            "a sample of {topic} from {robot} can't be converted: {failure}",
            topic=uplink.topic,
            robot=self._wire.robot.full,
            failure=reason,
        )

    # --- the type of a topic ------------------------------------------------------------------------------

    def _settle(self, uplink: RobotSubscription) -> None:
        """See what type the topic has by the robot's graph."""
        types = self._types_of(uplink.topic)
        if not types:
            uplink.certain = False
            return
        if uplink.type not in types:
            said = (wanted for wanted in uplink.wanted.values() if wanted in types)
            self._retype(uplink, next(said, types[0]))
        self._know(uplink, uplink.type)

    def _know(self, uplink: RobotSubscription, type_name: str) -> None:
        """The robot has the topic with this type: tell those who say another."""
        if uplink.certain:
            return
        uplink.certain = True
        for member, wanted in uplink.mistaken():
            listener = uplink.listeners[member]
            listener.mended()
            listener.fail(f"it has the type {type_name}, not {wanted}; subscribe with {type_name} to get it")
        if not uplink.served:
            self._unsubscribe(uplink)

    def _retype(self, uplink: RobotSubscription, type_name: str) -> None:
        """Let the topic begin anew with another type, under a number of its own: samples may be under way."""
        had_it = uplink.phase in (RequestPhase.ASKED, RequestPhase.ACTIVE)
        self._unsubscribe(uplink)
        uplink.patience = PATIENCE if had_it else 0
        del self._numbers[uplink.number]
        self._wire.names -= 1
        uplink.number = self._wire.number()
        self._numbers[uplink.number] = uplink
        uplink.certain = False
        uplink.retype(type_name)

    # --- what the robot is asked --------------------------------------------------------------------------

    def _ask(self, uplink: RobotSubscription) -> None:
        if not uplink.type:
            uplink.retype(next(iter(self._types_of(uplink.topic)), ""))
        if self._wire.link is None or not uplink.type or not uplink.served:
            return
        if self._wire.cdr:
            self._definitions.want(uplink.type)
        uplink.asked()
        self._send(uplink)

    def _unsubscribe(self, uplink: RobotSubscription) -> None:
        known = self._wire.asks.withdraw(("subscribe", uplink.number))
        if known and uplink.phase in (RequestPhase.ASKED, RequestPhase.ACTIVE):
            self._wire.send(link.Unsubscribe(number=uplink.number))
        uplink.reset()

    def _follow_throttle(self, uplink: RobotSubscription) -> None:
        if uplink.phase is not RequestPhase.WAITING and uplink.least_throttle_ms() != uplink.throttle_ms:
            self._send(uplink)

    def _send(self, uplink: RobotSubscription) -> None:
        uplink.throttle_ms = uplink.least_throttle_ms()
        kept = uplink.kept
        message = link.Subscribe(
            number=uplink.number,
            topic=uplink.topic,
            type=uplink.type,
            throttle_ms=uplink.throttle_ms,
            qos=uplink.qos,
            kept=kept.stamps if kept.wanted else None,
        )
        sent = kept.asked if kept.wanted else lambda: None
        self._wire.asks.ask(Request(("subscribe", uplink.number), message, sent))
