"""A real websocket client (sans-io) on a transport in memory, and a gate that lets it in."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.task import Clock
from twisted.internet.testing import StringTransportWithDisconnection
from websockets.client import ClientProtocol
from websockets.exceptions import InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.http11 import Response
from websockets.uri import parse_uri

from relay_protocol.errors import NotFound, Refused, Unavailable
from relay_server.access import BadCredentials, Principal
from relay_server.auth.authenticator import TicketPurpose
from relay_server.common.send_queue import SendQueue
from relay_server.http.limits import ConnectionLimits, RequestLimits
from relay_server.ws.connection import ClientFactory

ANN = Principal(1, "ann", "main", False, 1, None)
AUTH = '{"op":"auth","mac":"good"}'


class MemorySession:
    """A session that records its calls."""

    def __init__(self, transport: Any) -> None:
        self.transport = transport
        self.send_queue = SendQueue(transport.send, lambda: 0.0, lambda: None)
        self.got: list[Any] = []
        self.earliest_sent = 0
        self.earliest_sent_given: list[int | None] = []

    def start(self) -> None:
        """The client is connected."""
        self.got.append("start")

    def message(self, payload: bytes, earliest_sent: int | None = None) -> None:
        """One message."""
        self.got.append(payload)
        self.earliest_sent_given.append(earliest_sent)

    def ping(self) -> None:
        """Sends a ping to measure the age of sent messages."""
        self.pings = getattr(self, "pings", 0) + 1
        self.transport.ping(b"probe %d" % self.pings)

    def pong(self, payload: bytes) -> None:
        """A pong, for a ping sent one second after the one before."""
        self.earliest_sent += 1_000_000_000
        self.got.append(("pong", payload))

    def pause(self) -> None:
        self.got.append("pause")

    def resume(self) -> None:
        self.got.append("resume")

    def end(self, *, orderly: bool = False) -> None:
        if "end" not in self.got:
            self.got.append("end")
            self.orderly = orderly

    def close(self, code: int, reason: str) -> None:
        """As a session does."""
        self.transport.close(code, reason)
        self.end()


class MemoryGate:
    """Accepts the credential ``good``, for the robot ``rover``; the test may delay it."""

    def __init__(self) -> None:
        self.accepting = True
        self.asked: list[Any] = []
        self.sessions: list[MemorySession] = []
        self.admitted = 0
        self.wait: Deferred[None] | None = None

    async def _prove(self, *asked: Any) -> Principal:
        self.asked.append(asked)
        if self.wait is not None:
            await self.wait
        if "good" not in asked:
            raise BadCredentials("the access token is unknown, expired or revoked")
        return ANN

    async def bearer(self, token: str) -> Principal:
        """An access token."""
        return await self._prove("bearer", token)

    async def ticket(self, ticket: str, purpose: TicketPurpose) -> Principal:
        """Checks a ticket."""
        return await self._prove("ticket", ticket, purpose)

    async def url_token(self, token: str, address: str) -> Principal:
        """Checks a token in the URL."""
        return await self._prove("url token", token)

    async def cookie(self, header: str, origin: str | None, host: str) -> Principal | None:
        """Checks a cookie."""
        if not header:
            return None
        if origin is None:
            raise Refused("a session cookie counts only with an Origin header")
        return await self._prove("cookie", header)

    async def admit(self, principal: Principal, robot: str, address: str) -> Any:
        """A robot."""
        if robot == "broken":
            raise RuntimeError("the secret of our insides")
        if robot == "away":
            raise Unavailable("the database does not answer")
        if robot != "rover":
            raise NotFound("there is no such robot, or you have no right on it")
        self.admitted += 1
        return principal

    def open(self, admission: Any, transport: Any, opened_ns: int) -> MemorySession:
        """A session."""
        self.admitted -= 1
        self.sessions.append(MemorySession(transport))
        return self.sessions[-1]

    def release(self, admission: Any) -> None:
        """The client left before."""
        self.admitted -= 1


class Transport(StringTransportWithDisconnection):
    """TCP in memory; like TLS it does not close while a producer is registered.

    :attr stuck: whether it has unsent bytes that the client does not read
    """

    stuck = False

    def __init__(self) -> None:
        super().__init__()
        # Twisted's HTTP channel is the producer when a websocket takes over.
        self.registerProducer(object(), True)

    def setTcpNoDelay(self, on: bool) -> None:
        """As TCP."""

    def loseConnection(self) -> None:
        """Closes, unless a producer still holds it, or bytes are unsent."""
        if self.connected and self.producer is None and not self.stuck:
            super().loseConnection()

    def unregisterProducer(self) -> None:
        """As TCP, which ignores a missing producer."""
        self.producer = None

    def abortConnection(self) -> None:
        """Closes at once."""
        if self.connected:
            super().loseConnection()


class Client:
    """A websocket client and the relay's side of it.

    :param tail: bytes sent in one piece with the handshake
    :param factory: of the relay's side
    """

    def __init__(
        self,
        gate: Any,
        path: str = "/robots/rover",
        tail: bytes = b"",
        cap: ConnectionLimits | None = None,
        clock: Clock | None = None,
        factory: type[ClientFactory] = ClientFactory,
        request_limits: RequestLimits | None = None,
        **headers: str,
    ) -> None:
        self.eof = False
        self.clock = clock or Clock()
        self.cap = cap or ConnectionLimits(5)
        self.cap.enter("192.168.1.1")
        counted = request_limits or RequestLimits(0.0, self.clock.seconds)
        made = factory(self.clock, lambda: round(self.clock.seconds() * 1e9), gate, gate, self.cap, counted)
        self.transport = Transport()
        protocols = headers.pop("subprotocol").split(", ") if "subprotocol" in headers else None
        address = parse_uri(f"ws://relay:9090{path}")
        self.core = ClientProtocol(address, subprotocols=protocols, max_size=None)  # type: ignore[arg-type]
        self.end = made.buildProtocol(None)
        self.transport.protocol = self.end
        self.end.makeConnection(self.transport)
        request = self.core.connect()
        for name, value in headers.items():
            request.headers[name] = value
        self.core.send_request(request)
        self.core.writes.append(tail)
        self.run()

    def run(self) -> None:
        """Carries bytes in both directions until there are none."""
        while True:
            out = b"".join(self.core.data_to_send())
            back = self.transport.value()
            self.transport.clear()
            if not out and not back:
                break
            if out and self.transport.connected:
                self.end.dataReceived(out)
            # A real transport sends nothing after its end.
            if back and not self.eof:
                self.core.receive_data(back)
        if not self.transport.connected and not self.eof:
            self.eof = True
            self.core.receive_eof()

    def says(self, text: str) -> None:
        """Sends a text message."""
        self.core.send_text(text.encode())
        self.run()

    @property
    def status(self) -> int:
        """The status of the handshake."""
        refused = self.core.handshake_exc
        if isinstance(refused, InvalidStatus):
            return refused.response.status_code
        assert refused is None
        return next(event.status_code for event in self._events() if isinstance(event, Response))

    def _events(self) -> list[Any]:
        self.seen = [*getattr(self, "seen", []), *self.core.events_received()]
        return self.seen

    @property
    def heard(self) -> list[bytes]:
        """Text messages so far; those in several frames are joined."""
        found: list[bytes] = []
        part = b""
        for each in self._events():
            if isinstance(each, Frame) and each.opcode in (Opcode.TEXT, Opcode.CONT):
                part += bytes(each.data)
                if each.fin:
                    found.append(part)
                    part = b""
        return found

    @property
    def frames(self) -> list[Frame]:
        """All frames so far, unchanged."""
        return [each for each in self._events() if isinstance(each, Frame)]

    @property
    def pongs(self) -> list[bytes]:
        """Payloads of pongs so far."""
        return [
            bytes(each.data)
            for each in self._events()
            if isinstance(each, Frame) and each.opcode is Opcode.PONG
        ]

    @property
    def closed(self) -> int | None:
        """The close code, when the relay has closed."""
        return self.core.close_rcvd.code if self.core.close_rcvd else None
