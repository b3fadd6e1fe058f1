"""Frames from the robot's home to the client, for any division into packets."""

from __future__ import annotations

import itertools
import struct
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock
from twisted.internet.testing import StringTransport

from relay_protocol.errors import NotFound, Refused, Unavailable
from relay_protocol.scopes import Scope
from relay_server.access import BadCredentials, Principal
from relay_server.cluster.forwarding import ForwardedClient, check_secret
from relay_server.cluster.relays import RelayInfo
from relay_server.cluster.websockets import (
    PAUSED_BYTES,
    PAUSED_SECONDS,
    ForwardedHandshake,
    ForwardedWebSocket,
    _HomeConnection,
)
from relay_server.common import websocket_frames

HEAD = b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\n\r\n"
CLIENT = ForwardedClient("192.0.2.7", False, 3, "ann", "lab1", False, 5, None, "publish:/cmd_vel", 9)


class Client:
    """The websocket of the client."""

    def __init__(self) -> None:
        self.sent = b""
        self.answers: list[bytes] = []
        self.whole: list[bytes] = []
        self.ended: Any = None

    def connected(self, home: Any) -> None: ...

    def accepted(self) -> None: ...

    def frames(self, data: bytes) -> None:
        self.sent += data

    def refused(self, status: int) -> None:
        self.ended = status

    def closed(self, code: int, reason: str) -> None:
        self.ended = self.ended or (code, reason)

    def lost(self) -> None:
        self.ended = self.ended or "lost"


def home() -> tuple[Client, _HomeConnection]:
    """A connection to the home."""
    client = Client()
    connection = _HomeConnection(client)
    connection.makeConnection(StringTransport())
    return client, connection


def pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    """The data, cut at these places."""
    edges = [0, *sorted({each % (len(data) + 1) for each in cuts}), len(data)]
    return [data[a:b] for a, b in itertools.pairwise(edges)]


@given(
    st.lists(st.sampled_from([0, 1, 125, 126, 300, 65_535, 65_536]).map(bytes), max_size=5),
    st.lists(st.integers(0, 200_000), max_size=12),
    st.booleans(),
)
def test_frames_arrive_as_they_are_and_a_close_frame_ends(
    payloads: list[bytes], cuts: list[int], closes: bool
) -> None:
    frames = b"".join(websocket_frames.binary(each) for each in payloads)
    close = b"\x88\x05" + struct.pack("!H", 4403) + b"no!"
    client, connection = home()
    for piece in pieces(HEAD + frames + (close if closes else b""), cuts):
        connection.dataReceived(piece)
        if connection._accepted and not connection._started:
            assert client.sent == b""
            connection.start()
    assert client.sent == frames
    assert client.ended == ((4403, "no!") if closes else None)


@pytest.mark.parametrize(
    ("answer", "status"),
    [
        (b"HTTP/1.1 403 Forbidden\r\n\r\n", 403),
        (b"HTTP/1.1 503 Unavailable\r\ncontent-length: 2\r\n\r\nno", 503),
        (b"nonsense\r\n\r\n", 502),
        (b"x" * 20_000, 502),
    ],
)
def test_an_answer_that_is_no_websocket_ends_it(answer: bytes, status: int) -> None:
    client, connection = home()
    connection.dataReceived(answer)
    assert client.ended == status
    assert client.sent == b""


@pytest.mark.parametrize(
    ("target", "forwarded"),
    [
        ("/robots/rover", "/robots/rover"),
        ("/robots/mobile%40lab2/video/ws?topic=%2Fa&stamp=&invert", None),
        ("/robots/rover?ticket=x&width=3", "/robots/rover?width=3"),
        ("/robots/rover?token=x", "/robots/rover"),
    ],
)
def test_the_handshake_is_repeated_without_credentials(target: str, forwarded: str | None) -> None:
    request = SimpleNamespace(protocols=["bearer.abc", "foxglove.sdk.v1"], origin="https://x.test")
    handshake = ForwardedHandshake.of(request, target)
    head = handshake.request("10.0.0.1:7", {"Switchboard-Cluster": "s"}).decode()
    assert head.startswith(f"GET {forwarded or target} HTTP/1.1\r\nHost: 10.0.0.1:7\r\n")
    assert "\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\nOrigin: https://x.test\r\n" in head
    assert head.endswith("\r\nSwitchboard-Cluster: s\r\n\r\n")


def test_a_client_is_the_same_at_the_home() -> None:
    again = ForwardedClient.parse(str(CLIENT))
    assert again == CLIENT
    principal = Principal(3, "ann", "lab1", False, 5, None, Scope("publish:/cmd_vel"), 9)
    assert ForwardedClient.of(principal, "192.0.2.7") == CLIENT
    assert str(again.principal.scope) == "publish:/cmd_vel"
    for text in ("", "bm8=", "{}", "ü", str(CLIENT)[:-4]):
        with pytest.raises(Refused, match="can't be read"):
            ForwardedClient.parse(text)


@pytest.mark.parametrize("given", [None, "", "secre", "secret ", "Secret", "secrét"])
def test_only_the_secret_lets_a_relay_in(given: str | None) -> None:
    check_secret("secret", "secret")
    with pytest.raises(Refused, match="for the other relays"):
        check_secret(given, "secret")


class ClientTransport:
    """The client's websocket, inside or outside a message."""

    inside_message = False

    def __init__(self) -> None:
        self.transport = StringTransport()
        self.sent = b""
        self.closed: Any = None

    def send(self, frames: bytes) -> None:
        self.sent += frames

    def close(self, code: int, reason: str, farewell: bytes | None = None) -> None:
        self.closed = (code, reason)
        self.farewell = farewell

    def dropConnection(self, abort: bool = False) -> None:
        self.closed = "dropped"

    def pause_reading(self) -> None:
        self.transport.pauseProducing()

    def resume_reading(self) -> None:
        self.transport.resumeProducing()


class Endpoints:
    """Connects to a home in memory, at once or never."""

    def __init__(self) -> None:
        self.home = StringTransport()
        self.websockets: set[Any] = set()

    def headers(self, client: ForwardedClient) -> dict[str, str]:
        return {}

    async def open_stream(self, relay: RelayInfo, protocol: Any) -> None:
        self.protocol = protocol
        protocol.makeConnection(self.home)


def forwarded(early: bool = False) -> tuple[Clock, Endpoints, ClientTransport, ForwardedWebSocket, list[Any]]:
    """A websocket that is being opened, and its result."""
    clock, endpoints, transport = Clock(), Endpoints(), ClientTransport()
    handshake = ForwardedHandshake("/robots/rover", [], "")
    relay = RelayInfo("b", "10.0.0.2", 9092, "1", 0.0)
    session = ForwardedWebSocket(clock, endpoints, relay, 1, handshake, CLIENT, transport, 0)
    outcome: list[Any] = []
    Deferred.fromCoroutine(session.open()).addBoth(outcome.append)
    return clock, endpoints, transport, session, outcome


def opcodes(data: bytes) -> list[int]:
    """Opcodes of small masked frames."""
    found = []
    while data:
        found.append(data[0] & 15)
        data = data[6 + (data[1] & 0x7F) :]
    return found


def test_frames_of_the_home_wait_until_the_client_is_open() -> None:
    _, endpoints, transport, session, outcome = forwarded()
    ping = b"\x89\x01x"
    endpoints.protocol.dataReceived(HEAD + ping)
    assert outcome == [None]
    endpoints.protocol.dataReceived(ping)
    assert transport.sent == b""
    session.start()
    assert transport.sent == ping + ping


def test_a_pong_between_fragments_does_not_date_their_message() -> None:
    """The home sees the pong after the message, so the message counts as sent before it."""
    _, endpoints, transport, session, _ = forwarded()
    endpoints.protocol.dataReceived(HEAD)
    session.start()
    endpoints.home.clear()
    transport.inside_message = True
    for number in range(20):
        session.pong(b"%d" % number)
    transport.inside_message = False
    session.message(b"{}")
    session.pong(b"x")
    assert opcodes(endpoints.home.value()) == [1, *[10] * 16, 10]


@pytest.mark.parametrize(
    ("answer", "kind", "words"),
    [
        (b"HTTP/1.1 401 Unauthorized\r\n\r\n", BadCredentials, "401 Unauthorized"),
        (b"HTTP/1.1 403 Forbidden\r\n\r\n", NotFound, "403 Forbidden"),
        (b"HTTP/1.1 503 Unavailable\r\n\r\n", Unavailable, "503 Service Unavailable"),
        (b"x" * 20_000, Unavailable, "502 Bad Gateway"),
    ],
)
def test_a_refusal_by_the_home_relay_is_explained(answer: bytes, kind: type[Exception], words: str) -> None:
    _, endpoints, _, _, outcome = forwarded()
    endpoints.protocol.dataReceived(answer)
    (failure,) = outcome
    assert failure.check(kind)
    assert str(failure.value) == f"the relay that the robot is connected to answered {words}"
    assert endpoints.home.disconnected


def test_a_home_that_does_not_answer_ends_the_wait() -> None:
    clock, endpoints, _, _, outcome = forwarded()
    clock.advance(6)
    (failure,) = outcome
    assert failure.check(Unavailable)
    assert endpoints.home.disconnected


def test_a_home_that_goes_closes_the_client() -> None:
    _, endpoints, transport, session, _ = forwarded()
    endpoints.protocol.dataReceived(HEAD)
    session.start()
    endpoints.protocol.connectionLost()
    assert transport.closed == (4503, "the connection to the robot's relay is lost; connect again")


def fragment(first: int) -> bytes:
    """A frame of a message in several frames."""
    return bytes([first, 1]) + b"x"


@pytest.mark.parametrize(
    ("before", "end", "farewell"),
    [
        # None: the websocket sends what the client's dialect has.
        (b"", "lost", None),
        (fragment(0x01) + fragment(0x80), "lost", None),
        (fragment(0x01) + b"\x89\x01x", "lost", b""),
        (fragment(0x02) + fragment(0x00), "lost", b""),
        (websocket_frames.text(b"status"), "closed", b""),
    ],
)
def test_a_message_with_the_reason_is_left_to_a_home_that_closes_and_divides_none(
    before: bytes, end: str, farewell: bytes | None
) -> None:
    _, endpoints, transport, session, _ = forwarded()
    endpoints.protocol.dataReceived(HEAD + before)
    session.start()
    assert transport.sent == before
    if end == "lost":
        endpoints.protocol.connectionLost()
    else:
        endpoints.protocol.dataReceived(b"\x88\x05" + struct.pack("!H", 4403) + b"no!")
        endpoints.protocol.connectionLost()
        assert transport.closed == (4403, "no!")
    assert transport.farewell == farewell


def test_a_home_that_goes_in_the_middle_of_a_frame_drops_the_client() -> None:
    """A close frame would be read as a part of that frame."""
    _, endpoints, transport, session, _ = forwarded()
    endpoints.protocol.dataReceived(HEAD)
    session.start()
    endpoints.protocol.dataReceived(websocket_frames.binary(bytes(1000))[:500])
    endpoints.protocol.connectionLost()
    assert transport.closed == "dropped"


@pytest.mark.parametrize(
    ("before", "rest"),
    [
        (b"", b""),
        (websocket_frames.text(b"status"), b""),
        (websocket_frames.binary(bytes(1000))[:500], bytes(504)),
        (fragment(0x01), fragment(0x80)),
        (fragment(0x01) + b"\x89\x01x", fragment(0x00) + fragment(0x80)),
    ],
)
def test_an_answer_of_this_relay_divides_no_message_of_the_home(before: bytes, rest: bytes) -> None:
    _, endpoints, transport, session, _ = forwarded()
    endpoints.protocol.dataReceived(HEAD + before)
    session.start()
    session.answer(b"answer")
    assert transport.sent == before + (b"" if rest else b"answer")
    for at in range(len(rest)):
        endpoints.protocol.dataReceived(rest[at : at + 1])
    assert transport.sent == before + rest + b"answer"


def test_a_client_is_read_again_while_the_home_takes_nothing_for_long() -> None:
    """It may stop the robot. What it sends otherwise is bounded."""
    clock, endpoints, transport, session, _ = forwarded()
    endpoints.protocol.dataReceived(HEAD)
    session.start()
    endpoints.home.producer.pauseProducing()
    clock.advance(PAUSED_SECONDS)
    assert transport.transport.producerState == "producing"
    seen: list[bytes] = []
    session.on_message = lambda payload, binary: seen.append(payload)
    session.message(b"stop")
    assert seen == [b"stop"]
    session.message(bytes(PAUSED_BYTES))
    assert transport.transport.producerState == "paused"
    endpoints.home.producer.resumeProducing()
    assert transport.transport.producerState == "producing"
    endpoints.home.producer.pauseProducing()
    session.end()
    assert not clock.getDelayedCalls()


def test_what_a_stalled_home_does_not_take_is_bounded() -> None:
    _, endpoints, transport, session, _ = forwarded()
    endpoints.protocol.dataReceived(HEAD)
    session.start()
    endpoints.home.producer.pauseProducing()
    assert transport.transport.producerState == "paused"
    for _ in range(6):
        session.message(bytes(1 << 20))
    assert transport.closed == (4503, "the robot's relay takes no messages; connect again")


def test_the_largest_message_passes_though_the_home_takes_it_in_pieces() -> None:
    _, endpoints, transport, session, _ = forwarded()
    endpoints.protocol.dataReceived(HEAD)
    session.start()
    endpoints.home.producer.pauseProducing()
    session.message(bytes(10_000_000))
    assert transport.closed is None
    endpoints.home.producer.resumeProducing()
    assert transport.transport.producerState == "producing"
    session.message(b"next")
    assert (transport.closed, len(endpoints.home.value()) > 10_000_000) == (None, True)


def test_a_sample_that_many_clients_get_does_not_end_the_message_before() -> None:
    """The same bytes may be whole messages for one client, and a part of one for another."""
    sample = websocket_frames.text(b"sample")
    clients = [forwarded() for _ in range(3)]
    for _, endpoints, _, session, _ in clients:
        endpoints.protocol.dataReceived(HEAD)
        session.start()
    (_, one, got, *_), (_, two, other, *_), (_, three, third, *_) = clients
    one.protocol.dataReceived(sample)
    two.protocol.dataReceived(b"\x82\x7e\x00\xff")
    three.protocol.dataReceived(fragment(0x01))
    for each in (one, two, three):
        each.protocol.dataReceived(sample)
        each.protocol.connectionLost()
    assert (got.sent, got.closed) == (
        2 * sample,
        (4503, "the connection to the robot's relay is lost; connect again"),
    )
    assert (other.sent, other.closed) == (b"\x82\x7e\x00\xff" + sample, "dropped")
    assert (third.sent, third.farewell) == (fragment(0x01) + sample, None)
