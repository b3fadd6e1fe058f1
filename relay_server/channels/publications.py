"""Topics clients publish to: each advertised once on the robot, JSON turned into the robot's encoding."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection

import orjson

from relay_protocol import jsontext, link, nonfinite, rosbridge
from relay_protocol.errors import Invalid, Refused, SwitchboardError
from relay_protocol.limits import MIB
from relay_protocol.rights import Operation
from relay_protocol.ros.compiled import Writer
from relay_protocol.ros.fast_writer import LARGEST_BODY
from relay_server.access import Permit
from relay_server.channels.definitions import Definitions
from relay_server.channels.robot_link import (
    USER_TOPICS,
    ChannelPort,
    Publisher,
    Request,
    RobotLinkState,
    Subscriber,
    resolve,
)
from relay_server.channels.topics import ClientPublication, QueuedMessage, RequestPhase, Send, unserved
from relay_server.common.clock import Clock

ADVERTISEMENTS = 1024
"""Advertisements of one client, by topic and id."""

QUEUE_SIZE = 10_000
"""Deepest queue of a publisher on the robot; who asks for more gets this."""

USUAL_QUEUE_SIZE = 100
"""What it is for who asks for less than one message."""

HELD_MESSAGES = 64
HELD_BYTES = MIB
"""What may be held of one client, over all topics of a robot."""

HELD_SECONDS = 3.0
"""A message that could not go out by then is dropped: nobody wants it done that late."""


class Publications:
    """Keeps the robot's publishers in step with what clients advertise, and carries their messages.

    :param now_ns: the robot's time, nanoseconds, for header stamps a client leaves out
    """

    def __init__(
        self, clock: Clock, wire: RobotLinkState, definitions: Definitions, now_ns: Callable[[], int]
    ) -> None:
        self._clock = clock
        self._wire = wire
        self._definitions = definitions
        self._now_ns = now_ns
        self._topics: dict[str, ClientPublication] = {}
        self._numbers: dict[int, ClientPublication] = {}

    def advertise(self, member: Subscriber, ask: rosbridge.Advertise, type_name: str) -> None:
        """A client is going to publish (rosbridge v2, Advertise).

        :raises Invalid: the topic has another type; too many topics
        """
        self._join(member, ask, resolve(ask.topic), type_name, ask.id)

    def _join(
        self,
        member: Subscriber,
        ask: rosbridge.Advertise | rosbridge.Publish,
        topic: str,
        type_name: str,
        id: rosbridge.Id,
    ) -> ClientPublication:
        publication = self._get(member, topic, type_name)
        # What the robot refused may have been refused for how it was asked.
        if not publication.holders or publication.phase is RequestPhase.FAILED:
            _settle(publication, ask)
        elif ask.latch != publication.latch or ask.qos not in (None, publication.qos):
            member.tell("warning", f"{topic} is advertised already; its first latch and qos stay", ask.id)
        publication.holders.setdefault(member, {})[id] = ""
        if publication.unmatched:
            _tell_unmatched(publication, member, id)
        if publication.phase in (RequestPhase.WAITING, RequestPhase.FAILED):
            self._ask(publication)
        return publication

    def unadvertise(self, member: Subscriber, topic: str, id: rosbridge.Id) -> None:
        """A client takes one advertisement back, or all of a topic when ``id`` is ``None``.

        What was never advertised is told by a warning (rosbridge v2, Unadvertise).
        """
        publication = self._topics.get(topic)
        ids = publication.holders.get(member) if publication is not None else None
        if publication is None or ids is None:
            member.tell("warning", f"unadvertise {topic}: you have not advertised it", id)
            return
        if id is not None and id not in ids:
            member.tell("warning", f"unadvertise {topic}: you have not advertised it with this id", id)
            return
        ids.pop(id, None)
        if id is None or not ids:
            self._let_go(publication, member)

    def forget(self, member: Subscriber) -> None:
        """A client has gone."""
        for publication in list(self._topics.values()):
            self._let_go(publication, member)

    def forget_denied(self, member: Subscriber, permit: Permit) -> None:
        """A client's rights have changed: what it may not publish any more is taken back."""
        for publication in list(self._topics.values()):
            if member in publication.holders:
                verdict = permit.judge(Operation.PUBLISH, publication.topic)
                if not verdict.allowed:
                    ids = list(publication.holders[member])
                    self._let_go(publication, member)
                    for id in ids:
                        member.tell("error", f"unadvertised {publication.topic}: {verdict.reason}", id)

    def get(
        self, member: Subscriber, ask: rosbridge.Publish, topic: str, type_name: str
    ) -> ClientPublication:
        """The publication a client publishes to, advertised now, as the message says, if it was not.

        :raises Invalid: nobody knows the topic's type, or it has another one
        """
        publication = self._topics.get(topic)
        if publication is None or member not in publication.holders:
            wanted = type_name or self.known_type(topic)
            if not wanted:
                raise Invalid(f"topic {topic} does not exist and no type was given; advertise it first")
            publication = self._join(member, ask, topic, wanted, None)
        return publication

    def unmatched(self, member: Subscriber) -> list[tuple[str, list[str]]]:
        """Topics that a client has advertised and some nodes do not hear, with these."""
        return [
            (each.topic, each.unmatched)
            for each in self._topics.values()
            if each.unmatched and member in each.holders
        ]

    def holders(self, topic: str) -> Collection[Subscriber]:
        """Who has advertised a topic."""
        publication = self._topics.get(topic)
        return () if publication is None else publication.holders.keys()

    def active(self) -> tuple[tuple[str, str], ...]:
        """Topics the robot has a publisher on for us, with their types."""
        return tuple(
            (each.topic, each.type) for each in self._topics.values() if each.phase is RequestPhase.ACTIVE
        )

    def publish(
        self,
        member: Publisher,
        publication: ClientPublication,
        body: bytes,
        stamp: int,
        id: rosbridge.Id,
        good_for: float = HELD_SECONDS,
    ) -> None:
        """Send one message to the robot, or hold it for the moment until the link or the type is there.

        The client is told in words when it could not be sent.

        :param body: JSON of the message, part of a text that was checked
        :param stamp: the relay's monotonic nanoseconds; the message can't have been sent before
        :param id: of the client's ``publish``
        :param good_for: seconds from now after which it must not be sent any more
        """
        send = publication.send or self._sender(publication)
        if send is not None:
            try:
                send(body, stamp, member.number)
            except SwitchboardError as error:
                member.tell("error", f"publish {publication.topic}: {error}", id)
        elif publication.phase is RequestPhase.FAILED:
            reason = f"the robot could not advertise {publication.topic}; the message was dropped"
            member.tell("error", reason, id)
        else:
            until = self._clock.seconds() + min(good_for, HELD_SECONDS)
            self._hold(publication, QueuedMessage(member, body, stamp, id, until))

    def _sender(self, publication: ClientPublication) -> Send | None:
        """What sends a message in the robot's form, if that can be done now."""
        robot = self._wire.link
        if (
            robot is None
            or publication.phase in (RequestPhase.WAITING, RequestPhase.FAILED)
            or self._untyped(publication)
        ):
            return None
        put, types = _way(robot, publication), self._wire.robot.types
        if not self._wire.cdr and not types.knows(publication.type):
            publication.send = _unchecked(put)
            return publication.send
        try:
            writer = types.writer(publication.type, checked=True)
        except SwitchboardError as error:
            # The robot said it was known: it told of a service's type, or of something else that is no message.
            self.refused(publication.number, str(error))
            return None
        make = _as_cdr if self._wire.cdr else _as_json
        publication.send = make(writer, self._now_ns, put)
        return publication.send

    def _hold(self, publication: ClientPublication, message: QueuedMessage) -> None:
        mine = (
            len(each.body)
            for topic in self._topics.values()
            for each in topic.held
            if each.member is message.member
        )
        # However large, one has room alone.
        held = sum(mine)
        if held and held + len(message.body) > HELD_BYTES:
            _dropped(publication, message, "too much waits for the robot already; dropped")
            return
        publication.held.append(message)
        if len(publication.held) > HELD_MESSAGES:
            oldest = publication.held.popleft()
            _dropped(publication, oldest, "too much waits for the robot; the oldest was dropped")

    def graph_changed(self) -> None:
        """What the robot could not advertise may be possible now, where something has changed."""
        for publication in list(self._topics.values()):
            self._try_again(publication)

    def _try_again(self, publication: ClientPublication) -> None:
        now = self._wire.robot.graph.topics.get(publication.topic)
        if publication.phase is RequestPhase.FAILED and now != publication.seen:
            self._ask(publication)

    def opened(self) -> None:
        """The robot is there: advertise everything."""
        for publication in list(self._topics.values()):
            self._ask(publication)

    def lost(self) -> None:
        """The robot's side is gone; what was held is older than anyone would want executed."""
        for publication in self._topics.values():
            publication.enter(RequestPhase.WAITING)
            publication.held.clear()
            publication.unmatched = []

    def typed(self, type_name: str) -> None:
        """A definition has come: what was held for it goes, and what failed without it is tried again."""
        for publication in list(self._topics.values()):
            if publication.type != type_name:
                continue
            if publication.phase is RequestPhase.FAILED:
                self._ask(publication)
            else:
                publication.enter(publication.phase)
                self._flush(publication)

    def advertised(self, message: link.Advertised) -> None:
        """The publisher stands."""
        self._wire.asks.answered(("advertise", message.number))
        publication = self._numbers.get(message.number)
        if publication is not None:
            publication.motion = publication.motion or message.motion
            publication.enter(RequestPhase.ACTIVE)
            for ids in publication.holders.values():
                ids.update(dict.fromkeys(ids, ""))
            if message.unmatched != publication.unmatched:
                publication.unmatched = message.unmatched
                for member, ids in list(publication.holders.items()) if message.unmatched else ():
                    for id in list(ids):
                        _tell_unmatched(publication, member, id)

    def refused(self, number: int, reason: str) -> None:
        """The robot could not advertise."""
        self._wire.asks.answered(("advertise", number))
        publication = self._numbers.get(number)
        if publication is None or publication.phase is RequestPhase.FAILED:
            return
        publication.enter(RequestPhase.FAILED)
        held = list(publication.held)
        publication.held.clear()
        for each in held:
            _dropped(publication, each, reason)
        for member, ids in list(publication.holders.items()):
            for id, told in list(ids.items()):
                ids[id] = reason
                if told != reason:
                    member.tell("error", f"advertise {publication.topic}: {reason}", id)
        if publication.holders:
            # The topic may have changed while the answer was on its way.
            self._try_again(publication)

    def type_refused(self, type_name: str, reason: str) -> None:
        """A type is not to be had."""
        for publication in list(self._topics.values()):
            if publication.type == type_name and publication.phase is not RequestPhase.WAITING:
                self.refused(publication.number, reason)

    def known_type(self, topic: str) -> str:
        """The type of a topic that is published to, or is in the robot's graph; empty where nobody knows it."""
        publication = self._topics.get(topic)
        return (publication.type if publication else None) or self._wire.robot.graph.topic_type(topic) or ""

    def _untyped(self, publication: ClientPublication) -> bool:
        return not self._definitions.settled(publication.type)

    def _get(self, member: Subscriber, topic: str, type_name: str) -> ClientPublication:
        known = self.known_type(topic)
        if known and known != type_name:
            raise Invalid(f"topic {topic} has the type {known}, not {type_name or 'none'}")
        if not type_name:
            raise Invalid(f"topic {topic} does not exist; advertise it with its type")
        if sum(len(each.holders.get(member, ())) for each in self._topics.values()) >= ADVERTISEMENTS:
            raise Refused(f"at most {ADVERTISEMENTS} advertisements can be held on one connection")
        publication = self._topics.get(topic)
        if publication is None or member not in publication.holders:
            mine = sum(
                any(each.user == member.user for each in topic.holders) for topic in self._topics.values()
            )
            if mine >= USER_TOPICS:
                raise Refused(f"you advertise {USER_TOPICS} topics of this robot, the most one user may")
        if publication is None:
            publication = ClientPublication(self._wire.number(), topic, type_name)
            self._topics[topic] = self._numbers[publication.number] = publication
        return publication

    def _ask(self, publication: ClientPublication) -> None:
        if self._wire.link is None:
            return
        publication.enter(RequestPhase.WAITING)
        publication.seen = self._wire.robot.graph.topics.get(publication.topic)
        publication.motion = self._wire.robot.is_motion(publication.topic, publication.type)
        self._definitions.want(publication.type)
        message = link.Advertise(
            number=publication.number,
            topic=publication.topic,
            type=publication.type,
            latch=publication.latch,
            queue_size=publication.queue_size,
            qos=publication.qos,
        )

        def sent() -> None:
            publication.enter(RequestPhase.ASKED)
            if not self._untyped(publication):
                self._flush(publication)

        self._wire.asks.ask(Request(("advertise", publication.number), message, sent))

    def _flush(self, publication: ClientPublication) -> None:
        if self._sender(publication) is None:
            return
        held = list(publication.held)
        publication.held.clear()
        now = self._clock.seconds()
        for each in held:
            if each.until < now:
                _dropped(publication, each, "the robot could not be reached in time; dropped")
            else:
                self.publish(each.member, publication, each.body, each.stamp, each.id)

    def _let_go(self, publication: ClientPublication, member: Subscriber) -> None:
        if publication.holders.pop(member, None) is None:
            return
        publication.held = deque(each for each in publication.held if each.member is not member)
        if publication.holders:
            return
        del self._topics[publication.topic]
        del self._numbers[publication.number]
        self._wire.names -= 1
        self._wire.asks.withdraw(("advertise", publication.number))
        if publication.phase in (RequestPhase.ASKED, RequestPhase.ACTIVE):
            self._wire.send(link.Unadvertise(number=publication.number))


def _settle(publication: ClientPublication, ask: rosbridge.Advertise | rosbridge.Publish) -> None:
    """Take over how the robot is to publish."""
    publication.latch = ask.latch
    publication.queue_size = min(ask.queue_size, QUEUE_SIZE) if ask.queue_size > 0 else USUAL_QUEUE_SIZE
    publication.qos = ask.qos


def _tell_unmatched(publication: ClientPublication, member: Subscriber, id: rosbridge.Id) -> None:
    member.tell("warning", f"advertise {publication.topic}: {unserved(publication.unmatched)}", id)


def _dropped(publication: ClientPublication, message: QueuedMessage, reason: str) -> None:
    message.member.tell("error", f"publish {publication.topic}: {reason}", message.id)


Way = Callable[[int, int, bytes], None]
"""Puts a message on the robot's link: its stamp, its source, and what it is in the robot's encoding."""


def _way(robot: ChannelPort, publication: ClientPublication) -> Way:
    """Commands carry their source; nobody asks about that of other samples."""
    number = publication.number

    def command(stamp: int, source: int, body: bytes) -> None:
        robot.command(number, stamp, source, body)

    def sample(stamp: int, source: int, body: bytes) -> None:
        robot.sample(number, stamp, body)

    return command if publication.motion else sample


def _as_cdr(write: Writer, now_ns: Callable[[], int], put: Way) -> Send:
    """Send messages to a robot that speaks CDR."""

    def send(body: bytes, stamp: int, source: int) -> None:
        put(stamp, source, write(body, now_ns()))

    return send


def _as_json(write: Writer, now_ns: Callable[[], int], put: Way) -> Send:
    """Send messages to a robot that speaks JSON: in the client's own words, when they are of the topic's type.

    So numbers keep all their digits, and fields that were left out stay out.
    """

    def send(body: bytes, stamp: int, source: int) -> None:
        write(body, now_ns())
        put(stamp, source, _json_for_robot(body))

    return send


def _json_for_robot(body: bytes) -> bytes:
    body = nonfinite.as_null(body)
    if len(body) > LARGEST_BODY:
        raise Invalid(f"the message has {len(body)} bytes as JSON; a robot takes at most {LARGEST_BODY}")
    return body


_BRACE = ord("{")


def _unchecked(put: Way) -> Send:
    """Send messages to a robot that speaks JSON and can't tell the type: any object that every reader can take.

    msgspec has skipped the body, which finds all that is not JSON except a number beyond any double; the text around
    it was checked for UTF-8 and depth.
    """

    def send(body: bytes, stamp: int, source: int) -> None:
        if body[0] != _BRACE:
            raise Invalid("'msg' must be an object")
        if not jsontext.in_range(body):
            try:
                orjson.loads(body)
            except ValueError as error:
                raise Invalid(f"the message can't be read: {error}") from None
        put(stamp, source, _json_for_robot(body))

    return send
