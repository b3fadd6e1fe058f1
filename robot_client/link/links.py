"""The robot's side of links, without sockets: bytes in, events and bytes out.

States of a control link: greeting, proving, registered. Of the link of a channel or camera stream: joining, open. An
enrolment is one request. A table in each class names the messages that are accepted in each state; any other message
is an error. :mod:`robot_client.link.transport` connects a link to a socket.
"""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, get_args

import msgspec

from relay_protocol import PROTOCOL_VERSION, frames, identity, jsontext, link
from relay_protocol.errors import MalformedMessage, PeerError, Refused
from relay_protocol.limits import (
    HANDSHAKE_FRAME,
    HEARTBEAT_SECONDS,
    HEARTBEATS_MISSED,
    RELAY_FRAME,
    RELAY_JSON_FRAME,
)
from relay_protocol.pacing import SendWindow
from robot_client.link.clock_offset import ClockOffset

NANO = 1_000_000_000
ENCODINGS = ["cdr"]
INITIAL_PINGS = 3
"""Pings sent at once when a link is joined, to measure the clock offset."""

CHANNEL_PING_SECONDS = 1.0
UPLINK_TARGET = 0.2
"""Seconds that samples may spend in the network before the relay has them. Commands go the other way."""


class LinkState(enum.Enum):
    """State of a link."""

    GREETING = "greeting"
    PROVING = "proving"
    REGISTERED = "registered"
    ENROLLING = "enrolling"
    JOINING = "joining"
    OPEN = "open"


class Registered(NamedTuple):
    """The relay has registered the robot."""

    welcome: link.Welcome
    relay: str


class JoinedChannel(NamedTuple):
    """The link has joined a channel or a camera stream.

    :param channel: its name
    """

    channel: str


class EnrolledAt(NamedTuple):
    """The relay has accepted the public key."""

    enrolled: link.Enrolled


class MessageReceived(NamedTuple):
    """The relay sent a message for the owner of the link."""

    message: link.Message


class SampleReceived(NamedTuple):
    """The relay sent a sample to publish."""

    frame: frames.SampleFrame


class CommandReceived(NamedTuple):
    """The relay sent a command that may move the robot."""

    frame: frames.CommandFrame


class LinkEnded(NamedTuple):
    """The relay sent ``bye``."""

    reason: str


Event = (
    Registered | JoinedChannel | EnrolledAt | MessageReceived | SampleReceived | CommandReceived | LinkEnded
)


class RelayRefused(Refused):
    """The relay refused the robot.

    ``retry_after`` is in seconds, ``None`` if only a person can resolve the refusal.
    """

    def __init__(self, message: link.Refused) -> None:
        super().__init__(message.reason)
        self.relay_code = message.code
        self.retry_after = message.retry_after


class WrongRelay(Refused):
    """The peer is not the relay at which this robot was enrolled."""


class LinkSilent(PeerError):
    """Nothing was received for three heartbeats."""


class Identity(NamedTuple):
    """A robot's identity at one relay.

    :param key: private Ed25519 key, 32 raw bytes
    """

    robot: str
    relay: str
    key: bytes


Handler = Callable[[Any, Any], "list[Event]"]
Table = dict[tuple[LinkState, type], Handler]


class Link(ABC):
    """Base of all links: decodes frames, answers pings, detects silence.

    :param clock: monotonic clock, nanoseconds
    :param heartbeat: seconds
    """

    state: LinkState
    _table: ClassVar[Table]
    _decoders: ClassVar[dict[LinkState, msgspec.json.Decoder[Any]]]
    ping_every = HEARTBEAT_SECONDS

    def __init__(self, clock: Callable[[], int], heartbeat: float = HEARTBEAT_SECONDS) -> None:
        self.clock = clock
        self.heartbeat = heartbeat
        self.offset = ClockOffset()
        self._frames = frames.FrameDecoder(HANDSHAKE_FRAME)
        self.window: SendWindow | None = None
        """Limits the unconfirmed bytes on their way to the relay; ``None`` for no limit."""
        self.unsent: list[bytes] = []
        """Encoded messages that :meth:`take` returns next."""
        self._last_received = clock()

    def discard(self) -> None:
        """The connection is lost: drop what has come of incomplete frames and messages."""
        self._frames.clear()

    @abstractmethod
    def begin(self) -> None:
        """The connection is made; send the first message."""

    def send(self, message: link.Message) -> None:
        """Queue one message."""
        self.unsent.append(link.frame(message))

    def take(self) -> list[bytes]:
        """Remove and return the bytes to be written."""
        out, self.unsent = self.unsent, []
        return out

    def ping(self, full: bool = False) -> None:
        """Send a ping.

        :param full: whether samples wait for room in :attr:`window`
        """
        now = self.clock()
        if self.window is not None:
            self.window.probe(now, now / NANO, full=full)
        self.send(link.Ping(t=now))

    def check_silence(self) -> None:
        """Check that the relay still sends.

        :raises LinkSilent: nothing was received for three heartbeats
        """
        silent = (self.clock() - self._last_received) / NANO
        if silent > self.heartbeat * HEARTBEATS_MISSED:
            raise LinkSilent(f"the relay has been silent for {silent:.1f} s")

    def receive(self, data: bytes) -> list[Event]:
        """Decode received bytes; answer pings.

        :raises PeerError: the relay violated the protocol
        :raises RelayRefused: the relay refused the robot
        :raises WrongRelay: the peer is another relay
        """
        self._last_received = self.clock()
        events: list[Event] = []
        for frame in self._frames.feed(data):
            events += self._frame(frame)
        return events

    def _frame(self, frame: frames.Frame) -> list[Event]:
        if not isinstance(frame, frames.JsonFrame):
            return self._sample(frame)
        message = jsontext.decode(self._decoders[self.state], frame.body)
        handler = self._table.get((self.state, type(message))) or _IN_EVERY_STATE.get(type(message))
        if handler is None:
            op = link.lower_tag(type(message).__name__)
            raise MalformedMessage(f"the relay sent '{op}' while this link was {self.state.value}")
        return handler(self, message)

    def _sample(self, frame: frames.Frame) -> list[Event]:
        raise MalformedMessage(
            f"the relay sent a {type(frame).__name__} while this link was {self.state.value}"
        )

    def _on_ping(self, message: link.Ping) -> list[Event]:
        self.send(link.Pong(t=message.t, at=self.clock()))
        return []

    def _on_pong(self, message: link.Pong) -> list[Event]:
        now = self.clock()
        if self.window is not None:
            self.window.answered(message.t, now / NANO)
        self.offset.add(message.t, message.at, now)
        return []

    def _on_bye(self, message: link.Bye) -> list[Event]:
        return [LinkEnded(message.reason)]

    def _on_refused(self, message: link.Refused) -> list[Event]:
        raise RelayRefused(message)


_IN_EVERY_STATE: dict[type, Handler] = {
    link.Ping: Link._on_ping,
    link.Pong: Link._on_pong,
    link.Bye: Link._on_bye,
    link.Refused: Link._on_refused,
}


class ControlLink(Link):
    """The link that registers the robot, and carries all that belongs to no channel.

    Control of the robot, which clients take and release, is only one part of that.

    :param agent: name and version of this software, for display
    """

    functions: ClassVar[bool] = False
    """Whether the link calls functions and does not register the robot."""

    def __init__(self, own_identity: Identity, agent: str, clock: Callable[[], int]) -> None:
        super().__init__(clock)
        self.state = LinkState.GREETING
        self._identity = own_identity
        self._agent = agent

    def begin(self) -> None:
        key = identity.fingerprint(identity.public_half(self._identity.key))
        self.send(
            link.Hello(
                version=PROTOCOL_VERSION,
                robot=self._identity.robot,
                key=key,
                encodings=ENCODINGS,
                agent=self._agent,
                functions=self.functions,
            )
        )

    def _on_challenge(self, message: link.Challenge) -> list[Event]:
        if message.relay != self._identity.relay:
            raise WrongRelay(
                f"the relay's name is '{message.relay}', but this robot was enrolled at '{self._identity.relay}'; "
                "nothing was signed. Check the address; enrol again if the relay is new"
            )
        nonce = link.from_base64(message.nonce, "nonce")
        if len(nonce) != identity.NONCE_BYTES:
            raise MalformedMessage(f"the relay's nonce has {len(nonce)} bytes, not {identity.NONCE_BYTES}")
        signature = identity.sign(self._identity.key, self._identity.relay, self._identity.robot, nonce)
        self.send(link.Prove(signature=link.to_base64(signature)))
        self.state = LinkState.PROVING
        return []

    def _on_welcome(self, message: link.Welcome) -> list[Event]:
        if not 0.05 <= message.heartbeat <= 3600:
            raise MalformedMessage(f"the heartbeat is {message.heartbeat} s; it must be 0.05 to 3600 s")
        self.state = LinkState.REGISTERED
        self.heartbeat = self.ping_every = message.heartbeat
        self._frames.limit = RELAY_JSON_FRAME
        return [Registered(message, self._identity.relay)]

    def _pass_on(self, message: link.Message) -> list[Event]:
        return [MessageReceived(message)]

    _table: ClassVar[Table] = {
        (LinkState.GREETING, link.Challenge): _on_challenge,
        (LinkState.PROVING, link.Welcome): _on_welcome,
        (LinkState.REGISTERED, link.OpenChannel): _pass_on,
        (LinkState.REGISTERED, link.CloseChannel): _pass_on,
        (LinkState.REGISTERED, link.OpenVideo): _pass_on,
        (LinkState.REGISTERED, link.CloseVideo): _pass_on,
        (LinkState.REGISTERED, link.ControlGrant): _pass_on,
        (LinkState.REGISTERED, link.Stop): _pass_on,
        (LinkState.REGISTERED, link.Resume): _pass_on,
        (LinkState.REGISTERED, link.Suppress): _pass_on,
        (LinkState.REGISTERED, link.Inhibit): _pass_on,
        (LinkState.REGISTERED, link.OrderModule): _pass_on,
        (LinkState.REGISTERED, link.ReadModuleLog): _pass_on,
        (LinkState.REGISTERED, link.MeasureProcesses): _pass_on,
        (LinkState.REGISTERED, link.OpenFileLink): _pass_on,
    }
    _decoders: ClassVar[dict[LinkState, msgspec.json.Decoder[Any]]] = {
        LinkState.GREETING: link.handshake_reply_decoder,
        LinkState.PROVING: link.handshake_reply_decoder,
        LinkState.REGISTERED: link.relay_control_decoder,
    }


_REQUESTS = tuple(
    (LinkState.OPEN, each) for each in get_args(link.RelayChannel) if each not in _IN_EVERY_STATE
)


class TicketLink(Link):
    """A link that is joined with a ticket.

    :param heartbeat: seconds, as agreed on the control link
    """

    ping_every = CHANNEL_PING_SECONDS
    parts = False
    """Whether samples in parts are accepted."""

    def __init__(self, ticket: str, clock: Callable[[], int], heartbeat: float) -> None:
        super().__init__(clock, heartbeat)
        self.state = LinkState.JOINING
        self._ticket = ticket
        self._joined_at = 0

    def begin(self) -> None:
        self._joined_at = self.clock()
        self.send(link.Join(version=PROTOCOL_VERSION, ticket=self._ticket, parts=self.parts))

    def _on_joined(self, message: link.Joined) -> list[Event]:
        self.offset.add(self._joined_at, message.at, self.clock())
        self.state = LinkState.OPEN
        self._frames.limit = RELAY_FRAME
        for _ in range(INITIAL_PINGS):
            self.ping()
        return [JoinedChannel(message.channel)]

    def _pass_on(self, message: link.Message) -> list[Event]:
        return [MessageReceived(message)]


class ChannelLink(TicketLink):
    """A link for one channel."""

    parts = True

    def __init__(self, ticket: str, clock: Callable[[], int], heartbeat: float) -> None:
        super().__init__(ticket, clock, heartbeat)
        self.window = SendWindow(UPLINK_TARGET)

    def _sample(self, frame: frames.Frame) -> list[Event]:
        if self.state is LinkState.OPEN and isinstance(frame, frames.CommandFrame):
            return [CommandReceived(frame)]
        if self.state is LinkState.OPEN and isinstance(frame, frames.SampleFrame):
            return [SampleReceived(frame)]
        return super()._sample(frame)

    _table: ClassVar[Table] = {
        (LinkState.JOINING, link.Joined): TicketLink._on_joined,
        **dict.fromkeys(_REQUESTS, TicketLink._pass_on),
    }
    _decoders: ClassVar[dict[LinkState, msgspec.json.Decoder[Any]]] = {
        LinkState.JOINING: link.handshake_reply_decoder,
        LinkState.OPEN: link.relay_channel_decoder,
    }


class VideoLink(TicketLink):
    """A link for one camera stream."""

    _table: ClassVar[Table] = {
        (LinkState.JOINING, link.Joined): TicketLink._on_joined,
        (LinkState.OPEN, link.FrameAck): TicketLink._pass_on,
        (LinkState.OPEN, link.RequestKeyFrame): TicketLink._pass_on,
    }
    _decoders: ClassVar[dict[LinkState, msgspec.json.Decoder[Any]]] = {
        LinkState.JOINING: link.handshake_reply_decoder,
        LinkState.OPEN: link.relay_video_decoder,
    }


class FileLink(TicketLink):
    """A link for uploads of files."""

    _table: ClassVar[Table] = {
        (LinkState.JOINING, link.Joined): TicketLink._on_joined,
        (LinkState.OPEN, link.ContinueFile): TicketLink._pass_on,
        (LinkState.OPEN, link.FileReceived): TicketLink._pass_on,
        (LinkState.OPEN, link.FileStored): TicketLink._pass_on,
        (LinkState.OPEN, link.FileRefused): TicketLink._pass_on,
    }
    _decoders: ClassVar[dict[LinkState, msgspec.json.Decoder[Any]]] = {
        LinkState.JOINING: link.handshake_reply_decoder,
        LinkState.OPEN: link.relay_files_decoder,
    }


class EnrolmentLink(Link):
    """A link that registers the robot's public key with a one-time code."""

    def __init__(self, request: link.Enroll, clock: Callable[[], int]) -> None:
        super().__init__(clock)
        self.state = LinkState.ENROLLING
        self._request = request

    def begin(self) -> None:
        self.send(self._request)

    def _on_enrolled(self, message: link.Enrolled) -> list[Event]:
        if message.robot != self._request.robot:
            raise MalformedMessage(f"the relay enrolled '{message.robot}' instead of '{self._request.robot}'")
        return [EnrolledAt(message)]

    _table: ClassVar[Table] = {(LinkState.ENROLLING, link.Enrolled): _on_enrolled}
    _decoders: ClassVar[dict[LinkState, msgspec.json.Decoder[Any]]] = {
        LinkState.ENROLLING: link.handshake_reply_decoder
    }
