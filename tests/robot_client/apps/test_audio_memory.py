"""Events and messages over HTTP, with a server of the test."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest

from robot_client.apps.connection import Refused
from robot_client.apps.event_client import (
    MAX_EVENTS,
    MAX_PAGES,
    EventClient,
    EventLogUnavailable,
    RobotUrl,
    robot_url,
)


class Server(ThreadingHTTPServer):
    """Returns prepared answers one after the other, and records requests."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.answers: list[tuple[int, Any]] = []
        self.asked: list[tuple[str, str, Any]] = []


class Handler(BaseHTTPRequestHandler):
    """Handles a request."""

    server: Server

    def do_GET(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"] or 0))
        self.server.asked.append((self.command, self.path, json.loads(body) if body else dict(self.headers)))
        status, answer = self.server.answers.pop(0)
        text = answer if isinstance(answer, bytes) else json.dumps(answer).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text)

    do_POST = do_GET

    def log_message(self, *_: Any) -> None:
        """Logs nothing."""


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setenv("SWITCHBOARD_TOKEN", "secret")
    with Server() as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture
def memory(server: Server) -> EventClient:
    return EventClient(f"ws://127.0.0.1:{server.server_port}/robots/rover")


def test_the_addresses_of_http_follow_from_the_websockets() -> None:
    """With a proxy's path too."""
    assert robot_url("ws://relay:9090/robots/rover") == RobotUrl("relay:9090", False, "", "rover")
    assert robot_url("wss://a.b/x/robots/rover/") == RobotUrl("a.b", True, "/x", "rover")


@pytest.mark.parametrize(
    "url", ["http://relay/robots/r", "ws://relay/robots/", "ws://relay", "ws:///robots/r", "rover"]
)
def test_address_of_no_robot_is_refused(url: str) -> None:
    """With a reason."""
    with pytest.raises(Refused, match="is not the address of a robot"):
        robot_url(url)


def test_events_are_asked_for_page_by_page(server: Server, memory: EventClient) -> None:
    """Until there are no more."""
    server.answers = [
        (200, {"events": [{"id": 3}], "next": "p2"}),
        (200, {"events": [], "next": "p3"}),
        (200, {"events": [{"id": 1}], "next": None}),
    ]
    assert memory.events("greet*", 60.0, person="Ann & Bob") == [{"id": 3}, {"id": 1}]
    queries = [parse_qs(urlsplit(path).query) for _, path, _ in server.asked]
    assert queries[0] == {
        "kind": ["greet*"],
        "robot": ["rover"],
        "last": ["60"],
        "limit": ["1000"],
        "data.person": ["Ann & Bob"],
    }
    assert [query.get("after") for query in queries] == [None, ["p2"], ["p3"]]
    assert server.asked[0][2]["Authorization"] == "Bearer secret"


def test_an_event_and_a_message_are_sent_as_they_should_be(server: Server, memory: EventClient) -> None:
    """The event about the robot returns its number; the message goes to its topic."""
    server.answers = [(201, {"id": 12}), (204, b"")]
    assert memory.write("greeted", person="ann") == 12
    memory.publish("/say", {"data": "Hello"}, "std_msgs/msg/String")
    assert server.asked == [
        ("POST", "/api/v1/events", {"kind": "greeted", "robot": "rover", "data": {"person": "ann"}}),
        (
            "POST",
            "/api/v1/robots/rover/topics/say",
            {"value": {"data": "Hello"}, "type": "std_msgs/msg/String"},
        ),
    ]


@pytest.mark.parametrize(
    ("status", "kind"),
    [(401, Refused), (403, Refused), (404, Refused), (409, EventLogUnavailable), (429, EventLogUnavailable)],
)
def test_errors_are_reported_in_the_relays_words(
    server: Server, memory: EventClient, status: int, kind: type[Exception]
) -> None:
    """As permanent or as temporary."""
    server.answers = [(status, {"title": "no", "detail": "because of the weather"})]
    with pytest.raises(kind, match=f"{status}: because of the weather"):
        memory.write("greeted", person="ann")


@pytest.mark.parametrize(
    "answer", [b"<html>", [1], {"events": 3}, {"events": [3], "next": None}, {"events": []}, b""]
)
def test_an_answer_of_something_else_is_no_answer(server: Server, memory: EventClient, answer: Any) -> None:
    """For example a proxy's error page."""
    server.answers = [(200, answer)]
    with pytest.raises(EventLogUnavailable, match="no relay"):
        memory.events("greet*", 60.0)


def test_events_without_an_end_are_not_known(server: Server, memory: EventClient) -> None:
    """They are not read forever."""
    server.answers = [(200, {"events": [], "next": "more"})] * MAX_PAGES
    with pytest.raises(EventLogUnavailable, match="pages"):
        memory.events("greet*", 60.0)
    server.answers = [(200, {"events": [{}] * (MAX_EVENTS // 10), "next": "more"})] * 10
    with pytest.raises(EventLogUnavailable, match="10,000 events"):
        memory.events("greet*", 60.0)


def test_an_unreachable_relay_is_reported(server: Server, memory: EventClient) -> None:
    """As a temporary error."""
    server.server_close()
    with pytest.raises(EventLogUnavailable, match="does not answer"):
        memory.write("greeted", person="ann")
