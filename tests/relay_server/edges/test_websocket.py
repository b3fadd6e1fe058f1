"""The edge towards clients: a real websocket client (sans-io) on a transport in memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from twisted.internet.defer import Deferred
from twisted.internet.error import ConnectionDone
from twisted.internet.task import Clock
from twisted.internet.testing import StringTransportWithDisconnection
from twisted.python.failure import Failure
from websockets.client import ClientProtocol
from websockets.exceptions import InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.http11 import Response
from websockets.uri import parse_uri

from relay_protocol import limits
from relay_protocol.errors import NotFound, Refused, Unavailable
from relay_server import closing
from relay_server.access import BadCredentials, Principal
from relay_server.edges.caps import AddressCap
from relay_server.edges.websocket import ClientFactory

ANN = Principal(1, "ann", "main", False, 1, None)
AUTH = '{"op":"auth","mac":"good"}'


class MemorySession:
    """A session that notes what it is given."""

    def __init__(self, transport: Any) -> None:
        self.transport = transport
        self.got: list[Any] = []

    def start(self) -> None:
        """The client is in."""
        self.got.append("start")

    def message(self, payload: bytes) -> None:
        """One message."""
        self.got.append(payload)

    def pong(self, payload: bytes) -> None:
        """A pong."""
        self.got.append(("pong", payload))

    def pause(self) -> None:
        """Full."""
        self.got.append("pause")

    def resume(self) -> None:
        """Not full any more."""
        self.got.append("resume")

    def end(self) -> None:
        """Gone."""
        self.got.append("end")

    def close(self, code: int, reason: str) -> None:
        """As a session does."""
        self.transport.close(code, reason)
        self.end()


class MemoryGate:
    """Lets in whoever says ``good``, to the robot ``rover``; the test may hold it up."""

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

    async def ticket(self, ticket: str, robot: str) -> Principal:
        """A ticket."""
        return await self._prove("ticket", ticket, robot)

    async def cookie(self, header: str, origin: str | None, host: str) -> Principal | None:
        """A cookie."""
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

    def turn_away(self, admission: Any) -> None:
        """Left before."""
        self.admitted -= 1


class Transport(StringTransportWithDisconnection):
    """TCP in memory; like TLS it does not close while a producer is registered."""

    def __init__(self) -> None:
        super().__init__()
        # Twisted's HTTP channel is the producer when a websocket takes over.
        self.registerProducer(object(), True)

    def setTcpNoDelay(self, on: bool) -> None:
        """As TCP."""

    def loseConnection(self) -> None:
        """Close, unless a producer still holds it."""
        if self.connected and self.producer is None:
            super().loseConnection()

    def unregisterProducer(self) -> None:
        """As TCP, which does not mind when there is none."""
        self.producer = None

    def abortConnection(self) -> None:
        """Close at once."""
        if self.connected:
            super().abortConnection()


class Client:
    """A websocket client and the relay's end of it."""

    def __init__(self, gate: MemoryGate, path: str = "/robots/rover", **headers: str) -> None:
        self.eof = False
        self.clock = Clock()
        self.cap = AddressCap(5)
        self.cap.enter("192.168.1.1")
        factory = ClientFactory(self.clock, lambda: round(self.clock.seconds() * 1e9), gate, self.cap)
        self.transport = Transport()
        protocols = [headers.pop("subprotocol")] if "subprotocol" in headers else None
        self.core = ClientProtocol(parse_uri(f"ws://relay:9090{path}"), subprotocols=protocols)  # type: ignore[arg-type]
        self.end = factory.buildProtocol(None)
        self.transport.protocol = self.end
        self.end.makeConnection(self.transport)
        request = self.core.connect()
        for name, value in headers.items():
            request.headers[name] = value
        self.core.send_request(request)
        self.run()

    def run(self) -> None:
        """Carry bytes both ways until there are none."""
        while True:
            out = b"".join(self.core.data_to_send())
            back = self.transport.value()
            self.transport.clear()
            if not out and not back:
                break
            if out and self.transport.connected:
                self.end.dataReceived(out)
            if back:
                self.core.receive_data(back)
        if not self.transport.connected and not self.eof:
            self.eof = True
            self.core.receive_eof()

    def says(self, text: str) -> None:
        """One text message."""
        self.core.send_text(text.encode())
        self.run()

    @property
    def status(self) -> int:
        """Of the handshake."""
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
        """Text messages so far."""
        return [
            bytes(each.data)
            for each in self._events()
            if isinstance(each, Frame) and each.opcode is Opcode.TEXT
        ]

    @property
    def closed(self) -> int | None:
        """The close code, when the relay has closed."""
        return self.core.close_rcvd.code if self.core.close_rcvd else None


@pytest.fixture
def gate() -> MemoryGate:
    """Open for business."""
    return MemoryGate()


@pytest.mark.parametrize(
    ("path", "headers", "asked"),
    [
        ("/robots/rover", {"Authorization": "Bearer good"}, ("bearer", "good")),
        ("/robots/rover", {"Authorization": "bearer  good "}, ("bearer", "good")),
        ("/robots/rover", {"subprotocol": "bearer.good"}, ("bearer", "good")),
        ("/robots/rover?ticket=good", {}, ("ticket", "good", "rover")),
        ("/robots/rover", {"Cookie": "good", "Origin": "http://relay:9090"}, ("cookie", "good")),
        ("/robots/rover?ticket=bad", {"Authorization": "Bearer good"}, ("bearer", "good")),
        ("/robots/%72over", {"Authorization": "Bearer good"}, ("bearer", "good")),
    ],
)
def test_credentials_of_the_handshake_let_a_client_in(
    gate: MemoryGate, path: str, headers: dict[str, str], asked: Any
) -> None:
    """Header, subprotocol (selected in the answer), ticket, cookie with Origin; in this order."""
    client = Client(gate, path, **headers)
    assert client.status == 101
    assert client.core.subprotocol == headers.get("subprotocol")
    assert gate.asked == [asked]
    client.says('{"op":"x"}')
    assert gate.sessions[0].got == ["start", b'{"op":"x"}']
    client.clock.advance(limits.UNPROVEN_SECONDS * 2)
    assert client.closed is None


@pytest.mark.parametrize(
    ("path", "headers", "status", "code"),
    [
        ("/robots/rover", {"Authorization": "Bearer bad"}, 401, closing.UNAUTHENTICATED),
        ("/robots/rover?ticket=bad", {}, 401, closing.UNAUTHENTICATED),
        ("/robots/tank", {"Authorization": "Bearer good"}, 403, closing.NOT_FOUND),
        ("/robots/away", {"Authorization": "Bearer good"}, 503, closing.UNAVAILABLE),
    ],
)
def test_a_refused_program_reads_a_status_and_a_browser_a_close_code(
    gate: MemoryGate, path: str, headers: dict[str, str], status: int, code: int
) -> None:
    """Browsers can't read the status of a handshake."""
    assert Client(gate, path, **headers).status == status
    browser = Client(gate, path, Origin="http://relay:9090", **headers)
    assert (browser.status, browser.closed) == (101, code)
    assert not gate.sessions
    assert not browser.transport.connected


def test_a_cookie_without_an_origin_is_worth_nothing(gate: MemoryGate) -> None:
    """Whatever it says."""
    assert Client(gate, Cookie="good").status == 403
    assert not gate.asked


def test_a_relay_that_is_going_down_lets_nobody_in(gate: MemoryGate) -> None:
    """A program may try again elsewhere."""
    gate.accepting = False
    assert Client(gate, Authorization="Bearer good").status == 503


def test_auth_may_be_the_first_message(gate: MemoryGate) -> None:
    """What follows it while the token is looked up is kept in order."""
    gate.wait = Deferred()
    client = Client(gate)
    for text in (AUTH, "a", "b"):
        client.says(text)
    assert not gate.sessions
    gate.wait.callback(None)
    client.says("c")
    assert gate.sessions[0].got == ["start", b"a", b"b", b"c"]
    client.clock.advance(limits.UNPROVEN_SECONDS * 2)
    assert client.closed is None


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ('{"op":"auth","mac":"bad"}', closing.UNAUTHENTICATED),
        ('{"op":"subscribe","topic":"/x"}', closing.UNAUTHENTICATED),
        ("junk", closing.UNAUTHENTICATED),
        ("x" * (limits.UNPROVEN_BYTES + 1), closing.TOO_BIG),
    ],
)
def test_any_other_first_message_ends_the_connection(gate: MemoryGate, text: str, code: int) -> None:
    """Nothing is served before it is known to whom."""
    client = Client(gate)
    client.says(text)
    assert client.closed == code
    assert not client.transport.connected
    assert not gate.sessions


def test_who_says_nothing_is_closed_by_an_absolute_deadline(gate: MemoryGate) -> None:
    """Pings buy no time."""
    client = Client(gate)
    for _ in range(99):
        client.clock.advance(0.1)
        client.core.send_ping(b"x")
        client.run()
    assert client.closed is None
    client.clock.advance(0.2)
    client.run()
    assert client.closed == closing.UNAUTHENTICATED


@pytest.mark.parametrize("size", [0, 1000])
def test_what_waits_for_the_proof_is_bounded(gate: MemoryGate, size: int) -> None:
    """Empty messages take memory too."""
    gate.wait = Deferred()
    client = Client(gate)
    client.says(AUTH)
    for _ in range(limits.UNPROVEN_BYTES // 64):
        if client.transport.connected:
            client.core.send_text(b"x" * size)
            client.run()
    assert client.closed == closing.TOO_BIG


def test_a_fault_of_ours_is_told_without_internals(gate: MemoryGate) -> None:
    """The log tells more."""
    client = Client(gate, "/robots/broken")
    client.says(AUTH)
    assert client.closed == closing.INTERNAL
    assert client.core.close_rcvd is not None
    assert "insides" not in client.core.close_rcvd.reason


@pytest.mark.parametrize("how", ["handshake", "auth"])
def test_who_leaves_while_the_proof_is_looked_up_leaves_nothing_behind(gate: MemoryGate, how: str) -> None:
    """No session on a dead connection, no place that is never given back."""
    gate.wait = Deferred()
    client = Client(gate, **({"Authorization": "Bearer good"} if how == "handshake" else {}))
    if how == "auth":
        client.says(AUTH)
    client.transport.connected = False
    client.end.connectionLost(Failure(ConnectionDone()))
    gate.wait.callback(None)
    assert not gate.sessions
    assert gate.admitted == 0
    assert not client.cap._counts


def test_a_binary_message_ends_the_session(gate: MemoryGate) -> None:
    """With 4403, and the session takes nothing more."""
    client = Client(gate, Authorization="Bearer good")
    client.core.send_binary(b"x")
    client.run()
    assert client.closed == closing.FORBIDDEN
    assert gate.sessions[0].got[:2] == ["start", "end"]


def test_samples_for_a_client_that_is_closing_are_let_go(gate: MemoryGate) -> None:
    """They come from a robot that serves others: nothing may break there."""
    client = Client(gate, Authorization="Bearer good")
    send: Callable[[bytes], None] = gate.sessions[0].transport.send
    send(b'{"n":1}')
    client.transport.loseConnection = lambda: None  # type: ignore[method-assign]
    client.core.send_close(1000)
    client.run()
    send(b'{"n":2}')
    client.transport.connected = False
    client.end.connectionLost(Failure(ConnectionDone()))
    send(b'{"n":3}')
    assert client.heard == [b'{"n":1}']
    assert gate.sessions[0].got == ["start", "end"]


def test_the_transports_pauses_reach_the_session(gate: MemoryGate) -> None:
    """And pongs do, as they were sent."""
    client = Client(gate, Authorization="Bearer good")
    flow = client.transport.producer
    flow.pauseProducing()
    flow.resumeProducing()
    gate.sessions[0].transport.ping(b"12345678")
    client.run()
    assert gate.sessions[0].got == ["start", "pause", "resume", ("pong", b"12345678")]


def test_long_reasons_are_cut_to_what_a_close_frame_holds(gate: MemoryGate) -> None:
    """In whole characters (RFC 6455 section 5.5.1)."""
    client = Client(gate, Authorization="Bearer good")
    gate.sessions[0].transport.close(closing.FORBIDDEN, "ü" * 500)
    client.run()
    assert client.core.close_rcvd is not None
    assert client.core.close_rcvd.reason == "ü" * 61
    assert not client.transport.connected
