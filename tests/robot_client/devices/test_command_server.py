"""Commands by TCP: framing, the secret, limits, and bytes that mean harm. In memory."""

from __future__ import annotations

import hmac
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from twisted.internet.task import Clock
from twisted.internet.testing import StringTransport

from relay_protocol.frames import FrameDecoder, JsonFrame
from robot_client.devices.command_server import (
    CLIENT_COMMANDS,
    COMMAND_FRAME,
    CONNECTIONS,
    FRAME_SECONDS,
    PROOF_FRAME,
    PROOF_SECONDS,
    UNPROVED_CONNECTIONS,
    CommandConnection,
    CommandServer,
    ConnectionPlaces,
    is_loopback,
    read_secret,
)

SECRET = b"a secret of the test"


class FakeModule:
    """A connection to a module."""

    def __init__(self, on_message: Callable[[dict[str, Any]], None], on_lost: Callable[[], None]) -> None:
        self.on_message, self.on_lost = on_message, on_lost
        self.orders: list[tuple[str, dict[str, Any]]] = []
        self.closed = False

    def order(self, order: str, **more: Any) -> None:
        self.orders.append((order, more))

    def close(self) -> None:
        self.closed = True


class Client:
    def __init__(self, secret: bytes = b"", places: ConnectionPlaces | None = None) -> None:
        self.clock = Clock()
        self.modules: list[FakeModule] = []
        self.transport = StringTransport()
        self.transport.abortConnection = self.transport.loseConnection
        self.connection = CommandConnection(
            modules=["targets"],
            secret=secret,
            open_module=self.open,
            clock=self.clock,
            places=places or ConnectionPlaces(),
        )
        self.connection.makeConnection(self.transport)

    def open(self, name: str, on_message: Any, on_lost: Any) -> FakeModule:
        if not self.running:
            raise FileNotFoundError
        self.modules.append(FakeModule(on_message, on_lost))
        return self.modules[-1]

    running = True

    def send(self, message: Any) -> None:
        self.connection.dataReceived(frame(json.dumps(message).encode()))

    def received(self) -> list[Any]:
        frames = FrameDecoder(2**24).feed(self.transport.value())
        self.transport.clear()
        return [json.loads(each.body) for each in frames if isinstance(each, JsonFrame)]

    @property
    def cut(self) -> bool:
        return self.transport.disconnecting


def frame(body: bytes, kind: int = 0) -> bytes:
    return struct.pack("!IB", len(body) + 1, kind) + body


@pytest.fixture
def client() -> Client:
    made = Client()
    made.received()
    return made


def test_command_its_answer_and_feedback(client: Client) -> None:
    client.send({"id": "a", "module": "targets", "command": {"cancel": True}})
    (module,) = client.modules
    assert module.orders == [("listen", {}), ("command", {"id": 1, "value": {"cancel": True}})]
    module.on_message({"event": "running", "pid": 1})
    module.on_message({"event": "answer", "id": 1, "error": "no"})
    module.on_message({"event": "feedback", "value": [1]})
    assert client.received() == [{"id": "a", "error": "no"}, {"module": "targets", "feedback": [1]}]
    client.connection.connectionLost()
    assert module.closed


def test_client_may_only_listen(client: Client) -> None:
    client.send({"id": 1, "module": "targets"})
    assert client.modules[0].orders == [("listen", {})]
    assert client.received() == [{"id": 1, "error": ""}]


def test_module_that_ends_answers_what_waits_and_may_come_back(client: Client) -> None:
    client.send({"id": 1, "module": "targets", "command": 1})
    client.modules[0].on_lost()
    assert client.received() == [
        {"id": 1, "error": "the module targets has ended"},
        {"module": "targets", "ended": True},
    ]
    client.running = False
    client.send({"id": 2, "module": "targets", "command": 1})
    assert client.received() == [{"id": 2, "error": "the module targets does not run"}]
    client.running = True
    client.send({"id": 3, "module": "targets", "command": 1})
    assert client.modules[1].orders[-1] == ("command", {"id": 2, "value": 1})


@pytest.mark.parametrize(
    ("message", "text"),
    [
        ({"id": 1, "module": "base", "command": 1}, "no such module; commands are taken for: targets"),
        ({"id": 1, "module": ["targets"], "command": 1}, "no such module"),
    ],
)
def test_refused_command_leaves_the_connection(client: Client, message: Any, text: str) -> None:
    client.send(message)
    assert text in client.received()[0]["error"]
    assert not client.cut


def test_command_that_grows_when_it_is_passed_on_is_refused(client: Client) -> None:
    numbers = b",".join([b"1e15"] * 8000)
    client.connection.dataReceived(frame(b'{"id": 1, "module": "targets", "command": [' + numbers + b"]}"))
    assert "too long" in client.received()[0]["error"] and not client.cut


def test_commands_without_an_answer_are_bounded(client: Client) -> None:
    for number in range(CLIENT_COMMANDS + 1):
        client.send({"id": number, "module": "targets", "command": number})
    assert client.received() == [
        {"id": CLIENT_COMMANDS, "error": "32 commands wait for their answers; send this one again later"}
    ]


def test_client_that_does_not_read_misses_feedback(client: Client) -> None:
    client.send({"id": 1, "module": "targets"})
    client.received()
    client.connection.pauseProducing()
    for number in range(3):
        client.modules[0].on_message({"event": "feedback", "value": number})
    assert client.received() == [] and client.transport.producerState == "paused"
    client.connection.resumeProducing()
    client.modules[0].on_message({"event": "feedback", "value": 3})
    assert client.received() == [{"module": "targets", "feedback": 3, "missed": 3}]


# --- the secret -----------------------------------------------------------------------------------------------


def proof(challenge: str, secret: bytes = SECRET) -> str:
    return hmac.digest(secret, challenge.encode(), "sha256").hex()


def test_secret_opens() -> None:
    client = Client(SECRET)
    (hello,) = client.received()
    client.send({"proof": proof(hello["challenge"])})
    assert client.received() == [{"welcome": True, "modules": ["targets"]}]
    client.clock.advance(FRAME_SECONDS)
    client.send({"id": 1, "module": "targets", "command": 1})
    assert len(client.modules) == 1 and not client.cut


@pytest.mark.parametrize(
    "answer",
    [
        {"proof": proof("another challenge")},
        {"proof": ""},
        {"proof": 7},
        {"proof": "é"},
        {},
        {"id": 1, "module": "targets", "command": 1},
    ],
)
def test_without_the_secret_nothing_opens(answer: Any) -> None:
    client = Client(SECRET)
    client.received()
    client.send(answer)
    client.send({"id": 1, "module": "targets", "command": 1})
    assert client.cut and client.modules == []
    assert "HMAC-SHA256" in client.received()[0]["error"]


def test_challenges_differ_and_proofs_are_good_once() -> None:
    first, second = Client(SECRET), Client(SECRET)
    (hello,) = first.received()
    assert second.received()[0]["challenge"] != hello["challenge"]
    second.send({"proof": proof(hello["challenge"])})
    assert second.cut


def test_client_that_proves_nothing_is_cut() -> None:
    client = Client(SECRET)
    client.clock.advance(PROOF_SECONDS - 0.1)
    client.connection.dataReceived(b"\0")
    assert not client.cut
    client.clock.advance(0.1)
    assert client.cut
    assert client.received()[-1] == {"error": "the proof took longer than 5 s"}


# --- places ---------------------------------------------------------------------------------------------------


def proved(places: ConnectionPlaces) -> Client:
    made = Client(SECRET, places)
    (hello,) = made.received()
    made.send({"proof": proof(hello["challenge"])})
    return made


def test_silent_connections_lock_no_client_out() -> None:
    places = ConnectionPlaces()
    first = proved(places)
    silent = [Client(SECRET, places) for _ in range(CONNECTIONS + UNPROVED_CONNECTIONS)]
    assert [each.cut for each in silent] == [True] * CONNECTIONS + [False] * UNPROVED_CONNECTIONS
    assert silent[0].received()[-1] == {
        "error": "8 newer connections have not sent their proof either; connect again"
    }
    assert {"welcome": True, "modules": ["targets"]} in proved(places).received()
    assert not first.cut


@pytest.mark.parametrize("secret", [b"", SECRET])
def test_client_too_many_receives_a_reason_and_a_place_becomes_free(secret: bytes) -> None:
    def connect() -> Client:
        return proved(places) if secret else Client(places=places)

    places = ConnectionPlaces()
    clients = [connect() for _ in range(CONNECTIONS)]
    late = connect()
    assert late.received()[-1] == {"error": "16 clients are connected, the most at a time; try again later"}
    assert late.cut and not any(each.cut for each in clients)
    late.send({"id": 1, "module": "targets", "command": 1})
    assert late.modules == []
    clients[3].connection.connectionLost()
    assert "welcome" in connect().received()[-1]


# --- bytes that mean harm -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (struct.pack("!IB", COMMAND_FRAME + 1, 0), "at most"),
        (struct.pack("!IB", 2**32 - 1, 0), "at most"),
        (b"GET / HTTP/1.1\r\n", "at most"),
        (struct.pack("!I", 0), "has no kind"),
        (frame(b"x" * 20, 1), "only frames of kind 0"),
        (frame(b"x", 9), "kind 9 is not known"),
        (frame(b"[]"), "a message is a JSON object"),
        (frame(b"{"), ""),
        (frame(b'{"id": NaN}'), ""),
        (frame(b'{"id": 1, "id": 2}'), ""),
        (frame(b'{"id": "\xff"}'), "UTF-8"),
        (frame(b'{"id": ' + b"[" * 20_000 + b"]" * 20_000 + b"}"), "deeper"),
        (frame(b'{"id": 1' + b"0" * 5000 + b"}"), ""),
        (frame(b'{"id": [1]}'), "id must be"),
        (frame(b'{"id": "' + b"x" * 61 + b'"}'), "id must be"),
    ],
)
def test_wrong_bytes_end_the_connection_with_a_reason(client: Client, data: bytes, text: str) -> None:
    client.connection.dataReceived(data)
    assert client.cut
    assert text in client.received()[-1]["error"]


def test_unproved_client_may_send_little() -> None:
    client = Client(SECRET)
    client.connection.dataReceived(struct.pack("!IB", PROOF_FRAME + 1, 0))
    assert client.cut


def test_slow_frame_is_cut_though_bytes_keep_coming(client: Client) -> None:
    data = frame(b'{"id": 1, "module": "targets"}')
    for byte in data[:20]:
        client.connection.dataReceived(bytes([byte]))
        client.clock.advance(FRAME_SECONDS / 19)
    assert client.cut and client.modules == []


def test_client_that_is_slow_between_frames_stays(client: Client) -> None:
    for number in range(3):
        client.send({"id": number, "module": "targets"})
        client.clock.advance(10 * FRAME_SECONDS)
    assert not client.cut


def test_client_that_does_not_read_its_refusal_is_cut_all_the_same(client: Client) -> None:
    cut: list[bool] = []
    client.transport.abortConnection = lambda: cut.append(True)
    client.connection.dataReceived(b"\0\0\0\0")
    client.clock.advance(FRAME_SECONDS)
    assert cut


@given(st.lists(st.binary(max_size=60), max_size=8), st.booleans())
def test_any_bytes_are_refused_or_await_more(chunks: list[bytes], secret: bool) -> None:
    client = Client(SECRET if secret else b"")
    for chunk in chunks:
        client.connection.dataReceived(chunk)
    assert client.modules == []
    client.connection.connectionLost()
    assert client.clock.getDelayedCalls() == []


@given(st.binary(min_size=1, max_size=200))
def test_any_body_is_answered(body: bytes) -> None:
    client = Client()
    client.received()
    client.connection.dataReceived(frame(body))
    assert client.received()


@given(st.lists(st.integers(1, 50), max_size=20))
def test_frames_may_come_in_any_pieces(cuts: list[int]) -> None:
    client = Client()
    data = b"".join(frame(b'{"id": %d, "module": "targets", "command": 1}' % n) for n in range(3))
    for size in cuts:
        client.connection.dataReceived(data[:size])
        data = data[size:]
    client.connection.dataReceived(data)
    assert [order for order, _ in client.modules[0].orders] == ["listen", *["command"] * 3]


# --- settings -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("host", "loopback"),
    [("127.0.0.1", True), ("127.9.9.9", True), ("::1", True), ("0.0.0.0", False), ("localhost", False)],
)
def test_loopback(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback
    if not loopback:
        with pytest.raises(ValueError, match="secret_file is needed"):
            CommandServer(["targets"], 9092, host)


@pytest.mark.parametrize(
    ("content", "mode", "text"),
    [("short", 0o600, "at least 16"), ("a" * 40, 0o640, "may be read by others"), (None, 0, "No such file")],
)
def test_secret_files(tmp_path: Path, content: str | None, mode: int, text: str) -> None:
    path = tmp_path / "secret"
    if content is not None:
        path.write_text(content)
        path.chmod(mode)
    with pytest.raises(ValueError, match=text):
        read_secret(path)


def test_secret_is_read_without_white_space(tmp_path: Path) -> None:
    path = tmp_path / "secret"
    path.write_bytes(SECRET + b"\n")
    path.chmod(0o600)
    assert read_secret(path) == SECRET
