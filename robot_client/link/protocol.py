"""Robot links without sockets: bytes in, events and bytes out.

A control link goes greeting → proving → registered, one for a channel or for pictures joining → open, an enrolment asks
once. What may be said when is a table in each class; everything else breaks the contract. The edge is
:mod:`robot_client.link.transport`.
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
    COMMAND_FRAME,
    HANDSHAKE_FRAME,
    HEARTBEAT_SECONDS,
    HEARTBEATS_MISSED,
    ROBOT_MESSAGE,
)
from relay_protocol.pacing import SendWindow
from robot_client.link.clock_offset import ClockOffset

NANO = 1_000_000_000
ENCODINGS = ["cdr"]
QUICK_PINGS = 3
CHANNEL_PING_SECONDS = 1.0
UPLINK_TARGET = 0.2
"""Seconds samples may wait in the network before the relay has them. No command waits behind them."""


class LinkState(enum.Enum):
    """Where a link stands."""

    GREETING = "greeting"
    PROVING = "proving"
    REGISTERED = "registered"
    ENROLLING = "enrolling"
    JOINING = "joining"
    OPEN = "open"


class Registered(NamedTuple):
    """The relay knows us now."""

    welcome: link.Welcome
    relay: str


class JoinedChannel(NamedTuple):
    """The channel or the stream of pictures stands.

    :param channel: its name
    """

    channel: str


class EnrolledAt(NamedTuple):
    """The relay took our public key."""

    enrolled: link.Enrolled


class MessageReceived(NamedTuple):
    """A message for the owner of the link."""

    message: link.Message


class SampleReceived(NamedTuple):
    """A topic sample from the relay."""

    frame: frames.SampleFrame


class CommandReceived(NamedTuple):
    """A command from the relay, to what moves the robot."""

    frame: frames.CommandFrame


class LinkEnded(NamedTuple):
    """The relay closes the link on purpose."""

    reason: str


Event = (
    Registered | JoinedChannel | EnrolledAt | MessageReceived | SampleReceived | CommandReceived | LinkEnded
)


class RelayRefused(Refused):
    """The relay said no.

    :param retry_after: seconds, ``None`` when only a person can help
    """

    def __init__(self, message: link.Refused) -> None:
        super().__init__(message.reason)
        self.relay_code = message.code
        self.retry_after = message.retry_after


class WrongRelay(Refused):
    """The other end is not the relay this robot was enrolled at."""


class LinkSilent(PeerError):
    """Nothing was heard for three heartbeats."""


class Identity(NamedTuple):
    """Who a robot is, to one relay.

    :param key: private Ed25519 key, 32 raw bytes
    """

    robot: str
    relay: str
    key: bytes


Handler = Callable[[Any, Any], "list[Event]"]
Table = dict[tuple[LinkState, type], Handler]


class Link(ABC):
    """What all links share: frames, pings, silence.

    :param clock: own monotonic clock, nanoseconds
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
        """How much may be on its way to the relay, where that is limited."""
        self.unsaid: list[bytes] = []
        """What :meth:`take` gives."""
        self._heard = clock()

    @abstractmethod
    def begin(self) -> None:
        """The connection stands; say the first word."""

    def say(self, message: link.Message) -> None:
        """Queue one message."""
        self.unsaid.append(link.frame(message))

    def take(self) -> list[bytes]:
        """What is to be written now."""
        out, self.unsaid = self.unsaid, []
        return out

    def ping(self, full: bool = False) -> None:
        """Ask the relay for its clock.

        :param full: whether samples wait for the window
        """
        now = self.clock()
        if self.window is not None:
            self.window.probe(now, now / NANO, full=full)
        self.say(link.Ping(t=now))

    def check_silence(self) -> None:
        """Hold the link to its heartbeats.

        :raises LinkSilent: nothing came for three of them
        """
        silent = (self.clock() - self._heard) / NANO
        if silent > self.heartbeat * HEARTBEATS_MISSED:
            raise LinkSilent(f"the relay has been silent for {silent:.1f} s")

    def receive(self, data: bytes) -> list[Event]:
        """Take bytes off the wire.

        :raises PeerError: the relay broke the contract
        :raises RelayRefused: the relay said no
        :raises WrongRelay: it is not the relay we know
        """
        self._heard = self.clock()
        events: list[Event] = []
        for frame in self._frames.feed(data):
            events += self._frame(frame)
        return events

    def _frame(self, frame: frames.Frame) -> list[Event]:
        if not isinstance(frame, frames.JsonFrame):
            return self._sample(frame)
        message = jsontext.decode(self._decoders[self.state], frame.body)
        handler = self._table.get((self.state, type(message))) or _EVERYWHERE.get(type(message))
        if handler is None:
            said = link.lower_tag(type(message).__name__)
            raise MalformedMessage(f"the relay said '{said}' while this link was {self.state.value}")
        return handler(self, message)

    def _sample(self, frame: frames.Frame) -> list[Event]:
        raise MalformedMessage(
            f"the relay sent a {type(frame).__name__} while this link was {self.state.value}"
        )

    def _on_ping(self, message: link.Ping) -> list[Event]:
        self.say(link.Pong(t=message.t, at=self.clock()))
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


_EVERYWHERE: dict[type, Handler] = {
    link.Ping: Link._on_ping,
    link.Pong: Link._on_pong,
    link.Bye: Link._on_bye,
    link.Refused: Link._on_refused,
}


class ControlLink(Link):
    """The link that registers the robot.

    :param me: name, relay and key of this robot
    :param agent: software and version, for people
    """

    def __init__(self, me: Identity, agent: str, clock: Callable[[], int]) -> None:
        super().__init__(clock)
        self.state = LinkState.GREETING
        self._me = me
        self._agent = agent

    def begin(self) -> None:
        key = identity.fingerprint(identity.public_half(self._me.key))
        self.say(
            link.Hello(
                version=PROTOCOL_VERSION,
                robot=self._me.robot,
                key=key,
                encodings=ENCODINGS,
                agent=self._agent,
            )
        )

    def _on_challenge(self, message: link.Challenge) -> list[Event]:
        if message.relay != self._me.relay:
            raise WrongRelay(
                f"the relay calls itself '{message.relay}', but this robot was enrolled at '{self._me.relay}'; "
                "nothing was signed. Check the address; enrol again if the relay is new"
            )
        nonce = link.from_base64(message.nonce, "nonce")
        if len(nonce) != identity.NONCE_BYTES:
            raise MalformedMessage(f"the relay's nonce has {len(nonce)} bytes, not {identity.NONCE_BYTES}")
        signature = identity.sign(self._me.key, self._me.relay, self._me.robot, nonce)
        self.say(link.Prove(signature=link.to_base64(signature)))
        self.state = LinkState.PROVING
        return []

    def _on_welcome(self, message: link.Welcome) -> list[Event]:
        if not 0.05 <= message.heartbeat <= 3600:
            raise MalformedMessage(f"a heartbeat of {message.heartbeat} s can't be kept")
        self.state = LinkState.REGISTERED
        self.heartbeat = self.ping_every = message.heartbeat
        self._frames.limit = COMMAND_FRAME
        return [Registered(message, self._me.relay)]

    def _on_order(self, message: link.Message) -> list[Event]:
        return [MessageReceived(message)]

    _table: ClassVar[Table] = {
        (LinkState.GREETING, link.Challenge): _on_challenge,
        (LinkState.PROVING, link.Welcome): _on_welcome,
        (LinkState.REGISTERED, link.OpenChannel): _on_order,
        (LinkState.REGISTERED, link.CloseChannel): _on_order,
        (LinkState.REGISTERED, link.OpenVideo): _on_order,
        (LinkState.REGISTERED, link.CloseVideo): _on_order,
        (LinkState.REGISTERED, link.Control): _on_order,
        (LinkState.REGISTERED, link.Stop): _on_order,
        (LinkState.REGISTERED, link.Resume): _on_order,
        (LinkState.REGISTERED, link.Suppress): _on_order,
        (LinkState.REGISTERED, link.Inhibit): _on_order,
    }
    _decoders: ClassVar[dict[LinkState, msgspec.json.Decoder[Any]]] = {
        LinkState.GREETING: link.opening_reply_decoder,
        LinkState.PROVING: link.opening_reply_decoder,
        LinkState.REGISTERED: link.relay_control_decoder,
    }


_REQUESTS = tuple((LinkState.OPEN, each) for each in get_args(link.RelayChannel) if each not in _EVERYWHERE)


class TicketLink(Link):
    """A link that is joined by ticket.

    :param heartbeat: seconds between pings, as the control link agreed
    """

    ping_every = CHANNEL_PING_SECONDS
    parts = False
    """Whether samples in parts are taken."""

    def __init__(self, ticket: str, clock: Callable[[], int], heartbeat: float) -> None:
        super().__init__(clock, heartbeat)
        self.state = LinkState.JOINING
        self._ticket = ticket
        self._asked = 0

    def begin(self) -> None:
        self._asked = self.clock()
        self.say(link.Join(version=PROTOCOL_VERSION, ticket=self._ticket, parts=self.parts))

    def _on_joined(self, message: link.Joined) -> list[Event]:
        self.offset.add(self._asked, message.at, self.clock())
        self.state = LinkState.OPEN
        self._frames.limit = ROBOT_MESSAGE
        for _ in range(QUICK_PINGS):
            self.ping()
        return [JoinedChannel(message.channel)]

    def _on_request(self, message: link.Message) -> list[Event]:
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
        **dict.fromkeys(_REQUESTS, TicketLink._on_request),
    }
    _decoders: ClassVar[dict[LinkState, msgspec.json.Decoder[Any]]] = {
        LinkState.JOINING: link.opening_reply_decoder,
        LinkState.OPEN: link.relay_channel_decoder,
    }


class VideoLink(TicketLink):
    """A link for one stream of pictures."""

    _table: ClassVar[Table] = {
        (LinkState.JOINING, link.Joined): TicketLink._on_joined,
        (LinkState.OPEN, link.Took): TicketLink._on_request,
        (LinkState.OPEN, link.KeyFrame): TicketLink._on_request,
    }
    _decoders: ClassVar[dict[LinkState, msgspec.json.Decoder[Any]]] = {
        LinkState.JOINING: link.opening_reply_decoder,
        LinkState.OPEN: link.relay_video_decoder,
    }


class EnrolmentLink(Link):
    """Hands in the public key with a code of one use."""

    def __init__(self, request: link.Enroll, clock: Callable[[], int]) -> None:
        super().__init__(clock)
        self.state = LinkState.ENROLLING
        self._request = request

    def begin(self) -> None:
        self.say(self._request)

    def _on_enrolled(self, message: link.Enrolled) -> list[Event]:
        if message.robot != self._request.robot:
            raise MalformedMessage(f"the relay enrolled '{message.robot}' instead of '{self._request.robot}'")
        return [EnrolledAt(message)]

    _table: ClassVar[Table] = {(LinkState.ENROLLING, link.Enrolled): _on_enrolled}
    _decoders: ClassVar[dict[LinkState, msgspec.json.Decoder[Any]]] = {
        LinkState.ENROLLING: link.opening_reply_decoder
    }
