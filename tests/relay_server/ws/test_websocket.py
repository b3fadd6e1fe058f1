"""Websockets of clients: credentials, limits and the end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from twisted.internet.defer import Deferred, fail
from twisted.internet.error import ConnectionDone, ConnectionLost
from twisted.python.failure import Failure
from websockets.exceptions import InvalidStatus
from websockets.frames import Frame, Opcode

from relay_protocol import limits
from relay_protocol.errors import Invalid
from relay_server.auth.authenticator import TicketPurpose
from relay_server.common import close_codes, websocket_frames
from relay_server.http.limits import ConnectionLimits
from relay_server.ws import bounded
from relay_server.ws.connection import ClientConnection
from relay_server.ws.updates import UpdatesFactory
from tests.worlds.websocket_client import AUTH, Client, MemoryGate, Transport

PAGES = "/api/v1/robots/stream"


@pytest.fixture
def gate() -> MemoryGate:
    """A gate that accepts clients."""
    return MemoryGate()


@pytest.mark.parametrize(
    ("path", "headers", "asked"),
    [
        ("/robots/rover", {"Authorization": "Bearer good"}, ("bearer", "good")),
        ("/robots/rover", {"Authorization": "bearer  good "}, ("bearer", "good")),
        ("/robots/rover", {"subprotocol": "bearer.good"}, ("bearer", "good")),
        ("/robots/rover?ticket=good", {}, ("ticket", "good", TicketPurpose("rover"))),
        ("/robots/rover", {"Cookie": "good", "Origin": "http://relay:9090"}, ("cookie", "good")),
        ("/robots/rover?ticket=bad", {"Authorization": "Bearer good"}, ("bearer", "good")),
        ("/robots/%72over", {"Authorization": "Bearer good"}, ("bearer", "good")),
        ("/robots/rover/", {"Authorization": "Bearer good"}, ("bearer", "good")),
        ("/robots/rover/?ticket=good", {}, ("ticket", "good", TicketPurpose("rover"))),
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
    client.clock.advance(limits.UNAUTHENTICATED_SECONDS * 2)
    assert client.closed is None


@pytest.mark.parametrize(
    ("path", "headers", "status", "code"),
    [
        ("/robots/rover", {"Authorization": "Bearer bad"}, 401, close_codes.UNAUTHENTICATED),
        ("/robots/rover?ticket=bad", {}, 401, close_codes.UNAUTHENTICATED),
        ("/robots/tank", {"Authorization": "Bearer good"}, 403, close_codes.NOT_FOUND),
        ("/robots/away", {"Authorization": "Bearer good"}, 503, close_codes.UNAVAILABLE),
    ],
)
def test_a_refused_program_reads_a_status_and_a_browser_a_close_code(
    gate: MemoryGate, path: str, headers: dict[str, str], status: int, code: int
) -> None:
    """Browsers cannot read the status of a handshake."""
    assert Client(gate, path, **headers).status == status
    browser = Client(gate, path, Origin="http://relay:9090", **headers)
    assert (browser.status, browser.closed) == (101, code)
    assert not gate.sessions
    assert not browser.transport.connected


def test_the_reason_of_a_refusal_adds_no_header(gate: MemoryGate) -> None:
    """It may quote the request."""
    gate.wait = fail(Invalid("this quotes \r\nSet-Cookie: x=1\x85"))
    client = Client(gate, "/robots/rover?token=good", subprotocol="foxglove.sdk.v1")
    refused = client.core.handshake_exc
    assert isinstance(refused, InvalidStatus)
    assert refused.response.status_code == 400
    assert "??Set-Cookie: x=1?" in refused.response.reason_phrase
    assert "set-cookie" not in refused.response.headers


@pytest.mark.parametrize(
    ("path", "headers", "asked", "selected"),
    [
        ("?token=good", {"subprotocol": "foxglove.websocket.v1"}, ("url token", "good"), None),
        (
            "?token=good",
            {"subprotocol": "foxglove.websocket.v1, foxglove.sdk.v1"},
            ("url token", "good"),
            "foxglove.sdk.v1",
        ),
        (
            "?token=good",
            {"subprotocol": "foxglove.sdk.v1", "Origin": "https://app.foxglove.dev", "Cookie": "good"},
            ("url token", "good"),
            None,
        ),
        (
            "?token=bad",
            {"subprotocol": "bearer.good, foxglove.sdk.v1"},
            ("bearer", "good"),
            "foxglove.sdk.v1",
        ),
        (
            "?token=bad&ticket=good",
            {"subprotocol": "foxglove.sdk.v1"},
            ("ticket", "good", TicketPurpose("rover")),
            None,
        ),
    ],
)
def test_a_token_in_the_url_opens_foxglove_from_any_origin(
    gate: MemoryGate, path: str, headers: dict[str, str], asked: Any, selected: str | None
) -> None:
    client = Client(gate, f"/robots/rover{path}", **headers)
    assert client.status == 101
    assert client.core.subprotocol == (selected or headers["subprotocol"])
    assert gate.asked == [asked]


@pytest.mark.parametrize("headers", [{}, {"subprotocol": "rosbridge_v2"}])
def test_a_token_in_the_url_opens_nothing_but_foxglove(gate: MemoryGate, headers: dict[str, str]) -> None:
    assert Client(gate, "/robots/rover?token=good", **headers).status == 401
    assert not gate.asked


def test_a_cookie_without_an_origin_is_worth_nothing(gate: MemoryGate) -> None:
    """For any value."""
    assert Client(gate, Cookie="good").status == 403
    assert not gate.asked


def test_a_relay_that_is_shutting_down_admits_no_client(gate: MemoryGate) -> None:
    """A program may retry elsewhere."""
    gate.accepting = False
    assert Client(gate, Authorization="Bearer good").status == 503


def test_auth_may_be_the_first_message(gate: MemoryGate) -> None:
    """Messages that follow while the token is looked up are kept in order."""
    gate.wait = Deferred()
    client = Client(gate)
    for text in (AUTH, "a", "b"):
        client.says(text)
    assert not gate.sessions
    gate.wait.callback(None)
    client.says("c")
    assert gate.sessions[0].got == ["start", b"a", b"b", b"c"]
    client.clock.advance(limits.UNAUTHENTICATED_SECONDS * 2)
    assert client.closed is None


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ('{"op":"auth","mac":"bad"}', close_codes.UNAUTHENTICATED),
        ('{"op":"subscribe","topic":"/x"}', close_codes.UNAUTHENTICATED),
        ("junk", close_codes.UNAUTHENTICATED),
        ("x" * (limits.UNAUTHENTICATED_BYTES + 1), close_codes.TOO_BIG),
    ],
)
def test_any_other_first_message_ends_the_connection(gate: MemoryGate, text: str, code: int) -> None:
    """Unauthenticated clients are not served."""
    client = Client(gate)
    client.says(text)
    assert client.closed == code
    assert not client.transport.connected
    assert not gate.sessions


def test_silent_connection_is_closed_at_an_absolute_deadline(gate: MemoryGate) -> None:
    """Pings do not extend it."""
    client = Client(gate)
    for _ in range(99):
        client.clock.advance(0.1)
        client.core.send_ping(b"x")
        client.run()
    assert client.closed is None
    client.clock.advance(0.2)
    client.run()
    assert client.closed == close_codes.UNAUTHENTICATED


@pytest.mark.parametrize("size", [0, 1000])
def test_messages_before_the_proof_are_bounded(gate: MemoryGate, size: int) -> None:
    """Empty messages take memory too."""
    gate.wait = Deferred()
    client = Client(gate)
    client.says(AUTH)
    for _ in range(limits.UNAUTHENTICATED_BYTES // 64):
        if client.transport.connected:
            client.core.send_text(b"x" * size)
            client.run()
    assert client.closed == close_codes.TOO_BIG


def test_an_internal_error_is_reported_without_internals(gate: MemoryGate) -> None:
    """The log has details."""
    client = Client(gate, "/robots/broken")
    client.says(AUTH)
    assert client.closed == close_codes.INTERNAL
    assert client.core.close_rcvd is not None
    assert "insides" not in client.core.close_rcvd.reason


@pytest.mark.parametrize("how", ["handshake", "auth"])
def test_robot_that_leaves_during_authentication_leaves_no_state(gate: MemoryGate, how: str) -> None:
    """Neither a session nor a place is left."""
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
    """With 4403, and the session ignores further messages."""
    client = Client(gate, Authorization="Bearer good")
    client.core.send_binary(b"x")
    client.run()
    assert client.closed == close_codes.FORBIDDEN
    assert gate.sessions[0].got[:2] == ["start", "end"]


def test_samples_for_a_closing_client_are_dropped(gate: MemoryGate) -> None:
    """The samples come from a robot that serves other clients too, so they raise no error."""
    client = Client(gate, Authorization="Bearer good")
    send: Callable[[bytes], None] = gate.sessions[0].transport.send
    send(websocket_frames.text(b'{"n":1}'))
    client.transport.loseConnection = lambda: None  # type: ignore[method-assign]
    client.core.send_close(1000)
    client.run()
    send(websocket_frames.text(b'{"n":2}'))
    client.transport.connected = False
    client.end.connectionLost(Failure(ConnectionDone()))
    send(websocket_frames.text(b'{"n":3}'))
    assert client.heard == [b'{"n":1}']
    assert gate.sessions[0].got == ["start", "end"]


@pytest.mark.parametrize("ours", [True, False])
def test_no_frame_follows_a_close(gate: MemoryGate, ours: bool) -> None:
    """The session's send queue writes directly to the socket."""
    client = Client(gate, Authorization="Bearer good")
    session = gate.sessions[0]
    session.send_queue.send_reliable(websocket_frames.text(b'{"n":1}'))
    client.transport.loseConnection = lambda: None  # type: ignore[method-assign]
    if ours:
        session.transport.close(close_codes.GOING_AWAY, "going down")
    else:
        client.core.send_close(1000)
        client.run()
    closed_at = len(client.transport.value())
    session.send_queue.send_reliable(websocket_frames.text(b'{"n":2}'))
    session.send_queue.send_droppable("t", websocket_frames.text(b'{"n":3}'))
    assert not session.send_queue.passing
    assert len(client.transport.value()) == closed_at


def test_a_dropped_client_is_sent_nothing_more(gate: MemoryGate) -> None:
    """Even before Twisted reports the closed connection."""
    client = Client(gate, Authorization="Bearer good")
    client.end.dropConnection(abort=True)
    assert not gate.sessions[0].send_queue.passing


def test_the_transports_pauses_reach_the_session(gate: MemoryGate) -> None:
    """Pongs reach it too, with their payload."""
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
    gate.sessions[0].transport.close(close_codes.FORBIDDEN, "ü" * 500)
    client.run()
    assert client.core.close_rcvd is not None
    assert client.core.close_rcvd.reason == "ü" * 61
    assert not client.transport.connected


def test_unauthenticated_clients_are_limited_over_all_addresses(gate: MemoryGate) -> None:
    """A client over the limit gets an error to retry; authenticated or closed clients make room."""
    cap = ConnectionLimits(50, unauthenticated=2)
    first, second = Client(gate, cap=cap), Client(gate, cap=cap)
    assert Client(gate, cap=cap, Authorization="Bearer good").status == 503
    first.says(AUTH)
    assert Client(gate, cap=cap, Authorization="Bearer good").status == 101
    third = Client(gate, cap=cap)
    assert third.status == 101
    assert Client(gate, cap=cap).status == 503
    for client in (first, second, third):
        client.transport.connected = False
        client.end.connectionLost(Failure(ConnectionDone()))
    assert [Client(gate, cap=cap).status for _ in range(3)] == [101, 101, 503]


# --- before the session -----------------------------------------------------------------------------------


def frame_head(size: int) -> bytes:
    """The header of a masked text frame that announces this size (RFC 6455 section 5.2)."""
    return b"\x81\xff" + size.to_bytes(8, "big") + b"mask"


def test_a_large_frame_before_the_proof_is_refused_by_its_length(gate: MemoryGate) -> None:
    """Its bytes are neither awaited nor stored."""
    client = Client(gate)
    client.end.dataReceived(frame_head(limits.UNAUTHENTICATED_BYTES + 1))
    client.run()
    assert client.closed == close_codes.TOO_BIG


@pytest.mark.parametrize("kind", [0x89, 0x8A, 0x01], ids=["pings", "pongs", "unfinished text"])
def test_frames_without_a_message_count_as_bytes_before_the_proof(gate: MemoryGate, kind: int) -> None:
    """64 KiB in all, for all kinds of frames."""
    client = Client(gate)
    client.end.dataReceived(bytes([kind, 0x80]) + bytes(4))
    for _ in range(limits.UNAUTHENTICATED_BYTES // 600 + 2):
        if client.transport.connected:
            client.end.dataReceived(
                (bytes([kind & 0x80 | (kind & 0x0F if kind & 8 else 0), 0x80]) + bytes(4)) * 100
            )
            client.run()
    assert client.closed == close_codes.TOO_BIG


def test_a_session_takes_and_sends_larger_messages(gate: MemoryGate) -> None:
    """Up to the limit for clients; messages of the relay have none here."""
    client = Client(gate, Authorization="Bearer good")
    client.core.max_message_size = None
    client.says("x" * limits.CLIENT_MESSAGE)
    assert len(gate.sessions[0].got[-1]) == limits.CLIENT_MESSAGE
    picture = b"y" * (limits.CLIENT_MESSAGE + 1)
    gate.sessions[0].transport.send(websocket_frames.text(picture))
    client.run()
    assert client.heard == [picture]
    client.end.dataReceived(frame_head(limits.CLIENT_MESSAGE + 1))
    client.run()
    assert client.closed == close_codes.TOO_BIG


def test_handshake_and_proof_share_a_deadline(gate: MemoryGate) -> None:
    client = Client(gate)
    client.clock.advance(limits.UNAUTHENTICATED_SECONDS - 0.1)
    assert client.closed is None
    client.clock.advance(0.2)
    client.run()
    assert client.closed == close_codes.UNAUTHENTICATED


@pytest.mark.parametrize("how", ["bearer", "ticket", "cookie", "page"])
def test_a_handshake_while_the_database_hangs_gets_a_503(gate: MemoryGate, how: str) -> None:
    """Before the connection's own deadline. A late answer of the database opens no session."""
    gate.wait = Deferred()
    origin = {"Origin": "http://relay:9090"}
    client = {
        "bearer": lambda: Client(gate, Authorization="Bearer good"),
        "ticket": lambda: Client(gate, "/robots/rover?ticket=good"),
        "cookie": lambda: Client(gate, Cookie="good", **origin),
        "page": lambda: Client(gate, PAGES, factory=UpdatesFactory, Authorization="Bearer good"),
    }[how]()
    client.clock.advance(limits.UNAUTHENTICATED_SECONDS - 0.1)
    client.run()
    if how == "cookie":
        # Browsers read no status of a handshake.
        assert (client.status, client.closed) == (101, close_codes.UNAVAILABLE)
    else:
        assert client.status == 503
    assert not client.transport.connected
    gate.wait.callback(None)
    assert not gate.sessions
    assert gate.admitted == 0
    assert not client.clock.getDelayedCalls()


@pytest.mark.parametrize("seconds", [0.0, limits.UNAUTHENTICATED_SECONDS - 1])
def test_a_proof_by_message_while_the_database_hangs_is_not_a_wrong_one(
    gate: MemoryGate, seconds: float
) -> None:
    """However late it comes: the client need not log in again."""
    gate.wait = Deferred()
    client = Client(gate)
    client.clock.advance(seconds)
    client.says(AUTH)
    client.clock.advance(limits.UNAUTHENTICATED_SECONDS - seconds)
    client.run()
    assert client.closed == close_codes.UNAVAILABLE
    gate.wait.callback(None)
    assert not gate.sessions
    assert gate.admitted == 0


def test_a_second_handshake_while_the_first_waits_is_cut(gate: MemoryGate) -> None:
    """A socket has one session, and one authentication; until its answer no bytes are read."""
    gate.wait = Deferred()
    client = Client(gate, Authorization="Bearer good")
    assert client.transport.producerState == "paused"
    request = b"GET /robots/rover HTTP/1.1\r\nHost: relay:9090\r\nUpgrade: websocket\r\n\r\n"
    client.end.dataReceived(request)
    assert not client.transport.connected
    gate.wait.callback(None)
    assert gate.asked == [("bearer", "good")]
    assert not gate.sessions
    assert gate.admitted == 0
    assert not client.cap._counts


def test_the_transport_reads_on_after_the_answer(gate: MemoryGate) -> None:
    """Bytes held meanwhile are read then."""
    gate.wait = Deferred()
    client = Client(gate, Authorization="Bearer good")
    gate.wait.callback(None)
    client.run()
    assert client.transport.producerState == "producing"
    client.says('{"op":"x"}')
    assert gate.sessions[0].got == ["start", b'{"op":"x"}']


def test_bytes_behind_the_handshake_in_one_piece_are_cut(gate: MemoryGate) -> None:
    """A client must wait for the answer before it sends more (RFC 6455 section 4.1)."""
    client = Client(gate, tail=b"GET / HTTP/1.1\r\n\r\n", Authorization="Bearer good")
    assert not client.transport.connected
    assert not gate.sessions
    assert gate.admitted == 0


def test_an_open_websocket_takes_little_memory(gate: MemoryGate) -> None:
    """Options belong to the class, and headers of the handshake are discarded; only differences are stored."""
    client = Client(gate, Authorization="Bearer good")
    options = set(ClientConnection.CONFIG_ATTRS) & set(vars(client.end))
    assert options == {"maxFramePayloadSize", "maxMessagePayloadSize"}
    assert client.end.requireMaskedClientFrames is True
    assert client.end.perMessageCompressionAccept([]) is None
    assert not set(bounded.HANDSHAKE_ATTRIBUTES) & set(vars(client.end))
    assert "good" not in str(vars(client.end).values())


def test_names_of_what_is_forgotten_are_autobahns(gate: MemoryGate) -> None:
    """Changes of Autobahn's attributes fail here."""
    gate.wait = Deferred()
    client = Client(gate, Authorization="Bearer good")
    before = set(vars(client.end))
    gate.wait.callback(None)
    client.run()
    assert set(bounded.HANDSHAKE_ATTRIBUTES) - {"http_response_data"} <= before


def test_pings_of_a_client_that_takes_nothing_are_answered_by_one_pong(gate: MemoryGate) -> None:
    """The latest, when it reads again: many pings take no memory."""
    client = Client(gate, Authorization="Bearer good")
    flow = client.transport.producer
    flow.pauseProducing()
    for number in range(100):
        client.core.send_ping(b"%d" % number)
    client.run()
    assert client.pongs == []
    flow.resumeProducing()
    client.core.send_ping(b"later")
    client.run()
    assert client.pongs == [b"99", b"later"]


def test_a_close_comes_after_all_that_was_sent_before(gate: MemoryGate) -> None:
    """Bytes written by Autobahn and past it keep their order."""
    client = Client(gate, Authorization="Bearer good")
    transport = gate.sessions[0].transport
    for number in range(3):
        transport.send(websocket_frames.text(b"%d" % number))
    transport.close(close_codes.FORBIDDEN, "enough")
    client.run()
    assert client.heard == [b"0", b"1", b"2"]
    assert client.closed == close_codes.FORBIDDEN


def test_bytes_in_one_piece_with_the_proof_count_as_after_it(gate: MemoryGate) -> None:
    """The session has begun when the next message is read, so the larger limit applies."""
    client = Client(gate)
    large = "x" * (limits.UNAUTHENTICATED_BYTES + 1)
    for text in (AUTH, "first message", large, "last message"):
        client.core.send_text(text.encode())
    client.end.dataReceived(b"".join(client.core.data_to_send()))
    assert gate.sessions[0].got == ["start", b"first message", large.encode(), b"last message"]


def test_a_message_in_frames_is_as_old_as_the_first_of_them(gate: MemoryGate) -> None:
    """Control frames may be in between: their pongs do not prove the start of the message."""
    client = Client(gate, Authorization="Bearer good")
    (session,) = gate.sessions
    client.core.send_pong(b"before")
    client.core.send_text(b'{"op":', fin=False)
    client.core.send_pong(b"between")
    client.run()
    client.core.send_continuation(b'"x"}', fin=True)
    client.run()
    assert session.got[-1] == b'{"op":"x"}'
    assert session.earliest_sent_given == [1_000_000_000]
    assert session.earliest_sent == 2_000_000_000


@pytest.mark.parametrize("how", ["by the client", "by the relay", "by the network"])
def test_side_that_closed_a_connection_is_known(gate: MemoryGate, how: str) -> None:
    """Leaving is intended; a client that is cut or lost may still hold the joystick."""
    client = Client(gate, Authorization="Bearer good")
    (session,) = gate.sessions
    if how == "by the client":
        client.core.send_close(1000)
        client.run()
    elif how == "by the relay":
        client.end.close(close_codes.FORBIDDEN, "your right was revoked")
        client.run()
    else:
        client.end.connectionLost(Failure(ConnectionLost()))
    assert session.got[-1] == "end"
    assert session.orderly is (how == "by the client")


@pytest.mark.parametrize("when", ["before auth", "while the token is looked up", "in a session"])
@pytest.mark.parametrize(
    "frames",
    [
        [(b'{"op":"\xff"}', True)],
        [(b"x" * 5_000 + b"\xe2\x82", True)],
        [(b"\xc3", False), (b"(", False)],
        [(b"whole", False), (b"cut \xf0\x9f", True)],
    ],
)
def test_text_that_is_not_utf8_closes_with_1007(
    gate: MemoryGate, when: str, frames: list[tuple[bytes, bool]]
) -> None:
    """RFC 6455 section 8.1. A fragmented message fails before its end, and the session ignores the rest."""
    client = Client(gate, **({"Authorization": "Bearer good"} if when == "in a session" else {}))
    if when == "while the token is looked up":
        gate.wait = Deferred()
        client.says(AUTH)
    client.core.send_text(*frames[0])
    for payload, fin in frames[1:]:
        client.core.send_continuation(payload, fin)
    client.run()
    assert client.closed == close_codes.NOT_UTF8
    assert not client.transport.connected
    assert [session.got for session in gate.sessions] == [["start", "end"]] * len(gate.sessions)
    if gate.wait is not None:
        gate.wait.callback(None)
    assert len(gate.sessions) == (when == "in a session")
    assert gate.admitted == 0


SEQUENCES = {
    "60cebae1bdb9cf83cebcceb5": True,
    "00": True,
    "7f": True,
    "c280": True,
    "dfbf": True,
    "e0a080": True,
    "ed9fbf": True,
    "ee8080": True,
    "efbfbd": True,
    "efbfbf": True,
    "f0908080": True,
    "f48fbfbf": True,
    "80": False,
    "bf": False,
    "c1bf": False,
    "c080": False,
    "c320": False,
    "ceba20": True,
    "e09fbf": False,
    "e0bf": False,
    "eda080": False,
    "edbfbf": False,
    "eda080edb080": False,
    "f08fbfbf": False,
    "f09080": False,
    "f4908080": False,
    "f7bfbfbf": False,
    "f888808080": False,
    "fbbfbfbfbf": False,
    "fc8480808080": False,
    "fdbfbfbfbfbf": False,
    "fe": False,
    "ff": False,
}
"""Octets, and whether they are UTF-8 (RFC 3629): first and last of each length, overlong, surrogates, cuts."""


@pytest.mark.parametrize("how", ["one frame", "a frame for each octet", "an octet at a time"])
@pytest.mark.parametrize("octets", SEQUENCES)
def test_utf8_is_distinguished_from_other_bytes(gate: MemoryGate, octets: str, how: str) -> None:
    """For any division."""
    payload = bytes.fromhex(octets)
    client = Client(gate, Authorization="Bearer good")
    if how == "a frame for each octet":
        client.core.send_text(b"", fin=False)
        for octet in payload:
            client.core.send_continuation(bytes([octet]), fin=False)
        client.core.send_continuation(b"", fin=True)
        client.run()
    else:
        client.core.send_text(payload)
        sent = b"".join(client.core.data_to_send())
        step = 1 if how == "an octet at a time" else len(sent)
        for place in range(0, len(sent), step):
            client.end.dataReceived(sent[place : place + step])
        client.run()
    assert gate.sessions[0].got[1:] == ([payload] if SEQUENCES[octets] else ["end"])
    assert client.closed == (None if SEQUENCES[octets] else close_codes.NOT_UTF8)


@pytest.mark.parametrize(
    "code", [1000, 1001, 1002, 1003, 1007, 1008, 1009, 1010, 1011, 3000, 3999, 4000, 4999]
)
def test_a_close_of_the_client_is_answered(gate: MemoryGate, code: int) -> None:
    """With a code that an endpoint may send (RFC 6455 section 7.4)."""
    client = Client(gate, Authorization="Bearer good")
    client.core.writes.append(
        Frame(Opcode.CLOSE, code.to_bytes(2, "big") + "bye 🤖".encode()).serialize(mask=True)
    )
    client.run()
    assert client.closed == 1000
    assert gate.sessions[0].got[-1] == "end"
    assert gate.sessions[0].orderly


@pytest.mark.parametrize("payload", [b"", b"\x03\xe8", b"\x03\xe8" + b"*" * 122, b"\x03\xe8" + b"*" * 123])
def test_a_close_of_the_client_may_have_no_code_and_a_long_reason(gate: MemoryGate, payload: bytes) -> None:
    """A reason has at most 123 octets (RFC 6455 section 5.5); what follows a close is not read."""
    client = Client(gate, Authorization="Bearer good")
    client.core.writes.append(Frame(Opcode.CLOSE, payload).serialize(mask=True))
    client.core.writes.append(Frame(Opcode.TEXT, b"late").serialize(mask=True))
    client.core.writes.append(Frame(Opcode.PING, b"late").serialize(mask=True))
    client.run()
    assert client.core.close_rcvd is not None
    assert gate.sessions[0].got == ["start", "end"]
    assert gate.sessions[0].orderly
    assert client.pongs == []


def test_no_session_begins_on_a_connection_that_has_failed(gate: MemoryGate) -> None:
    """The token may be accepted before the client has answered the close frame."""
    gate.wait = Deferred()
    client = Client(gate)
    client.says(AUTH)
    client.core.send_text(b"\xff")
    client.end.dataReceived(b"".join(client.core.data_to_send()))
    gate.wait.callback(None)
    client.run()
    assert client.closed == close_codes.NOT_UTF8
    assert not gate.sessions
    assert gate.admitted == 0


def test_the_close_for_text_that_is_not_utf8_waits_for_the_clients(gate: MemoryGate) -> None:
    """Otherwise unread bytes would reset the connection, and the client would read no code."""
    client = Client(gate, Authorization="Bearer good")
    for send in (client.core.send_text, client.core.send_continuation):
        send(b"\xff", fin=False)
    client.end.dataReceived(b"".join(client.core.data_to_send()))
    assert client.transport.connected
    client.run()
    assert client.closed == close_codes.NOT_UTF8
    assert gate.sessions[0].got == ["start", "end"]


@pytest.mark.parametrize(
    ("payload", "code"),
    [
        (b"\x03\xe8bye \xff", 1007),
        (b"\x03\xe8\xe2\x82", 1007),
        (b"\x00\x00", 1002),
        (b"\x03\xe7", 1002),
        (b"\x03\xec", 1002),
        (b"\x03\xed", 1002),
        (b"\x03\xee", 1002),
        (b"\x04\x4c", 1002),
        (b"\x07\xd0", 1002),
        (b"\x0b\xb7", 1002),
        (b"\x13\x88", 1002),
        (b"\xff\xff", 1002),
        (b"\x03", 1002),
    ],
)
def test_a_close_frame_of_the_client_is_checked(gate: MemoryGate, payload: bytes, code: int) -> None:
    """RFC 6455 sections 5.5.1, 7.4.1 and 8.1: its reason is UTF-8, and its code may be sent."""
    client = Client(gate, Authorization="Bearer good")
    client.core.writes.append(Frame(Opcode.CLOSE, payload).serialize(mask=True))
    client.run()
    assert client.closed == code
    client.clock.advance(2)
    assert gate.sessions[0].got == ["start", "end"]
    assert not client.transport.connected


@pytest.mark.parametrize("payload", [b"", b"{}"])
def test_the_frames_of_a_message_are_bounded(
    gate: MemoryGate, payload: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Empty frames too, since they take memory."""
    monkeypatch.setattr(bounded, "MAX_PIECES", 10)
    client = Client(gate, Authorization="Bearer good")
    client.core.send_text(b"", fin=False)
    for _ in range(9):
        client.core.send_continuation(payload, fin=False)
    client.run()
    assert client.closed is None
    for _ in range(100):
        client.core.send_continuation(payload, fin=False)
    client.run()
    assert client.closed == close_codes.TOO_BIG
    assert len(client.end.message_data) <= 11


@pytest.mark.parametrize("how", ["close", "refused"])
def test_a_client_that_leaves_and_takes_nothing_is_cut(
    gate: MemoryGate, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """TCP waits until all bytes are sent before it closes, without a limit."""
    monkeypatch.setattr(Transport, "stuck", True)
    if how == "refused":
        client = Client(gate, Authorization="Bearer bad")
    else:
        client = Client(gate, Authorization="Bearer good")
        client.core.send_close(1000)
        client.run()
    assert client.transport.connected
    client.clock.advance(bounded.CLOSE_SECONDS)
    assert not client.transport.connected
    assert how == "refused" or gate.sessions[0].got[-1] == "end"
    assert not client.clock.getDelayedCalls()
