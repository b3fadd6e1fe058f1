"""Topics that clients publish to; JSON is converted to the robot's encoding.

Each topic is advertised once on the robot for all its clients. A client that latches has a publisher of its own, as a
node has, so that late subscribers get the last message of each such client.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Hashable
from typing import NamedTuple

import orjson

from relay_protocol import jsontext, link, nonfinite, rosbridge
from relay_protocol.errors import Invalid, Refused, SwitchboardError
from relay_protocol.limits import MIB
from relay_protocol.link import QoS, Topic
from relay_protocol.rights import Operation
from relay_protocol.ros.compiled import json_for_robot
from relay_server.access import Permit
from relay_server.channels.definitions import Definitions
from relay_server.channels.link_state import USER_TOPICS, RobotLinkState
from relay_server.channels.members import ChannelMember, ClientMember
from relay_server.channels.names import resolve
from relay_server.channels.robot_requests import RequestPhase, RobotRequest
from relay_server.common.clock import Clock

ADVERTISEMENTS = 1024
"""Most advertisements of one client, counted by topic and id."""

QUEUE_SIZE = 10_000
"""Deepest queue of a publisher on the robot; greater requests are lowered to it."""

DEFAULT_QUEUE_SIZE = 100
"""Depth of the queue if a client requests less than one message."""

QUEUED_MESSAGES = 64
QUEUED_BYTES = MIB
"""Most messages and bytes queued of one client, over all topics of a robot."""

DROP_NOTICE_SECONDS = 10.0
"""Least seconds between two warnings to a client that its messages to a topic are dropped."""

QUEUED_SECONDS = 3.0
"""Seconds after which a message that could not be sent is dropped, as it is outdated."""


MESSAGES_DROPPED = (
    "messages are dropped, as the robot's link is too slow for them. Publish less often, or smaller messages"
)
COMMANDS_DROPPED = (
    "commands are dropped, as the robot's link is too slow for them: the newest is sent, since an old one must not "
    "move the robot. Send commands less often"
)
"""Warnings to publishers. They have no figures, so that an equal one is not shown twice."""


SendMessage = Callable[[int, int, bytes], None]
"""Sends one message, given its ``earliest_sent``, the number of the client's connection (sent with commands only), and
its JSON (part of a text that was checked). Raises :class:`Invalid` if it is not of the topic's type."""


class QueuedMessage(NamedTuple):
    """A message that waits until it can be sent; see :meth:`Publications.publish`.

    :param id: of the client's ``publish``, for notifications about it
    :param until: seconds of the relay's clock, after which it is dropped
    """

    member: ClientMember
    body: bytes
    earliest_sent: int
    id: rosbridge.Id
    until: float


class DroppedMessages:
    """A client's messages to one topic that were dropped in the queue to the robot.

    :ivar noticed_at: seconds of the relay's clock at which the client was last notified
    """

    __slots__ = ("count", "member", "noticed_at")

    def __init__(self, member: ClientMember) -> None:
        self.member = member
        self.count = 0
        self.noticed_at = -DROP_NOTICE_SECONDS


def unmatched_subscribers_text(nodes: list[str]) -> str:
    """Warning for a client whose publisher some nodes do not receive."""
    return f"these nodes request another quality of service and get nothing: {', '.join(nodes)}"


class RobotPublication:
    """A publisher on the robot.

    :param owner: the client that latches and alone publishes by it; ``None``: all other clients of the topic do
    """

    def __init__(self, number: int, topic: str, type_name: str, owner: ClientMember | None) -> None:
        self.number = number
        self.topic = topic
        self.type = type_name
        self.owner = owner
        self.latch = False
        self.queue_size = 0
        self.qos: QoS | None = None
        self.phase = RequestPhase.WAITING
        self.motion = False
        """Whether the robot counts it as motion; its messages are then commands, sent with their source."""
        self.send: SendMessage | None = None
        """Sends a message to the robot; ``None`` while none can be sent, and after a change until the next message."""
        self.send_encoded: SendMessage | None = None
        """The same for a message in CDR."""
        self.advertisers: dict[ClientMember, dict[rosbridge.Id, str]] = {}
        """Advertisements of each client by id, each with the failure that its client was last notified of."""
        self.dropped: dict[int, DroppedMessages] = {}
        """What was dropped on the way to the robot, by the number of the client's connection."""
        self.queued: deque[QueuedMessage] = deque()
        """Messages that wait until they can be sent, also of clients that have unadvertised the topic since."""
        self.unmatched: list[str] = []
        """Subscribers that receive nothing because of their quality of service, with the reason."""
        self.graph_entry: Topic | None = None
        """The topic in the robot's graph when the robot was last asked to advertise."""

    def is_used_by(self, user: int) -> bool:
        """Whether a client of a user has advertised it, or messages of such a client wait."""
        return any(each.user == user for each in self.advertisers) or any(
            each.member.user == user for each in self.queued
        )

    def enter(self, phase: RequestPhase) -> None:
        """Enter a phase; :attr:`send` is set again with the next message."""
        self.phase = phase
        self.send = self.send_encoded = None


class Publications:
    """Keeps the robot's publishers equal to the clients' advertisements, and sends their messages.

    :param now_ns: the robot's time, nanoseconds, for header stamps that a client omits
    """

    def __init__(
        self, clock: Clock, link_state: RobotLinkState, definitions: Definitions, now_ns: Callable[[], int]
    ) -> None:
        self._clock = clock
        self._link_state = link_state
        self._definitions = definitions
        self._now_ns = now_ns
        self._topics: dict[str, list[RobotPublication]] = {}
        self._by_number: dict[int, RobotPublication] = {}

    def advertise(self, member: ClientMember, operation: rosbridge.Advertise, type_name: str) -> None:
        """Advertise a topic for a client (rosbridge v2, Advertise).

        :raises Invalid: the topic has another type; too many topics
        """
        self._join(member, operation, resolve(operation.topic), type_name, operation.id)

    def _join(
        self,
        member: ClientMember,
        operation: rosbridge.Advertise | rosbridge.Publish,
        topic: str,
        type_name: str,
        id: rosbridge.Id,
    ) -> RobotPublication:
        # Motion is never latched, and its clients share a publisher.
        latched = _latches(operation) and not self._link_state.robot.is_motion(topic, type_name)
        owner = member if latched else None
        publication = self._find_or_create(member, topic, type_name, owner)
        unrequested = not publication.advertisers and publication.phase is RequestPhase.WAITING
        # The robot may have refused because of the earlier request's settings.
        if unrequested or publication.phase is RequestPhase.FAILED:
            _copy_settings(publication, operation)
            if publication.advertisers.keys() <= {member}:
                publication.owner = owner
        elif operation.latch != publication.latch or operation.qos not in (None, publication.qos):
            member.notify(
                "warning", f"{topic} is advertised already; its first latch and qos stay", operation.id
            )
        publication.advertisers.setdefault(member, {})[id] = ""
        if publication.unmatched:
            _notify_unmatched(publication, member, id)
        if publication.phase in (RequestPhase.WAITING, RequestPhase.FAILED):
            self._advertise_on_robot(publication)
        return publication

    def unadvertise(self, member: ClientMember, topic: str, id: rosbridge.Id) -> None:
        """Withdraw one advertisement of a client, or all of a topic when ``id`` is ``None``.

        Its messages that wait are still sent. Send a warning if the topic was never advertised (rosbridge v2,
        Unadvertise).
        """
        publication = self.find(topic, member)
        if publication is None:
            member.notify("warning", f"unadvertise {topic}: you have not advertised it", id)
            return
        ids = publication.advertisers[member]
        if id is not None and id not in ids:
            member.notify("warning", f"unadvertise {topic}: you have not advertised it with this id", id)
            return
        ids.pop(id, None)
        if id is None or not ids:
            self._remove_advertiser(publication, member)
            self._end_if_unused(publication)

    def forget(self, member: ChannelMember) -> None:
        """Withdraw all advertisements of a client, and drop its messages that wait."""
        for publication in list(self._by_number.values()):
            self._forget_on(publication, member)

    def _forget_on(self, publication: RobotPublication, member: ChannelMember) -> None:
        if member in publication.advertisers:
            self._remove_advertiser(publication, member)
        if publication.queued:
            publication.queued = deque(each for each in publication.queued if each.member is not member)
        self._end_if_unused(publication)

    def forget_denied(self, member: ClientMember, permit: Permit) -> None:
        """Withdraw the advertisements that a client no longer has the right to, and drop its messages that wait."""
        for publication in list(self._by_number.values()):
            if publication.is_used_by(member.user):
                decision = permit.decide(Operation.PUBLISH, publication.topic)
                if not decision.allowed:
                    ids = list(publication.advertisers.get(member, ()))
                    self._forget_on(publication, member)
                    for id in ids:
                        member.notify("error", f"unadvertised {publication.topic}: {decision.reason}", id)

    def find_or_advertise(
        self, member: ClientMember, operation: rosbridge.Publish, topic: str, type_name: str
    ) -> RobotPublication:
        """The publication of a topic; a client that has not advertised it does so now, with the message's settings.

        :raises Invalid: the topic's type is unknown, or the topic has another type
        """
        publication = self.find(topic, member)
        if publication is None:
            wanted = type_name or self.known_type(topic)
            if not wanted:
                raise Invalid(f"topic {topic} does not exist and no type was given; advertise it first")
            publication = self._join(member, operation, topic, wanted, None)
        return publication

    def unmatched(self, member: ChannelMember) -> list[tuple[str, list[str]]]:
        """Topics of a client that some nodes can't receive because of their quality of service, with these nodes."""
        return [
            (each.topic, each.unmatched)
            for each in self._by_number.values()
            if each.unmatched and member in each.advertisers
        ]

    def advertisers(self, topic: str) -> Collection[ClientMember]:
        """Clients that have advertised a topic."""
        return [member for each in self._topics.get(topic, ()) for member in each.advertisers]

    def active(self) -> tuple[tuple[str, str], ...]:
        """Topics for which the robot has a publisher for the relay, with their types."""
        active = (each for each in self._by_number.values() if each.phase is RequestPhase.ACTIVE)
        return tuple(dict.fromkeys((each.topic, each.type) for each in active))

    def message_dropped(self, key: Hashable, source: int) -> None:
        """Count a message that was dropped in the queue to the robot, and notify its client, not too often.

        :param key: number of the publication, or another key of the queue, which is ignored
        :param source: number of the client's connection
        """
        publication = self._by_number.get(key) if isinstance(key, int) else None
        if publication is None:
            return
        dropped = publication.dropped.get(source)
        if dropped is None:
            member = next((each for each in publication.advertisers if each.number == source), None)
            if member is None:
                # It has unadvertised the topic meanwhile.
                return
            dropped = publication.dropped[source] = DroppedMessages(member)
        dropped.count += 1
        now = self._clock.seconds()
        if now >= dropped.noticed_at + DROP_NOTICE_SECONDS:
            dropped.noticed_at = now
            latest = next(reversed(publication.advertisers[dropped.member]))
            words = COMMANDS_DROPPED if publication.motion else MESSAGES_DROPPED
            dropped.member.warn_of_drops(f"publish {publication.topic}: {words}", latest)

    def dropped(self, member: ClientMember) -> list[tuple[str, int]]:
        """Messages of a client that were dropped in the queue to the robot: topic and count."""
        found = ((each.topic, each.dropped.get(member.number)) for each in self._by_number.values())
        return [(topic, dropped.count) for topic, dropped in found if dropped is not None]

    def publish(
        self,
        member: ClientMember,
        publication: RobotPublication,
        body: bytes,
        earliest_sent: int,
        id: rosbridge.Id,
        seconds: float = QUEUED_SECONDS,
    ) -> None:
        """Send one message to the robot, or queue it until the link and the type are available.

        The client is notified when it could not be sent.

        :param body: JSON of the message, part of a text that was checked
        :param earliest_sent: see :class:`relay_server.sessions.message_age.MessageAge`
        :param id: of the client's ``publish``
        :param seconds: most seconds that it may wait
        """
        send = publication.send or self._prepare_send(publication)
        if send is not None:
            try:
                send(earliest_sent, member.number, body)
            except SwitchboardError as error:
                member.notify("error", f"publish {publication.topic}: {error}", id)
        elif publication.phase is RequestPhase.FAILED:
            reason = f"the robot could not advertise {publication.topic}; the message was dropped"
            member.notify("error", reason, id)
        else:
            until = self._clock.seconds() + min(seconds, QUEUED_SECONDS)
            self._enqueue(publication, QueuedMessage(member, body, earliest_sent, id, until))

    def _prepare_send(self, publication: RobotPublication) -> SendMessage | None:
        """The function that sends a message in the robot's encoding; ``None``: it can't be sent now."""
        channel_link = self._link_state.link
        if (
            channel_link is None
            or publication.phase in (RequestPhase.WAITING, RequestPhase.FAILED)
            or self._needs_type(publication)
        ):
            return None
        try:
            convert = self._converter(publication.type, publication.motion)
        except SwitchboardError as error:
            # The definition is known but is not that of a message, for example of a service.
            self.refused(publication.number, str(error))
            return None
        publication.send = channel_link.message_sender(
            publication.number, convert, commands=publication.motion
        )
        return publication.send

    def _converter(self, type_name: str, commands: bool) -> Callable[[bytes], bytes]:
        """The function that converts JSON to the robot's encoding.

        :param commands: whether it refuses numbers that are not finite
        :raises SwitchboardError: it is not the type of a message
        """
        types, now_ns = self._link_state.robot.types, self._now_ns
        if not self._link_state.cdr:
            if types.knows(type_name):
                return types.check(type_name, commands)
            return _command_of_unknown_type if commands else _json_of_unknown_type
        write = types.command_writer(type_name) if commands else types.writer(type_name, checked=True)
        return (lambda body: write(body, now_ns())) if types.is_stamped(type_name) else write

    def _enqueue(self, publication: RobotPublication, message: QueuedMessage) -> None:
        mine = (
            len(each.body)
            for other in self._by_number.values()
            for each in other.queued
            if each.member is message.member
        )
        # A single message is queued whatever its size.
        size = sum(mine)
        if size and size + len(message.body) > QUEUED_BYTES:
            _notify_dropped(publication, message, "too much waits for the robot already; dropped")
            return
        publication.queued.append(message)
        if len(publication.queued) > QUEUED_MESSAGES:
            oldest = publication.queued.popleft()
            _notify_dropped(publication, oldest, "too much waits for the robot; the oldest was dropped")

    def find(self, topic: str, member: ClientMember) -> RobotPublication | None:
        """The publication by which a client publishes to a topic, if it has advertised it."""
        return next((each for each in self._topics.get(topic, ()) if member in each.advertisers), None)

    def is_motion(self, topic: str) -> bool:
        """Whether the robot counts a topic that clients have advertised as motion."""
        return any(each.motion for each in self._topics.get(topic, ()))

    def encoded_sender(self, publication: RobotPublication) -> SendMessage | None:
        """The function that sends CDR as it is; ``None``: none can be sent now, or the robot speaks JSON."""
        if publication.send_encoded is None and publication.phase is RequestPhase.ACTIVE:
            channel_link = self._link_state.link
            if channel_link is not None and self._link_state.cdr:
                publication.send_encoded = channel_link.message_sender(
                    publication.number, commands=publication.motion
                )
        return publication.send_encoded

    def graph_changed(self) -> None:
        """Try again to advertise topics whose entry in the graph has changed."""
        for publication in list(self._by_number.values()):
            self._try_again(publication)

    def _try_again(self, publication: RobotPublication) -> None:
        now = self._link_state.robot.graph.topics.get(publication.topic)
        if publication.phase is RequestPhase.FAILED and now != publication.graph_entry:
            self._advertise_on_robot(publication)

    def opened(self) -> None:
        """Advertise all topics on a robot that has come online."""
        for publication in list(self._by_number.values()):
            self._advertise_on_robot(publication)

    def lost(self) -> None:
        """Handle that the robot is offline; queued messages are dropped as outdated."""
        for publication in list(self._by_number.values()):
            publication.enter(RequestPhase.WAITING)
            publication.unmatched = []
            queued = list(publication.queued)
            publication.queued.clear()
            for each in queued:
                _notify_dropped(publication, each, "the robot's link was lost before it was sent; dropped")
            self._end_if_unused(publication)

    def type_known(self, type_name: str) -> None:
        """Send the messages that waited for a definition, and advertise again what failed without it."""
        for publication in list(self._by_number.values()):
            if publication.type != type_name:
                continue
            if publication.phase is RequestPhase.FAILED:
                self._advertise_on_robot(publication)
            else:
                publication.enter(publication.phase)
                self._flush(publication)

    def advertised(self, message: link.Advertised) -> None:
        """Handle that the robot has the publisher."""
        self._link_state.robot_requests.answered(("advertise", message.number))
        publication = self._by_number.get(message.number)
        if publication is not None:
            publication.motion = publication.motion or message.motion
            publication.enter(RequestPhase.ACTIVE)
            for ids in publication.advertisers.values():
                ids.update(dict.fromkeys(ids, ""))
            if message.unmatched != publication.unmatched:
                publication.unmatched = message.unmatched
                for member, ids in list(publication.advertisers.items()) if message.unmatched else ():
                    for id in list(ids):
                        _notify_unmatched(publication, member, id)

    def refused(self, number: int, reason: str) -> None:
        """Handle that the robot could not advertise."""
        self._link_state.robot_requests.answered(("advertise", number))
        publication = self._by_number.get(number)
        if publication is None or publication.phase is RequestPhase.FAILED:
            return
        publication.enter(RequestPhase.FAILED)
        queued = list(publication.queued)
        publication.queued.clear()
        for each in queued:
            _notify_dropped(publication, each, reason)
        for member, ids in list(publication.advertisers.items()):
            for id, notified_reason in list(ids.items()):
                ids[id] = reason
                if notified_reason != reason:
                    member.notify("error", f"advertise {publication.topic}: {reason}", id)
        if publication.advertisers:
            # The topic may have changed before the answer arrived.
            self._try_again(publication)
        self._end_if_unused(publication)

    def type_failed(self, type_name: str, reason: str) -> None:
        """Handle that a type's definition is not available."""
        for publication in list(self._by_number.values()):
            if publication.type == type_name and publication.phase is not RequestPhase.WAITING:
                self.refused(publication.number, reason)

    def known_type(self, topic: str) -> str:
        """The type of a topic that is published to, or is in the robot's graph; empty: unknown."""
        published = self._topics.get(topic)
        return (
            (published[0].type if published else None) or self._link_state.robot.graph.topic_type(topic) or ""
        )

    def _needs_type(self, publication: RobotPublication) -> bool:
        return not self._definitions.is_settled(publication.type)

    def _find_or_create(
        self, member: ClientMember, topic: str, type_name: str, owner: ClientMember | None
    ) -> RobotPublication:
        known = self.known_type(topic)
        if known and known != type_name:
            raise Invalid(f"topic {topic} has the type {known}, not {type_name or 'none'}")
        if not type_name:
            raise Invalid(f"topic {topic} does not exist; advertise it with its type")
        if sum(len(each.advertisers.get(member, ())) for each in self._by_number.values()) >= ADVERTISEMENTS:
            raise Refused(f"at most {ADVERTISEMENTS} advertisements can be held on one connection")
        publication = self._usable(member, topic, owner)
        if publication is None or member not in publication.advertisers:
            mine = sum(each.is_used_by(member.user) for each in self._by_number.values())
            if mine >= USER_TOPICS:
                raise Refused(f"you advertise {USER_TOPICS} topics of this robot, the most one user may")
        if publication is None:
            publication = RobotPublication(self._link_state.new_number(), topic, type_name, owner)
            self._topics.setdefault(topic, []).append(publication)
            self._by_number[publication.number] = publication
        return publication

    def _usable(
        self, member: ClientMember, topic: str, owner: ClientMember | None
    ) -> RobotPublication | None:
        """The publication that a client has on a topic; else one that it can use.

        :param owner: the client if it latches
        """
        found = self.find(topic, member)
        if found is not None:
            return found
        for each in self._topics.get(topic, ()):
            unrequested = not each.advertisers and each.phase is RequestPhase.WAITING
            if each.owner is owner or (unrequested and all(other.member is member for other in each.queued)):
                return each
        return None

    def _advertise_on_robot(self, publication: RobotPublication) -> None:
        if self._link_state.link is None:
            return
        publication.enter(RequestPhase.WAITING)
        publication.graph_entry = self._link_state.robot.graph.topics.get(publication.topic)
        publication.motion = self._link_state.robot.is_motion(publication.topic, publication.type)
        self._definitions.request(publication.type)
        message = link.Advertise(
            number=publication.number,
            topic=publication.topic,
            type=publication.type,
            latch=publication.latch,
            queue_size=publication.queue_size,
            qos=publication.qos,
        )

        def on_sent() -> None:
            publication.enter(RequestPhase.REQUESTED)
            if not self._needs_type(publication):
                self._flush(publication)

        self._link_state.robot_requests.put(RobotRequest(("advertise", publication.number), message, on_sent))

    def _flush(self, publication: RobotPublication) -> None:
        if self._prepare_send(publication) is None:
            return
        queued = list(publication.queued)
        publication.queued.clear()
        now = self._clock.seconds()
        for each in queued:
            if each.until < now:
                _notify_dropped(publication, each, "the robot could not be reached in time; dropped")
            else:
                self.publish(each.member, publication, each.body, each.earliest_sent, each.id)
        self._end_if_unused(publication)

    def _remove_advertiser(self, publication: RobotPublication, member: ClientMember) -> None:
        del publication.advertisers[member]
        publication.dropped.pop(member.number, None)

    def _end_if_unused(self, publication: RobotPublication) -> None:
        """End a publication that no client advertises and on which no message waits."""
        is_known = self._by_number.get(publication.number) is publication
        if publication.advertisers or publication.queued or not is_known:
            return
        others = self._topics[publication.topic]
        others.remove(publication)
        if not others:
            del self._topics[publication.topic]
        del self._by_number[publication.number]
        self._link_state.names_in_use -= 1
        self._link_state.robot_requests.withdraw(("advertise", publication.number))
        if publication.phase in (RequestPhase.REQUESTED, RequestPhase.ACTIVE):
            self._link_state.send(link.Unadvertise(number=publication.number))


def _latches(operation: rosbridge.Advertise | rosbridge.Publish) -> bool:
    """Whether the last messages are kept for late subscribers."""
    return operation.latch or (operation.qos is not None and operation.qos.durability == "transient_local")


def _copy_settings(publication: RobotPublication, operation: rosbridge.Advertise | rosbridge.Publish) -> None:
    """Set latch, queue and quality of service of a publication from a message."""
    publication.latch = operation.latch
    publication.queue_size = (
        min(operation.queue_size, QUEUE_SIZE) if operation.queue_size > 0 else DEFAULT_QUEUE_SIZE
    )
    publication.qos = operation.qos


def _notify_unmatched(publication: RobotPublication, member: ChannelMember, id: rosbridge.Id) -> None:
    member.notify(
        "warning", f"advertise {publication.topic}: {unmatched_subscribers_text(publication.unmatched)}", id
    )


def _notify_dropped(publication: RobotPublication, message: QueuedMessage, reason: str) -> None:
    message.member.notify("error", f"publish {publication.topic}: {reason}", message.id)


def _json_of_unknown_type(body: bytes) -> bytes:
    """A message for a robot that speaks JSON, of a type that is not known: any object that all readers can parse.

    msgspec has skipped over the body, which rejects invalid JSON except numbers beyond a double. The text around it was
    checked for UTF-8 and depth.
    """
    if body[0] != _BRACE:
        raise Invalid("'msg' must be an object")
    if not jsontext.in_range(body):
        try:
            orjson.loads(body)
        except ValueError as error:
            raise Invalid(f"the message can't be read: {error}") from None
    return json_for_robot(body)


def _command_of_unknown_type(body: bytes) -> bytes:
    """As :func:`_json_of_unknown_type`; its numbers are finite."""
    converted = _json_of_unknown_type(body)
    nonfinite.require_finite(body)
    return converted


_BRACE = ord("{")
