"""Topics the relay subscribes to on a robot: each once, for all clients that want it."""

from __future__ import annotations

from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import Invalid, Refused
from relay_server.channel.definitions import Definitions
from relay_server.channel.listener import Listener
from relay_server.channel.topics import Phase, TopicUplink
from relay_server.channel.wire import USER_TOPICS, Ask, Member, Wire, resolve


class Subscriptions:
    """Keeps the robot's subscriptions in step with what the clients want."""

    log = Logger()

    def __init__(self, wire: Wire, definitions: Definitions) -> None:
        self._wire = wire
        self._definitions = definitions
        self._topics: dict[str, TopicUplink] = {}
        self._numbers: dict[int, TopicUplink] = {}

    def add(self, member: Member, listener: Listener, type_name: str, qos: link.QoS | None) -> None:
        """A client wants a topic, or wants it otherwise than before.

        :param type_name: empty when the client leaves it to the graph
        :raises Invalid: the topic has another type; nobody knows its type; too many topics
        :raises Refused: the user has too many topics of this robot subscribed
        """
        topic = resolve(listener.name)
        has = self.check(topic, type_name)
        uplink = self._topics.get(topic)
        if uplink is None or member not in uplink.listeners:
            self._check_room(member)
        if uplink is None:
            uplink = TopicUplink(self._wire.number(), topic, has or type_name, qos)
            self._topics[topic] = self._numbers[uplink.number] = uplink
        newcomer = member not in uplink.listeners
        uplink.listeners[member] = listener
        if uplink.phase in (Phase.WAITING, Phase.FAILED):
            uplink.type = uplink.type or type_name
            self._ask(uplink)
            return
        if uplink.least_throttle_ms() != uplink.throttle_ms:
            self._send(uplink)
        if newcomer:
            uplink.replay(listener)

    def active(self) -> tuple[tuple[str, str], ...]:
        """Topics the robot is subscribed to for us, with their types."""
        return tuple(
            (uplink.topic, uplink.type) for uplink in self._topics.values() if uplink.phase is Phase.ACTIVE
        )

    def check(self, topic: str, type_name: str) -> str:
        """The type a topic has already, or none; see :meth:`add` for what is refused."""
        uplink = self._topics.get(topic)
        has = (uplink.type if uplink else "") or self._wire.robot.graph.topic_type(topic) or ""
        if has and type_name and type_name != has:
            raise Invalid(f"topic {topic} has the type {has}, not {type_name}")
        if uplink is None and not has and not type_name and self._wire.link is not None:
            raise Invalid(f"topic {topic} does not exist; give its type to wait for it")
        return has

    def _check_room(self, member: Member) -> None:
        mine = sum(
            any(each.user == member.user for each in uplink.listeners) for uplink in self._topics.values()
        )
        if mine >= USER_TOPICS:
            raise Refused(
                f"you have {USER_TOPICS} topics of this robot subscribed, the most one user may have"
            )

    def remove(self, member: Member, topic: str) -> None:
        """A client wants a topic no more; the robot stops sending it after the last."""
        uplink = self._topics.get(topic)
        if uplink is None or uplink.listeners.pop(member, None) is None:
            return
        if not uplink.listeners:
            del self._topics[topic]
            del self._numbers[uplink.number]
            self._wire.names -= 1
            known = self._wire.asks.withdraw(("subscribe", uplink.number))
            if known and uplink.phase in (Phase.ASKED, Phase.ACTIVE):
                self._wire.send(link.Unsubscribe(number=uplink.number))
        elif uplink.phase is not Phase.WAITING and uplink.least_throttle_ms() != uplink.throttle_ms:
            self._send(uplink)

    def forget(self, member: Member) -> None:
        """A client has gone."""
        for topic in [topic for topic, uplink in self._topics.items() if member in uplink.listeners]:
            self.remove(member, topic)

    def opened(self) -> None:
        """The robot is there: ask for everything that is wanted."""
        for uplink in list(self._topics.values()):
            self._ask(uplink)

    def lost(self) -> None:
        """The robot's side is gone."""
        for uplink in self._topics.values():
            uplink.reset()

    def graph_changed(self) -> None:
        """What waited for a topic to appear may go on."""
        topics = self._wire.robot.graph.topics
        for uplink in list(self._topics.values()):
            if uplink.phase in (Phase.WAITING, Phase.FAILED) and uplink.topic in topics:
                self._ask(uplink)

    def typed(self, type_name: str) -> None:
        """A definition has come: samples that waited for it can be converted."""
        for uplink in list(self._topics.values()):
            if uplink.type == type_name:
                uplink.typed(self._wire.robot.types)

    def subscribed(self, message: link.Subscribed) -> None:
        """The robot has subscribed."""
        self._wire.asks.answered(("subscribe", message.number))
        uplink = self._numbers.get(message.number)
        if uplink is not None:
            uplink.activate(message.type, message.encoding, message.latched, message.publishers)
            if message.encoding == "cdr":
                self._definitions.want(message.type)

    def refused(self, number: int, reason: str) -> None:
        """The robot could not subscribe."""
        self._wire.asks.answered(("subscribe", number))
        uplink = self._numbers.get(number)
        if uplink is None:
            return
        uplink.phase = Phase.FAILED
        for member in list(uplink.listeners):
            member.tell("error", f"subscribe {uplink.topic}: {reason}")

    def type_refused(self, type_name: str, reason: str) -> None:
        """A type is not to be had: its topics can't be shown."""
        for uplink in self._topics.values():
            if uplink.type == type_name:
                for member in list(uplink.listeners):
                    member.tell("error", f"subscribe {uplink.topic}: {reason}")

    def sample(self, number: int, body: bytes) -> None:
        """A sample from the robot; one of a subscription given back already is let go."""
        uplink = self._numbers.get(number)
        if uplink is None:
            return
        sample = uplink.sample(body, self._wire.robot.types)
        if sample is not None and sample.failure and not uplink.failures:
            self.log.warn(
                "a sample of {topic} from {robot} can't be converted: {failure}",
                topic=uplink.topic,
                robot=self._wire.robot.name,
                failure=sample.failure,
            )
        uplink.failures += bool(sample is not None and sample.failure)

    def _ask(self, uplink: TopicUplink) -> None:
        uplink.type = uplink.type or self._wire.robot.graph.topic_type(uplink.topic) or ""
        if self._wire.link is None or not uplink.type:
            return
        self._definitions.want(uplink.type)
        uplink.phase = Phase.ASKED
        self._send(uplink)

    def _send(self, uplink: TopicUplink) -> None:
        uplink.throttle_ms = uplink.least_throttle_ms()
        message = link.Subscribe(
            number=uplink.number,
            topic=uplink.topic,
            type=uplink.type,
            throttle_ms=uplink.throttle_ms,
            qos=uplink.qos,
        )
        self._wire.asks.ask(Ask(("subscribe", uplink.number), message, lambda: None))
