"""Peers that send invalid or no data get errors with reasons, which are logged, and do not affect others."""

from __future__ import annotations

import contextlib
import json
import random
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from relay_db import queries
from relay_db.engine import Database
from relay_protocol import identity, limits, link
from relay_protocol.frames import encode_json
from relay_server import PORTAL
from relay_server.auth import passwords
from tests.worlds.bystanders import Watcher, undisturbed
from tests.worlds.fake_robot import FakeRobot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import PATIENCE, wait_for


@pytest.fixture(autouse=True)
def others_unaffected(world: Any, watchers: list[Watcher]) -> Iterator[None]:
    """Bystanders continue, the process is the same, and the log has no traceback."""
    with undisturbed(world.relay, watchers):
        yield


def logs(world: Any, words: str, since: int) -> None:
    """Waits for these words in the relay's log."""
    wait_for(f"the log says '{words}'", lambda: words in world.relay.log[since:])


def robot_of_our_own(world: Any) -> tuple[str, bytes]:
    """A robot enrolled with the test's key; returns its name and private key."""
    name = f"fake-{random.randrange(10**9)}"
    key = identity.generate_key()
    code = world.relay.cli("robot", "add", name)["enrolment_code"]
    with FakeRobot(world.relay.robots_port) as robot:
        assert robot.enroll(name, code, key)["op"] == "enrolled"
    return name, key


# --- identity ---------------------------------------------------------------------------------------------


def test_a_robot_with_an_unknown_key_is_refused(world: Any) -> None:
    """A new key opens nothing, and the robot of that name stays online."""
    since = len(world.relay.log)
    with FakeRobot(world.relay.robots_port) as robot:
        answer = robot.register("rover", identity.generate_key())
        assert answer["op"] == "refused"
        assert "key is not accepted" in answer["reason"]
        assert robot.ended()
    logs(world, "is refused: this key is not accepted", since)
    world.robot.wait_online()


def test_a_robot_that_claims_the_right_key_but_signs_with_another_is_refused(world: Any) -> None:
    """The fingerprint is public; only the signature counts."""
    known = world.relay.cli("robot", "keys", "rover")[0]["fingerprint"]
    with FakeRobot(world.relay.robots_port) as robot:
        challenge = robot.hello("rover", known)
        nonce = link.from_base64(challenge["nonce"], "the nonce")
        forged = identity.sign(identity.generate_key(), challenge["relay"], "rover", nonce)
        robot.send(link.Prove(signature=link.to_base64(forged)))
        assert "key is not accepted" in robot.until("refused")["reason"]
        assert robot.ended()


def test_a_recorded_proof_is_worth_nothing_on_another_connection(world: Any) -> None:
    """A real proof, repeated for a new challenge, is refused; its robot stays registered."""
    name, key = robot_of_our_own(world)
    with FakeRobot(world.relay.robots_port) as robot, FakeRobot(world.relay.robots_port) as thief:
        assert robot.register(name, key)["op"] == "welcome"
        thief.hello(name, identity.fingerprint(identity.public_half(key)))
        thief.send(robot.proof)
        assert "key is not accepted" in thief.until("refused")["reason"]
        assert thief.ended()
        assert world.relay.state_of(name) == "online"


def test_used_expired_and_unknown_codes_get_the_same_words(world: Any) -> None:
    """The answer discloses neither the reason nor whether the robot exists."""
    used = world.relay.cli("robot", "add", "codes")["enrolment_code"]
    with FakeRobot(world.relay.robots_port) as robot:
        assert robot.enroll("codes", used, identity.generate_key())["op"] == "enrolled"
    expired = passwords.new_enrolment_code()
    database = Database(f"sqlite:///{world.relay.data / 'switchboard.db'}")
    with database.begin() as session:
        found = queries.find_robot(session, "codes")
        assert found is not None
        queries.issue_enrolment_code(session, found.id, passwords.code_hash(expired), time.time() - 1)
    database.close()
    since = len(world.relay.log)
    unknown = passwords.new_enrolment_code()
    tries = [("codes", used), ("codes", expired), ("codes", unknown), ("no-such-robot", unknown)]
    answers = []
    for name, code in tries:
        with FakeRobot(world.relay.robots_port) as robot:
            answers.append(robot.enroll(name, code, identity.generate_key()))
            assert robot.ended()
    assert answers[0]["op"] == "refused"
    assert "ask for a new one" in answers[0]["reason"]
    assert all(answer == answers[0] for answer in answers)
    logs(world, "enrolment code is wrong", since)
    assert not any(code in world.relay.log for _, code in tries)


def test_the_robots_own_command_gives_the_reason_of_a_refused_code(world: Any) -> None:
    """``switchboard-robot enroll`` with a wrong code prints the relay's error and exits with a failure code."""
    done = world.robot.enroll(passwords.new_enrolment_code(), world.relay.robots_port, "--replace")
    assert done.returncode != 0
    assert "ask for a new one" in done.stderr
    assert "Traceback" not in done.stderr


# --- bytes from robots ------------------------------------------------------------------------------------

DEEP = b"[" * 100_000
BAD_JSON = {
    "invalid UTF-8": (b'{"op":"bye","reason":"\xff\xfe"}', "UTF-8"),
    "invalid UTF-8 in a field nobody reads": (b'{"op":"bye","reason":"x","y":"\xc3("}', "UTF-8"),
    "100,000 deep": (b'{"op":"bye","reason":' + DEEP, "deeper than 64"),
    "100,000 deep in a field nobody reads": (
        b'{"op":"bye","reason":"","x":' + DEEP + b"]" * 100_000 + b"}",
        "deeper",
    ),
    "NaN": (b'{"op":"bye","reason":"","t":NaN}', ""),
    "a huge number": (b'{"op":"ping","t":' + b"9" * 5000 + b"}", ""),
    "a number beyond doubles": (b'{"op":"health","cpu":1e999}', ""),
    "a key twice": (b'{"op":"bye","reason":"x","reason":"y"}', "'reason' twice"),
    "no object": (b"[1,2,3]", "object"),
    "an unknown op": (b'{"op":"rm -rf"}', "unknown op"),
    "nothing": (b"", ""),
    "binary": (bytes(range(256)), ""),
}


@pytest.mark.parametrize("proved", [False, True], ids=["before the proof", "after the proof"])
def test_a_frame_of_four_gigabytes_is_refused_before_it_is_awaited(world: Any, proved: bool) -> None:
    """The four bytes of the length are enough to refuse it; no memory is allocated."""
    name, key = robot_of_our_own(world)
    since = len(world.relay.log)
    relay = psutil.Process(world.relay.process.popen.pid)
    with FakeRobot(world.relay.robots_port) as robot:
        if proved:
            assert robot.register(name, key)["op"] == "welcome"
        before = relay.memory_info().rss
        robot.send_bytes(b"\xff\xff\xff\xff\x00")
        refused = robot.until("refused")
        assert refused["code"] == "frame_too_large"
        assert "4294967295" in refused["reason"]
        assert robot.ended()
        assert relay.memory_info().rss - before < 64 * limits.MIB
    logs(world, "a frame of 4294967295 bytes was announced", since)


@pytest.mark.parametrize("what", BAD_JSON)
def test_bad_json_from_a_proved_robot_ends_its_link_with_a_reason(
    world: Any, proved_robot: Any, what: str
) -> None:
    """A robot with an invalid message gets the reason and is disconnected."""
    text, words = BAD_JSON[what]
    since = len(world.relay.log)
    with proved_robot() as robot:
        robot.send_bytes(encode_json(text))
        refused = robot.until("refused")
        assert words in refused["reason"]
        assert robot.ended()
    logs(world, "broke the protocol", since)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b'{"op":"hello","version":1,"robot":"a","robot":"rover","key":"k","encodings":[]}', "'robot' twice"),
        (
            b'{"op":"hello","version":1,"robot":"a","key":"k","encodings":[],"y":[{"z":1,"\\u007a":2}]}',
            "'z' twice",
        ),
    ],
    ids=["a field", "a field of what nobody reads"],
)
def test_a_robots_message_with_a_key_twice_ends_the_connection_with_a_reason(
    world: Any, text: bytes, words: str
) -> None:
    """Two readers could take different values."""
    with FakeRobot(world.relay.robots_port) as robot:
        robot.send_bytes(encode_json(text))
        assert words in robot.until("refused")["reason"]
        assert robot.ended()


@pytest.mark.parametrize("what", [each for each in BAD_JSON if "100,000" not in each and "twice" not in each])
def test_bad_json_before_the_proof_ends_the_connection_with_a_reason(world: Any, what: str) -> None:
    """Unauthenticated robots get the same reason."""
    text, words = BAD_JSON[what]
    with FakeRobot(world.relay.robots_port) as robot:
        robot.send_bytes(encode_json(text))
        assert words in robot.until("refused")["reason"]
        assert robot.ended()


@pytest.fixture(scope="module")
def proved_robot(world: Any) -> Any:
    """Opens registered links of the test's own robot, one after the other."""
    name, key = robot_of_our_own(world)

    @contextlib.contextmanager
    def opened() -> Iterator[FakeRobot]:
        wait_for("the former link is gone", lambda: world.relay.state_of(name) == "offline")
        with FakeRobot(world.relay.robots_port) as robot:
            assert robot.register(name, key)["op"] == "welcome"
            yield robot

    return opened


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"\x00\x00\x00\x00", "length 0"),
        (b"\x00\x00\x00\x02\x09x", "frame kind 9"),
        (b"\x00\x00\x00\x05\x01aaaa", "12 bytes"),
        (b"\x00\x00\x00\x0d\x01" + bytes(12), "control link"),
        (b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", "announced"),
    ],
    ids=["empty", "unknown kind", "short sample", "sample on the control link", "HTTP"],
)
def test_bytes_that_are_no_frames_end_a_robots_link_with_a_reason(
    world: Any, proved_robot: Any, data: bytes, words: str
) -> None:
    """The error names the broken framing."""
    with proved_robot() as robot:
        robot.send_bytes(data)
        assert words in robot.until("refused")["reason"]
        assert robot.ended()


# --- messages from clients --------------------------------------------------------------------------------

BAD_ROSBRIDGE = {
    "10,000 deep": (b'{"op":"publish","topic":"/cmd_vel","msg":' + DEEP[:10_000], "deeper than 64"),
    "a word that is no number": (
        b'{"op":"publish","topic":"/cmd_vel","msg":{"linear":{"x":nan}}}',
        "not JSON",
    ),
    "a key twice": (b'{"op":"unadvertise","topic":"/cmd_vel","topic":"/x"}', "'topic' twice"),
    "a key twice in a body": (
        b'{"op":"call_service","service":"/reset","args":{"a":{"x":0,"x":1}}}',
        "'x' twice",
    ),
    "no object": (b'"hello"', "object"),
    "an unknown op": (b'{"op":"shutdown"}', "unknown op"),
    "no op": (b"{}", "op"),
    "a field of the wrong type": (b'{"op":"subscribe","topic":7}', "topic"),
    "nothing": (b"", "not JSON"),
}


@pytest.mark.parametrize("what", BAD_ROSBRIDGE)
def test_a_bad_message_is_refused_with_the_reason(world: Any, what: str) -> None:
    """A bad message causes a status with a reason and a line in the log; the connection continues."""
    text, words = BAD_ROSBRIDGE[what]
    since = len(world.relay.log)
    moved = world.left_alone()
    with world.relay.connect("rover", world.operator) as client:
        client.send(op="set_level", level="error")
        client.connection.send(text, text=True)
        status = client.until(op="status")
        assert status["level"] == "error"
        assert words in status["msg"]
        assert client.call("/relay/ping", {"robot": True})["result"]
    logs(world, "not rosbridge", since)
    assert world.robot.events("command", moved) == []


@pytest.mark.parametrize("number", ["9" * 5000, "1e999", "-1e999"])
def test_a_number_too_large_is_no_command(world: Any, number: str) -> None:
    """Numbers beyond doubles get their own error and never reach the robot."""
    moved = world.left_alone()
    with world.relay.connect("rover", world.operator) as client:
        client.send(op="set_level", level="error")
        client.send(op="advertise", topic="/cmd_vel", type="geometry_msgs/msg/Twist")
        text = '{"op":"publish","topic":"/cmd_vel","msg":{"linear":{"x":' + number + "}}}"
        client.connection.send(text)
        assert client.until(op="status")["level"] == "error"
        assert client.call("/relay/ping", {"robot": True})["result"]
    assert world.robot.events("command", moved) == []


def close_of(client: Client) -> Any:
    """Reads until the relay closes; returns the close frame."""
    with pytest.raises(ConnectionClosed) as closed:
        while True:
            client.receive()
    assert closed.value.rcvd is not None
    return closed.value.rcvd


def test_a_flood_of_malformed_messages_ends_the_connection(world: Any) -> None:
    """After a hundred invalid messages in a row the connection is closed with 4429 and a reason."""
    since = len(world.relay.log)
    with world.relay.connect("rover", world.viewer) as client:
        with contextlib.suppress(ConnectionClosed):
            # No more than are sent before the relay drops a client that does not answer its close.
            for _ in range(2_000):
                client.connection.send("{]")
        closed = close_of(client)
        assert closed.code == 4429
        assert "not rosbridge" in closed.reason
    logs(world, "is cut", since)
    assert world.relay.log[since:].count("\n") < 200


def test_a_binary_message_ends_the_connection(world: Any) -> None:
    """Binary websocket messages are refused with a close frame."""
    since = len(world.relay.log)
    with world.relay.connect("rover", world.viewer) as client:
        client.connection.send(b"\x00\x01\x02")
        closed = close_of(client)
        assert closed.code == 4403
        assert "text" in closed.reason
    logs(world, "binary messages are not taken", since)


WEBSOCKETS = {
    "rosbridge": "/robots/rover",
    "page": "/api/v1/robots/stream",
    "video": "/robots/rover/video/ws?topic=/camera",
}


@pytest.mark.parametrize(
    ("address", "proved"), [*((each, False) for each in WEBSOCKETS), ("rosbridge", True), ("page", True)]
)
@pytest.mark.parametrize(
    "fragments", [[b'{"op":"\xff"}'], [b'{"op":"\xe2', b"\x28", b'"}']], ids=["one frame", "fragments"]
)
def test_text_that_is_not_utf8_closes_every_websocket(
    world: Any, address: str, proved: bool, fragments: list[bytes]
) -> None:
    """RFC 6455 section 8.1: 1007, before and after authentication."""
    url = f"ws://127.0.0.1:{world.relay.http_port}{WEBSOCKETS[address]}"
    headers = {"Authorization": f"Bearer {world.viewer}"} if proved else {}
    with connect(url, additional_headers=headers) as websocket:
        with contextlib.suppress(ConnectionClosed):
            # The relay may close before the last fragment is sent.
            websocket.send(fragments[0] if len(fragments) == 1 else iter(fragments), text=True)
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                websocket.recv(10)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1007
    assert "UTF-8" in closed.value.rcvd.reason


@pytest.mark.parametrize("fragments", [1, 4], ids=["one frame", "fragments"])
def test_a_message_over_ten_megabytes_ends_the_connection(world: Any, fragments: int) -> None:
    """1009 with a reason, for a message in one frame or in several."""
    since = len(world.relay.log)
    text = '{"op":"publish","topic":"/x","msg":{"data":"' + "x" * limits.CLIENT_MESSAGE + '"}}'
    size = len(text) // fragments + 1
    with world.relay.connect("rover", world.operator) as client:
        with contextlib.suppress(ConnectionClosed):
            pieces = [text[start : start + size] for start in range(0, len(text), size)]
            client.connection.send(text if fragments == 1 else iter(pieces))
        closed = close_of(client)
        assert closed.code == 1009
        assert closed.reason
    logs(world, str(limits.CLIENT_MESSAGE), since)


# --- slow clients -----------------------------------------------------------------------------------------


class Trickle(threading.Thread):
    """Opens a connection, sends some bytes per second, and records received bytes until it is cut."""

    def __init__(self, port: int, data: bytes, at_once: bytes = b"") -> None:
        super().__init__(daemon=True)
        self._socket = socket.create_connection(("127.0.0.1", port))
        self._data = data
        self._socket.sendall(at_once)
        self._begun = time.monotonic()
        self.lasted = float("inf")
        self.heard = b""
        self.start()

    def run(self) -> None:
        """Sends a byte per second, for 30 s at most."""
        self._socket.settimeout(1.0)
        for place in range(30):
            try:
                self._socket.sendall(self._data[place : place + 1])
                heard = self._socket.recv(65536)
            except TimeoutError:
                continue
            except OSError:
                heard = b""
            self.heard += heard
            if not heard:
                self.lasted = time.monotonic() - self._begun
                break
        self._socket.close()


def test_client_without_a_request_is_cut_after_ten_seconds(world: Any) -> None:
    """A byte per second extends no deadline: neither in HTTP's head nor its body, nor on the robots' port."""
    relay = world.relay
    since = len(relay.log)
    head = b"GET /healthz HTTP/1.1\r\nHost: example.org\r\n"
    post = b"POST /api/v1/session HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 500\r\n\r\n"
    upgrade = (
        b"GET /robots/rover HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    )
    attackers = {
        "head": [Trickle(relay.http_port, head) for _ in range(20)],
        "body": [Trickle(relay.http_port, b"x" * 100, post) for _ in range(5)],
        "nothing to HTTP": [Trickle(relay.http_port, b"") for _ in range(5)],
        "nothing to robots": [Trickle(relay.robots_port, b"") for _ in range(5)],
        "a robot's frame": [Trickle(relay.robots_port, b"\x00\x00\x01\x00" + b"x" * 100) for _ in range(5)],
        "a websocket without credentials": [Trickle(relay.http_port, b"", upgrade) for _ in range(5)],
    }
    for each in [each for kind in attackers.values() for each in kind]:
        each.join(40)
    for kind, those in attackers.items():
        for each in those:
            assert 8 < each.lasted < 20, f"{kind} lasted {each.lasted:.1f} s"
    assert all(b"no proof of identity within 10 s" in each.heard for each in attackers["nothing to robots"])
    assert all(b"no proof of identity within 10 s" in each.heard for each in attackers["a robot's frame"])
    assert all(b"log in" in each.heard for each in attackers["a websocket without credentials"])
    assert all(each.heard.startswith(b"HTTP/1.1 408") for each in attackers["head"] + attackers["body"])
    logs(world, "no proof of identity within 10 s", since)
    logs(world, "whole request", since)
    logs(world, "no credentials came with the connection", since)


@pytest.mark.parametrize("announced", [True, False], ids=["announced", "in chunks"])
def test_a_request_that_is_too_big_is_refused_with_a_reason(world: Any, announced: bool) -> None:
    """A body over the limit gets 413, before or while it arrives."""
    since = len(world.relay.log)
    how = "Content-Length: 1000000" if announced else "Transfer-Encoding: chunked"
    head = f"POST /api/v1/session HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n{how}\r\n\r\n"
    with socket.create_connection(("127.0.0.1", world.relay.http_port), timeout=10) as plain:
        with contextlib.suppress(ConnectionError):
            plain.sendall(head.encode())
            for _ in range(5):
                plain.sendall(b"8000\r\n" + b"x" * 0x8000 + b"\r\n")
        answer = b""
        with contextlib.suppress(ConnectionError):
            while data := plain.recv(65536):
                answer += data
    assert answer.startswith(b"HTTP/1.1 413")
    assert b"at most %d bytes" % limits.HTTP_BODY in answer
    logs(world, f"at most {limits.HTTP_BODY} bytes", since)


def test_connections_that_came_and_went_are_not_held_against_an_address(world: Any) -> None:
    """More connections than the limit, one after the other, are all served."""
    for _ in range(600):
        with socket.create_connection(("127.0.0.1", world.relay.http_port)) as plain:
            plain.sendall(b"GET /robots/x HTTP/1.0\r\n\r\n")
            assert plain.recv(100).startswith(b"HTTP/1.0 200")
    for _ in range(200):
        with connect(world.relay.url("rover"), origin=None) as websocket:
            websocket.send(json.dumps({"op": "auth", "mac": "swb_wrong"}))
            with pytest.raises(ConnectionClosed):
                websocket.recv(10)
    with world.relay.connect("rover", world.viewer) as client:
        assert client.call("/relay/ping")["result"]


def test_too_many_connections_of_one_address_are_refused_with_a_reason(world: Any) -> None:
    """One address cannot use all file descriptors of the relay; closed connections make room."""
    held = [socket.create_connection(("127.0.0.1", world.relay.http_port)) for _ in range(520)]
    try:
        # The last ones exceed the limit, whatever other connections exist.
        held[-1].settimeout(10)
        assert held[-1].recv(200).startswith(b"HTTP/1.1 429")
    finally:
        for each in held:
            each.close()

    def served() -> bool:
        with socket.create_connection(("127.0.0.1", world.relay.http_port)) as plain:
            plain.sendall(b"GET /robots/x HTTP/1.0\r\n\r\n")
            return plain.recv(100).startswith(b"HTTP/1.0 200")

    wait_for("the address is served again", served)


@pytest.mark.parametrize("path", ["the largest file of the portal", "/api/openapi.json", "/nothing"])
def test_answers_that_are_not_read_use_little_memory(world: Any, path: str) -> None:
    """Thousands of pipelined requests on twenty connections without reading: each waits for the one before."""
    if not path.startswith("/"):
        assets = Path(PORTAL) / "assets"
        path = f"/assets/{max(assets.iterdir(), key=lambda each: each.stat().st_size).name}"
    one = f"GET {path} HTTP/1.1\r\nHost: x\r\n\r\n".encode()
    relay = psutil.Process(world.relay.process.popen.pid)
    before = relay.memory_info().rss
    highest = 0
    with contextlib.ExitStack() as stack:
        for _ in range(20):
            plain = stack.enter_context(socket.socket())
            plain.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            plain.connect(("127.0.0.1", world.relay.http_port))
            plain.settimeout(0.2)
            with contextlib.suppress(TimeoutError):
                plain.sendall(one * (203_000 // len(one)))
            # The answer to this request shows that earlier input has been handled.
            httpx.get(f"http://127.0.0.1:{world.relay.http_port}/robots/rover", timeout=PATIENCE)
            highest = max(highest, relay.memory_info().rss)
    assert highest - before < 16 * limits.MIB
