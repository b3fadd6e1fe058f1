"""A client's websocket whose robot is at another relay: messages go there one by one, and frames come back as they are.

The robot's home pings the client through this relay, so it knows how old each message can be.
"""

from __future__ import annotations

import base64
import os
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any, Protocol

from autobahn.websocket.types import ConnectionRequest
from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.protocol import Protocol as TwistedProtocol
from twisted.internet.protocol import connectionDone
from twisted.python.failure import Failure

from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_protocol.limits import KIB
from relay_server.access import BadCredentials
from relay_server.cluster.forwarding import ForwardedClient, Forwarder, without_credentials
from relay_server.cluster.relays import CONFIRMING_PROTOCOL, RelayInfo, check_compatible, unreachable
from relay_server.common import close_codes
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.concurrency import with_timeout
from relay_server.common.send_queue import SendQueue
from relay_server.common.tcp import PushProducer
from relay_server.common.websocket_frames import BINARY, CLOSE, FIN, PING, PONG, TEXT, masked, parse_head
from relay_server.sessions.ports import ClientTransport

HEAD_BYTES = 16 * 1024
"""Most bytes of the head of the home's answer."""

OPEN_SECONDS = 5.0
"""Seconds in which the home must answer the handshake."""

MOST_PONGS = 16
"""Most answers to pings that wait for the end of a fragmented message; the newest count."""

PAUSED_SECONDS = 0.5
"""Seconds in which the home takes no bytes, after which the client is read again all the same: it may want to stop the
robot, which another way than by the home can do."""

PAUSED_BYTES = 64 * KIB
"""Bytes that are read of it then."""

UNSENT_BYTES = 4 << 20
"""When so many bytes were written while the home takes none, one more message closes the websocket. A single one may
be larger."""

_REFUSALS: dict[int, type[SwitchboardError]] = {
    400: Invalid,
    401: BadCredentials,
    403: NotFound,
    404: NotFound,
}
"""Errors for the statuses by which the home refuses a handshake; all others are :class:`Unavailable`."""


@dataclass(frozen=True)
class ForwardedHandshake:
    """The handshake of a client, as it is repeated to the robot's home.

    :param target: path and query, escaped, without tickets and tokens
    :param protocols: that the client offered
    :param origin: of a browser, or empty
    """

    target: str
    protocols: Sequence[str]
    origin: str

    @classmethod
    def of(cls, request: ConnectionRequest, target: str) -> ForwardedHandshake:
        """The handshake of a request, without its credentials.

        :param target: path and query as they came
        """
        protocols = [each for each in request.protocols if not each.startswith("bearer.")]
        return cls(without_credentials(target), protocols, request.origin or "")

    def request(self, host: str, fields: Mapping[str, str]) -> bytes:
        """The request for the websocket (RFC 6455 section 4.1).

        :param fields: more header fields
        """
        lines = [
            f"GET {self.target} HTTP/1.1",
            f"Host: {host}",
            "Connection: Upgrade",
            "Upgrade: websocket",
            "Sec-WebSocket-Version: 13",
            f"Sec-WebSocket-Key: {base64.b64encode(os.urandom(16)).decode()}",
        ]
        if self.protocols:
            lines.append(f"Sec-WebSocket-Protocol: {', '.join(self.protocols)}")
        if self.origin:
            lines.append(f"Origin: {self.origin}")
        lines += [f"{name}: {value}" for name, value in fields.items()]
        return "\r\n".join([*lines, "", ""]).encode("ascii", "replace")


class ForwardedWebSocket:
    """The handler of a websocket that is forwarded (:class:`~relay_server.ws.handshake.WebSocketHandler`).

    The client's own handshake is answered after the home's, so that no message is older than the home's session.

    :param earliest_sent: see there; the home decides by its own measurement
    """

    def __init__(
        self,
        clock: Clock,
        forwarder: Forwarder,
        relay: RelayInfo,
        robot_id: int,
        handshake: ForwardedHandshake,
        client: ForwardedClient,
        transport: ForwardedTransport,
        earliest_sent: int,
    ) -> None:
        self.robot_id = robot_id
        self.relay_id = relay.id
        self.send_queue = SendQueue(transport.send, clock.seconds, _nothing)
        self.earliest_sent = earliest_sent
        self._clock = clock
        self._forwarder = forwarder
        self._relay = relay
        self._handshake = handshake
        self._client = client
        self._transport = transport
        self._home: _HomeConnection | None = None
        self._pongs: list[bytes] = []
        """Answers to pings that came between the fragments of a message. They follow it, as they do not date it."""
        self._ended = False
        self._paused_bytes: int | None = None
        """Bytes sent to the home since it takes none; ``None``: it takes bytes."""
        self._paused_timer: Timer | None = None
        self.answers: list[bytes] = []
        """Frames of this relay that wait for the end of a message of the home."""
        self._opening: Deferred[None] = Deferred()
        self.on_message: Callable[[bytes, bool], object] = _ignore
        """Called with each message that was forwarded, and whether it is binary."""

    async def open(self) -> None:
        """Open the websocket to the home.

        :raises Unavailable: it can't be reached, or refuses
        """
        check_compatible(self._relay)
        connecting = Deferred.fromCoroutine(self._forwarder.open_stream(self._relay, _HomeConnection(self)))
        connecting.addErrback(self._not_connected)
        late = f"the relay that the robot is connected to did not answer in time ({self._relay.address})"
        try:
            await with_timeout(self._clock, OPEN_SECONDS, self._opening, late)
        except BaseException:
            connecting.cancel()
            self.end()
            raise

    def start(self) -> None:
        """The client's websocket is open: frames of the home may follow."""
        assert self._home is not None
        self._home.transport.registerProducer(PushProducer(_HomeFlow(self)), True)
        self._forwarder.websockets.add(self)
        self._home.start()

    def message(self, payload: bytes, *, earliest_sent: int | None = None) -> None:
        """Forward a text message."""
        self._send(masked(TEXT, payload))
        self.on_message(payload, False)

    def binary_message(self, payload: bytes, *, earliest_sent: int) -> None:
        """Forward a binary message."""
        self._send(masked(BINARY, payload))
        self.on_message(payload, True)

    @property
    def confirms(self) -> bool:
        """Whether the home can say what it has read."""
        return self._relay.protocol >= CONFIRMING_PROTOCOL

    async def confirm(self, seconds: float) -> bool:
        """Whether the home has read all messages; false if that is not known, see :meth:`SharedConnection.confirm`."""
        if self._ended or self._home is None:
            return False
        return bool(await self._home.transport.confirm(seconds))

    def answer(self, frame: bytes) -> None:
        """Send the client a frame of this relay, behind the message of the home of which it has a part already."""
        self.answers.append(frame)
        if self._home is not None and not (self._home.inside_frame or self._home.inside_message):
            self.send_answers()

    def send_answers(self) -> None:
        """The client has only whole messages of the home."""
        answers, self.answers = self.answers, []
        self.frames(b"".join(answers))

    def ping(self) -> None:
        """The home pings."""

    def client_ping(self, payload: bytes) -> None:
        """Forward a ping of the client; the home answers it."""
        self._send(masked(PING, payload))

    def pong(self, payload: bytes) -> None:
        """Forward the answer to a ping of the home."""
        frame = masked(PONG, payload)
        if self._transport.inside_message:
            self._pongs = [*self._pongs[1 - MOST_PONGS :], frame]
        else:
            self._send(frame)

    def pause(self) -> None:
        """The client does not read, so the home is not read either."""
        if self._home is not None:
            self._home.transport.pauseProducing()

    def resume(self) -> None:
        """Read the home again."""
        if self._home is not None:
            self._home.transport.resumeProducing()

    def close(self, code: int, reason: str) -> None:
        """Close the client's websocket, and end."""
        if self._home is not None and self._home.inside_frame:
            # A close frame would be taken for a part of that frame.
            self._transport.dropConnection(abort=True)
        elif self._home is not None and self._home.inside_message:
            # Only a control frame may follow a part of a message (RFC 6455 section 5.4).
            self._transport.close(code, reason, farewell=b"")
        else:
            self._transport.close(code, reason)
        self.end()

    def end(self, *, orderly: bool = False) -> None:
        """The client's websocket is closed."""
        if self._ended:
            return
        self._ended = True
        cancel(self._paused_timer)
        self._forwarder.websockets.discard(self)
        if self._home is None:
            return
        if orderly:
            self._home.transport.write(masked(CLOSE, struct.pack("!H", 1000)))
            self._home.transport.unregisterProducer()
            self._home.transport.loseConnection()
        else:
            self._home.transport.abortConnection()

    def _send(self, frame: bytes) -> None:
        if self._ended or self._home is None:
            return
        if self._paused_bytes is not None and self._paused_bytes > UNSENT_BYTES:
            self.close(close_codes.UNAVAILABLE, "the robot's relay takes no messages; connect again")
            return
        pongs, self._pongs = self._pongs, []
        self._home.transport.write(b"".join([frame, *pongs]))
        if self._paused_bytes is not None:
            self._paused_bytes += len(frame)
            if self._paused_bytes > PAUSED_BYTES:
                self._transport.pause_reading()

    # --- flow to the home ---------------------------------------------------------------------------------

    def home_paused(self) -> None:
        """The home takes no bytes, so the client is not read."""
        self._paused_bytes = 0
        self._transport.pause_reading()
        cancel(self._paused_timer)
        self._paused_timer = self._clock.callLater(PAUSED_SECONDS, self._read_paused)

    def _read_paused(self) -> None:
        if self._paused_bytes is not None and self._paused_bytes <= PAUSED_BYTES:
            self._transport.resume_reading()

    def home_resumed(self) -> None:
        """The home takes bytes again."""
        self._paused_bytes = None
        cancel(self._paused_timer)
        self._transport.resume_reading()

    # --- the home -----------------------------------------------------------------------------------------

    def connected(self, home: _HomeConnection) -> None:
        """The home accepts connections."""
        if self._ended:
            home.transport.abortConnection()
            return
        self._home = home
        fields = self._forwarder.headers(self._client)
        home.transport.write(self._handshake.request(self._relay.address, fields))

    def accepted(self) -> None:
        """The home has answered the handshake. Its frames wait for :meth:`start`."""
        if not self._opening.called:
            self._opening.callback(None)

    def refused(self, status: int) -> None:
        """The home has refused the handshake."""
        words = HTTPStatus(status).phrase if status in HTTPStatus._value2member_map_ else "refused"
        self._fail(
            f"the relay that the robot is connected to answered {status} {words}",
            _REFUSALS.get(status, Unavailable),
        )

    def frames(self, data: bytes) -> None:
        """Bytes of frames for the client."""
        if not self._ended:
            self._transport.send(data)

    def closed(self, code: int, reason: str) -> None:
        """The home closes the websocket. What it has to say to the client before that was forwarded."""
        if not self._opening.called:
            self._fail(reason)
        elif not self._ended:
            self._transport.close(code, reason, farewell=b"")
            self.end()

    def lost(self) -> None:
        """The home is gone."""
        reason = "the connection to the robot's relay is lost; connect again"
        if not self._opening.called:
            self._fail(reason)
        elif not self._ended:
            self.close(close_codes.UNAVAILABLE, reason)

    def _fail(self, reason: str, kind: type[SwitchboardError] = Unavailable) -> None:
        if not self._opening.called:
            self._opening.errback(kind(reason))

    def _not_connected(self, failure: Failure) -> None:
        if failure.check(SwitchboardError):
            self._fail(str(failure.value))
        elif not failure.check(CancelledError):
            self._fail(str(unreachable(self._relay)))


class ForwardedTransport(ClientTransport, Protocol):
    """The websocket of the client."""

    def pause_reading(self) -> None:
        """Read nothing more from the client."""

    def resume_reading(self) -> None:
        """Read the client again."""

    def dropConnection(self, abort: bool = False) -> None:
        """End the connection without a close frame."""

    inside_message: bool
    """Whether some fragments of a message have come, and not all."""


class _HomeFlow:
    """The flow of bytes to the home."""

    def __init__(self, session: ForwardedWebSocket) -> None:
        self.pause = session.home_paused
        self.resume = session.home_resumed


class _HomeConnection(TwistedProtocol):
    """The connection to the home: the head of its answer, then frames. Only the last one, a close frame, is read."""

    transport: Any
    whole = b""
    """Bytes that were whole messages when the client before got them. Many clients of a topic get the same object."""

    def __init__(self, client: ForwardedWebSocket) -> None:
        self._accepted = False
        self._started = False
        self._client = client
        self._head = b""
        self._unparsed = b""
        self._left = 0
        """Bytes that are left of the frame whose head was passed on."""
        self.inside_message = False
        """Whether the client has some fragments of a message, and not all."""

    @property
    def inside_frame(self) -> bool:
        """Whether the client has a part of a frame."""
        return self._left > 0

    def connectionMade(self) -> None:
        self._client.connected(self)

    def dataReceived(self, data: bytes) -> None:
        if self._started:
            self._frames(data)
            return
        self._head += data
        if self._accepted:
            return
        head, end, rest = self._head.partition(b"\r\n\r\n")
        if not end:
            if len(self._head) > HEAD_BYTES:
                self._client.refused(HTTPStatus.BAD_GATEWAY)
            return
        status = head.split(b" ", 2)[1:2]
        if status != [b"101"]:
            self._client.refused(int(status[0]) if status and status[0].isdigit() else HTTPStatus.BAD_GATEWAY)
            return
        self._accepted = True
        self._head = rest
        self.transport.pauseProducing()
        self._client.accepted()

    def start(self) -> None:
        """Pass frames on from now on."""
        self._started = True
        rest, self._head = self._head, b""
        self.transport.resumeProducing()
        # They may pause it again.
        self._frames(rest)

    def _frames(self, data: bytes) -> None:
        """Pass frames on, and stop at a close frame."""
        if data is _HomeConnection.whole and not (self._left or self._unparsed or self.inside_message):
            self._client.frames(data)
            return
        came = data
        data = self._unparsed + data
        fragments, within = False, self._left or self._unparsed
        at, size = min(self._left, len(data)), len(data)
        self._left -= at
        while at < size:
            head = parse_head(data, at)
            if head is None:
                break
            first, length, start = head
            if first == CLOSE:
                if start + length > size:
                    break
                self._client.frames(data[:at])
                self._closed(data[start : start + length])
                return
            if first & 15 < CLOSE & 15:
                fragments = fragments or not first & FIN or not first & 15
                self.inside_message = not first & FIN
            end = start + length
            self._left = max(0, end - size)
            at = min(end, size)
        self._unparsed = data[at:]
        if not (within or fragments or self._left or self._unparsed):
            _HomeConnection.whole = came
        if at:
            self._client.frames(data[:at])
        if self._client.answers and not (self._left or self.inside_message):
            self._client.send_answers()

    def _closed(self, payload: bytes) -> None:
        code = int.from_bytes(payload[:2], "big") if len(payload) > 1 else 1000
        self._client.closed(code, payload[2:].decode("utf-8", "replace"))

    def connectionLost(self, reason: Failure = connectionDone) -> None:
        self._client.lost()


def _nothing() -> None:
    """Nothing waits in the queue of a forwarded websocket."""


def _ignore(payload: bytes, binary: bool) -> None:
    """No message is looked at."""
