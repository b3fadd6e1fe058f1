"""Hostile input costs little CPU time of the reactor, is answered, and is logged rarely.

Costs are counted in plain requests to the same relay. Bounds are several times the measured values, and a fraction of
the values from before parsers had limits. ``make bench BENCH=hostile`` has seconds.
"""

from __future__ import annotations

import json
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.worlds.growth import FASTER_THAN_SQUARE, QUARTER, ratio_stays_below
from tests.worlds.hostile_inputs import (
    FIELDS,
    SHAPES,
    UPGRADE,
    Attack,
    Reactor,
    exchange,
    request,
    send,
    unproved,
)
from tests.worlds.relay_process import Relay
from tests.worlds.small_robot import SmallRobot
from tests.worlds.waiting import PATIENCE, wait_for

MOST = 100
"""Plain requests that one input may cost; the dearest costs 14, and those that were slow 200 to 15,000."""

NOTICED = 25
"""Plain requests below which growth does not matter."""


@pytest.fixture(scope="module")
def relay(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Relay]:
    """A relay without a rate limit."""
    started = Relay(tmp_path_factory.mktemp("hostile"), "--requests-per-second", "0")
    yield started
    started.stop()


class Meter:
    """The cost of inputs for the relay's reactor."""

    def __init__(self, relay: Relay) -> None:
        assert relay.process is not None
        self._relay = relay
        self._reactor = Reactor(relay.process.popen.pid)
        self._request = min(self._reactor.cost(self._plain) for _ in range(20))

    def is_cheap(self, work: Callable[[], object], limit: float = MOST) -> bool:
        """Whether some work costs less than this many plain requests."""
        return self._costs_less(limit, work) or ratio_stays_below(
            limit, work, self._plain, self._reactor.cost
        )

    def is_slow(self, attack: Attack, send: Callable[[float], object]) -> bool:
        """Whether an input costs too much, or its cost grows faster than its size.

        :param send: sends this part of it
        """

        def whole() -> None:
            send(1.0)

        if self._costs_less(NOTICED, whole):
            return False
        if not attack.in_turns and not self.is_cheap(whole):
            return True
        return not ratio_stays_below(FASTER_THAN_SQUARE, whole, lambda: send(1 / QUARTER), self._reactor.cost)

    def _costs_less(self, limit: float, work: Callable[[], object]) -> bool:
        return self._reactor.cost(work) < limit * self._request

    def _plain(self) -> None:
        ask(self._relay, request("GET", b"/healthz", {}))


@pytest.fixture
def meter(relay: Relay) -> Iterator[Meter]:
    """Costs for the relay's reactor. The log must have no traceback after a test."""
    logged = len(relay.log)
    yield Meter(relay)
    assert "Traceback" not in relay.log[logged:]


def ask(relay: Relay, data: bytes) -> bytes:
    """Sends bytes to the port for clients on a new connection."""
    with socket.create_connection(("127.0.0.1", relay.http_port), timeout=PATIENCE) as connection:
        return exchange(connection, data)


def test_no_unauthenticated_input_takes_long_or_fails(relay: Relay, meter: Meter) -> None:
    """Each field, path, query, form, body and frame, in each form on which a parser is slow or fails."""
    began, logged = time.monotonic(), relay.log.count("\n")
    slow, failed = [], []
    for attack in unproved():
        answers: list[bytes] = []

        def once(part: float, attack: Attack = attack, answers: list[bytes] = answers) -> None:
            answers.append(send(relay.http_port, relay.robots_port, attack, part))

        if meter.is_slow(attack, once):
            slow.append(attack.name)
        if answers[0].startswith(b"HTTP/1.1 5") or (not attack.waits and not answers[0]):
            failed.append(f"{attack.name}: {answers[0][:60]!r}")
    assert slow == []
    assert failed == []
    assert relay.log.count("\n") - logged < KINDS * lines_since(began)


JSON = {"Content-Type": b"application/json"}
MARKS = "a" + "\u0316\u0300" * 15_000
FOUND = {
    "a handshake's cookie": request("GET", b"/robots/x", UPGRADE | {"Cookie": b"a" + b"=" * 15_800 + b'"'}),
    "a short one's": request("GET", b"/robots/x", UPGRADE | {"Cookie": b"a" + b"=" * 8000 + b'"'}),
    "a login's user": request(
        "POST",
        b"/api/v1/session",
        JSON,
        json.dumps({"user": MARKS, "password": "b"}, ensure_ascii=False).encode(),
    ),
    "its realm": request(
        "POST",
        b"/api/v1/session",
        JSON,
        json.dumps({"user": "a@" + MARKS, "password": "b"}, ensure_ascii=False).encode(),
    ),
    "a client's id": request(
        "POST",
        b"/oauth/token",
        {"Content-Type": b"application/x-www-form-urlencoded"},
        b"grant_type=client_credentials&client_secret=b&client_id=" + MARKS.encode(),
    ),
    "comments as content type": request("POST", b"/healthz", {"Content-Type": b"(a)" * 5300}, b"{}"),
    "tabs at the vocabulary": request(
        "GET", b"/api/v1/vocabulary/switchboard", {"Accept": b"a" + b"\t" * 15_500 + b"b"}
    ),
    "tabs as entity tags": request(
        "GET", b"/api/openapi.json", {"If-None-Match": b"a" + b"\t" * 15_500 + b"b"}
    ),
    "chunks of one byte": request("POST", b"/api/v1/session", JSON | {"Transfer-Encoding": b"chunked"})
    + b"1\r\nx\r\n" * 65_000
    + b"0\r\n\r\n",
}
"""What took 0.1 to 7 s, and what was found beside it."""


@pytest.mark.parametrize("name", FOUND)
def test_slow_inputs_are_fast_now(relay: Relay, meter: Meter, name: str) -> None:
    """The inputs are those that were slow."""
    answers: list[bytes] = []
    assert meter.is_cheap(lambda: answers.append(ask(relay, FOUND[name])))
    expected = b"HTTP/1.1 101" if name == "a short one's" else b"HTTP/1.1 4"
    assert all(each.startswith(expected) for each in answers)


def test_eight_at_once_take_no_more_than_eight(relay: Relay, meter: Meter) -> None:
    """They took 13.9 s before."""

    def all_at_once() -> None:
        threads = [
            threading.Thread(target=ask, args=(relay, FOUND["comments as content type"])) for _ in range(8)
        ]
        for each in threads:
            each.start()
        for each in threads:
            each.join()

    assert meter.is_cheap(all_at_once, 8 * MOST)


@pytest.mark.parametrize(
    "value",
    [
        b"a\x0bb",
        b"a\x0cb",
        b"a\x1cb",
        b"a\x1db",
        b"a\x1eb",
        b"a\x85b",
        b"((((((",
        b"a/b; boundary*=idna''%00",
    ],
)
def test_a_content_type_that_failed_in_a_parser_is_answered(relay: Relay, meter: Meter, value: bytes) -> None:
    """By 400, and without a traceback."""
    answer = ask(relay, request("POST", b"/api/v1/session", {"Content-Type": value}, b"{}"))
    assert answer.startswith(b"HTTP/1.1 400")


# --- the log ----------------------------------------------------------------------------------------------


LINES_A_MINUTE = 30
"""Of one kind."""

KINDS = 20
"""Of lines, about."""


def lines_since(began: float) -> int:
    """Lines of one kind that may be logged since a time; a slow machine takes minutes for a flood."""
    return LINES_A_MINUTE * (2 + int((time.monotonic() - began) / 60))


def grown(relay: Relay, data: bytes, times: int) -> int:
    """Growth of the log in lines after this many requests."""
    before = relay.log.count("\n")
    with socket.create_connection(("127.0.0.1", relay.http_port), timeout=PATIENCE) as connection:
        for _ in range(times):
            if exchange(connection, data):
                continue
            break
        else:
            return relay.log.count("\n") - before
    for _ in range(times):
        ask(relay, data)
    return relay.log.count("\n") - before


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("a long path", request("GET", b"/assets/" + b"a" * 300, {"Connection": b"keep-alive"})),
        ("a refused handshake", request("GET", b"/robots/x", UPGRADE | {"Authorization": b"Bearer x"})),
        ("a handshake that is none", request("GET", b"/robots/x", UPGRADE | {"Sec-WebSocket-Key": b"x"})),
        ("no request", b"x\r\n\r\n"),
        ("a long field", request("GET", b"/", {"Accept": b"a" * 2000})),
    ],
)
def test_a_flood_of_refusals_hardly_fills_the_log(relay: Relay, name: str, data: bytes) -> None:
    """30 lines a minute of each kind, not one for each of 500."""
    began = time.monotonic()
    assert grown(relay, data, 500) < 2 * lines_since(began)


def test_a_handshake_that_never_finishes_closing_costs_no_line_each(relay: Relay) -> None:
    """The relay's close frames stay unanswered."""
    began, before = time.monotonic(), relay.log.count("\n")
    opened = [socket.create_connection(("127.0.0.1", relay.http_port), timeout=PATIENCE) for _ in range(120)]
    refused = request("GET", b"/robots/x", UPGRADE | {"Authorization": b"Bearer x", "Origin": b"http://x"})
    for each in opened:
        assert exchange(each, refused).startswith(b"HTTP/1.1 101")
    for each in opened:
        wait_for("it is cut", lambda each=each: _ended(each))
        each.close()
    # Two kinds, and a line that counts each.
    assert relay.log.count("\n") - before <= 2 * lines_since(began)


def _ended(connection: socket.socket) -> bool:
    try:
        return not connection.recv(65536)
    except ConnectionError:
        return True


# --- all documented requests ------------------------------------------------------------------------------


HEADERS = {
    name: most
    for name, most in FIELDS.items()
    if name not in ("Authorization", "Connection", "Expect", "Upgrade")
}
TEXTS = {
    "text/turtle": [b"<a> <b> (" + b"()" * 200 + b") .", b"@prefix a: <b> .\n" * 300],
    "application/rdf+xml": [b'<a xmlns:a="b">' * 300],
    "application/ld+json": [b'{"@context":{"a":"' + b"b" * 5000 + b'"}}', b'{"@list":' * 60],
}


def test_no_request_that_is_described_takes_long_or_fails(relay: Relay, meter: Meter) -> None:
    """For each operation: names in its path, its parameters, all fields, and its body, in every form,
    authenticated.
    """
    token = relay.user("walker", admin=True).encode()
    robot = SmallRobot(relay, "rover", {}).comes()
    chance = random.Random(16)
    described = json.loads(ask(relay, request("GET", b"/api/openapi.json", {})).partition(b"\r\n\r\n")[2])
    slow, failed = [], []
    try:
        for name, data in _described(described, chance):
            answers: list[bytes] = []
            sent = data.replace(b"\r\n", b"\r\nAuthorization: Bearer " + token + b"\r\n", 1)

            def once(sent: bytes = sent, answers: list[bytes] = answers) -> None:
                answers.append(ask(relay, sent))

            if not meter.is_cheap(once):
                slow.append(name)
            if not answers[0] or answers[0].startswith(b"HTTP/1.1 500"):
                failed.append(f"{name}: {answers[0][:60]!r}")
    finally:
        robot.goes()
    assert slow == []
    assert failed == []


def _described(described: dict[str, Any], chance: random.Random) -> Iterator[tuple[str, bytes]]:
    """Requests of all operations, each with some forms in each of its places; the forms rotate."""
    for path, methods in described["paths"].items():
        for method, operation in methods.items():
            if "x-lasts" in operation:
                continue
            asked = operation.get("parameters", [])
            media = list(operation.get("requestBody", {}).get("content", {}))
            plain = _path(path, asked, None)
            for shape in chance.sample(sorted(SHAPES), 6):
                made, name = SHAPES[shape], f"{method} {path}: {shape}"
                fields = {"Content-Type": media[0].encode()} if media else {}
                if (shaped := _path(path, asked, made(2000))) != plain:
                    yield f"{name} in the path", request(method.upper(), shaped, fields)
                queries = [each["name"] for each in asked if each["in"] == "query"]
                if queries:
                    share = 6000 // len(queries)
                    query = "&".join(f"{each}={_quoted(made(share // 3), share)}" for each in queries)
                    yield (
                        f"{name} in the query",
                        request(method.upper(), plain + b"?" + query.encode(), fields),
                    )
                for header in chance.sample(sorted(HEADERS), 3):
                    value = made(HEADERS[header])
                    yield f"{name} in {header}", request(method.upper(), plain, fields | {header: value})
                for each in media:
                    body = made(20_000)
                    yield (
                        f"{name} as {each}",
                        request(method.upper(), plain, {"Content-Type": each.encode()}, body),
                    )
            for each in media:
                for text in TEXTS.get(each, []):
                    yield (
                        f"{method} {path}: {text[:20]!r}",
                        request(method.upper(), plain, {"Content-Type": each.encode()}, text),
                    )


def _path(path: str, asked: list[dict[str, Any]], shape: bytes | None) -> bytes:
    """An address with a form in place of each name, except the robot's."""
    for each in asked:
        if each["in"] == "path":
            known = "rover" if each["name"] == "robot" else "mode"
            share = 6000 // path.count("{")
            text = known if shape is None or each["name"] == "robot" else _quoted(shape, share)
            path = path.replace("{" + each["name"] + "}", text)
    return path.encode()


def _quoted(shape: bytes, most: int) -> str:
    return "".join(f"%{byte:02X}" for byte in shape[: most // 3])
