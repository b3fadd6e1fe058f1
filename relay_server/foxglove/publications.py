"""Messages that a Foxglove client publishes, in CDR or JSON, through the checks of every client."""

from __future__ import annotations

import itertools
from collections import OrderedDict, deque
from collections.abc import Iterable
from typing import Any, NamedTuple

import msgspec

from relay_protocol import json_cost, jsontext, nonfinite, rosbridge
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError
from relay_protocol.limits import KIB
from relay_server.access import keep_newest
from relay_server.channels.names import normal_type, resolve
from relay_server.channels.publications import ADVERTISEMENTS
from relay_server.foxglove import messages
from relay_server.foxglove.context import FoxgloveContext
from relay_server.foxglove.statuses import CHANNEL_PREFIX

ENCODINGS = ("cdr", "json")
"""Encodings of messages and calls of clients. Clients take the first that they know."""

WAITING_MESSAGES = 16
WAITING_BYTES = 64 * KIB
"""Limits of the messages of one channel that wait for the definition of its type; the newest stay."""

ALL_WAITING_BYTES = 8 * WAITING_BYTES
"""Most bytes of the messages of all channels of one client that wait so."""

_REPLACEMENT = "\N{REPLACEMENT CHARACTER}".encode()
"""In JSON of a message in place of bytes that are not UTF-8."""


class _WaitingMessage(NamedTuple):
    """:param earliest_sent: see :class:`relay_server.sessions.message_age.MessageAge`"""

    payload: bytes
    earliest_sent: int


class _RefusedChannel(NamedTuple):
    """A channel that the client could not advertise, as it may publish on it all the same.

    :param reason: why it was refused
    """

    topic: str
    reason: str


class ClientChannel:
    """A channel that the client has advertised."""

    __slots__ = ("advertisement", "encoding", "id", "topic", "type", "waiting", "withdrawn")

    def __init__(self, topic: str, type_name: str, encoding: str, advertisement: str) -> None:
        self.topic = topic
        self.type = type_name
        self.encoding = encoding
        self.advertisement = advertisement
        """Id of the session's advertisement. No later channel has it, as this one may outlive its number."""
        self.id = _publish_id(topic)
        """Of its statuses."""
        self.withdrawn = False
        self.waiting: deque[_WaitingMessage] | None = None
        """Messages that wait for the definition of the type; ``None``: it was not requested."""

    def operation(self, body: bytes) -> rosbridge.Publish:
        """The operation that publishes a message.

        :param body: JSON
        """
        return rosbridge.Publish(topic=self.topic, type=self.type, msg=msgspec.Raw(body), id=self.id)


class ClientPublications:
    """The channels of one client, and the messages on them."""

    def __init__(self, context: FoxgloveContext) -> None:
        self._context = context
        self._channels: dict[int, ClientChannel] = {}
        self._refused: OrderedDict[int, _RefusedChannel] = OrderedDict()
        self._numbers = itertools.count(1)
        self._waiting_bytes = 0

    def advertise(self, operation: messages.AdvertiseOp) -> None:
        """Advertise channels; what can't be is refused one by one."""
        for entry in self._context.first_entries(operation.channels, ADVERTISEMENTS, "advertise"):
            if entry.id in self._channels:
                self._context.deny(f"your channel {entry.id} is advertised already", "advertise", "warning")
                continue
            self._refused.pop(entry.id, None)
            try:
                self._advertise(entry)
            except SwitchboardError as error:
                self._refuse(entry, error)
                self._context.deny(f"advertise {entry.topic[:80]}: {error}", "advertise")

    def _refuse(self, entry: messages.ClientChannelEntry, error: SwitchboardError) -> None:
        keep_newest(self._refused, entry.id, _RefusedChannel(entry.topic[:80], str(error)), ADVERTISEMENTS)

    def _advertise(self, entry: messages.ClientChannelEntry) -> None:
        """:raises SwitchboardError: the entry is wrong, or too many channels are advertised"""
        if entry.encoding not in ENCODINGS:
            raise Invalid(f"the encoding '{entry.encoding[:20]}' is none of {', '.join(ENCODINGS)}")
        if len(self._channels) >= ADVERTISEMENTS:
            raise Invalid(f"at most {ADVERTISEMENTS} channels can be advertised on one connection")
        topic, type_name = resolve(entry.topic), normal_type(entry.schema_name)
        channel = ClientChannel(topic, type_name, entry.encoding, f"{CHANNEL_PREFIX}{next(self._numbers)}")
        self._context.statuses.remove(channel.id)
        operation = rosbridge.Advertise(topic=topic, type=type_name, id=channel.advertisement)
        try:
            self._context.session.perform(operation)
        except SwitchboardError as error:
            self._refuse(entry, error)
            self._context.refuse(operation, error)
        else:
            self._channels[entry.id] = channel

    def unadvertise(self, operation: messages.UnadvertiseOp) -> None:
        """Withdraw channels."""
        for number in self._context.first_entries(operation.channel_ids, ADVERTISEMENTS, "unadvertise"):
            channel = self._channels.pop(number, None)
            if channel is None:
                if self._refused.pop(number, None) is None:
                    self._context.deny(f"you have no channel {number}", "advertise", "warning")
            elif channel.waiting is None:
                self._withdraw(channel)
            else:
                # Its messages are published first; they would advertise it again.
                channel.withdrawn = True

    def _withdraw(self, channel: ClientChannel) -> None:
        self._context.perform(rosbridge.Unadvertise(topic=channel.topic, id=channel.advertisement))
        self._context.statuses.remove(channel.advertisement)

    def publish(self, message: messages.ClientMessage) -> None:
        """Publish one message."""
        channel = self._channels.get(message.channel)
        if channel is None:
            self._deny(message.channel)
            return
        client = self._context.client
        stale_before = client.stale_commands
        try:
            client.quota.check()
            if channel.encoding == "json":
                self._publish_json(channel, message.payload)
            else:
                self._publish_cdr(channel, message.payload)
        except SwitchboardError as error:
            self._context.refuse(channel.operation(b"{}"), error)
        else:
            if client.stale_commands == stale_before:
                self._context.statuses.remove(channel.id)

    def _deny(self, number: int) -> None:
        """Refuse a message on a channel that is not advertised."""
        refused = self._refused.get(number)
        if refused is None:
            id, text = "publish", f"you have no channel {number}; advertise it first"
        else:
            id = _publish_id(refused.topic)
            text = f"publish {refused.topic}: your channel {number} was refused: {refused.reason}"
        try:
            self._context.client.quota.check()
        except SwitchboardError as error:
            text = str(error)
        self._context.deny(text, id)

    def _publish_json(self, channel: ClientChannel, payload: bytes) -> None:
        body = payload.strip(b" \t\r\n")
        json_cost.check(body)
        try:
            body = nonfinite.mark_body(body)
            jsontext.decode(_raw, body)
        except SwitchboardError as error:
            raise Invalid(f"publish {channel.topic}: {error}") from None
        self._context.session.perform(channel.operation(body))

    def _publish_cdr(self, channel: ClientChannel, payload: bytes) -> None:
        client = self._context.client
        client.quota.check()
        types = client.robot.types
        if channel.waiting is not None or not types.knows(channel.type):
            self._wait(channel, payload)
            return
        # A value that is no message of the type must not reach the robot's nodes.
        with client.quota.timed():
            body = types.to_json(channel.type, payload)
        operation = channel.operation(body)
        # Text that is not UTF-8 is sent as it was read: nodes of rclpy fail on it.
        unchanged = not self._moves(channel) and _REPLACEMENT not in body
        if unchanged and self._context.session.publish_handler.publish_encoded(operation, payload):
            return
        self._context.session.perform(operation)

    def _moves(self, channel: ClientChannel) -> bool:
        """Whether messages move the robot, so that they must be judged one by one."""
        client = self._context.client
        return client.robot.is_motion(channel.topic, channel.type) or client.channel.publications.is_motion(
            channel.topic
        )

    # --- the definition of the type -----------------------------------------------------------------------

    def _wait(self, channel: ClientChannel, payload: bytes) -> None:
        """:raises Refused: the message is too long to wait, or too much waits"""
        size = len(payload)
        awaited = f"publish {channel.topic}: the definition of {channel.type} is awaited"
        if size > WAITING_BYTES:
            limit = f"messages of more than {WAITING_BYTES} bytes can't wait for it"
            raise Refused(f"{awaited}; {limit}, publish again in a moment")
        if self._waiting_bytes + size > ALL_WAITING_BYTES:
            raise Refused(f"{awaited}, and too many messages wait already; publish again in a moment")
        first = channel.waiting is None
        waiting = channel.waiting = deque() if channel.waiting is None else channel.waiting
        waiting.append(_WaitingMessage(payload, self._context.client.earliest_sent))
        self._waiting_bytes += size
        while len(waiting) > WAITING_MESSAGES or sum(len(each.payload) for each in waiting) > WAITING_BYTES:
            self._waiting_bytes -= len(waiting.popleft().payload)
        if first:
            self._context.run(self._publish_when_defined(channel))

    def _end_waiting(self, channel: ClientChannel) -> Iterable[_WaitingMessage]:
        waiting, channel.waiting = channel.waiting or (), None
        self._waiting_bytes -= sum(len(each.payload) for each in waiting)
        return waiting

    async def _publish_when_defined(self, channel: ClientChannel) -> None:
        client = self._context.client
        try:
            await client.channel.requests.definition(channel.type)
            if not client.robot.types.knows(channel.type):
                raise NotFound(f"the robot has no definition of {channel.type}; publish JSON")
        except SwitchboardError as error:
            self._end_waiting(channel)
            self._context.refuse(channel.operation(b"{}"), error)
        for each in self._end_waiting(channel):
            with client.age.as_of(each.earliest_sent):
                try:
                    self._publish_cdr(channel, each.payload)
                except SwitchboardError as error:
                    self._context.refuse(channel.operation(b"{}"), error)
        if channel.withdrawn:
            self._withdraw(channel)


def _publish_id(topic: str) -> str:
    """The id of statuses about messages on a topic."""
    return f"publish:{topic}"


_raw: msgspec.json.Decoder[dict[str, Any]] = msgspec.json.Decoder(dict[str, msgspec.Raw])
"""Checks that a text is a JSON object, without objects for what is in it."""
