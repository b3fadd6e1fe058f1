"""``/api/v1/directory`` on transports in memory and on a real port: requests, answers and the end of streams."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import Deferred
from twisted.internet.threads import deferToThread

from relay_db.queries import AlreadyExists, EntryCursor, QuotaExceeded
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable
from relay_server.access import Principal
from relay_server.common.etags import PreconditionFailed
from relay_server.events.bus import EventFollower
from relay_server.service_registry.entries import EntryQuery, Registration, TooLarge
from relay_server.service_registry.http import ServiceRegistryEndpoints
from relay_server.service_registry.service import EntryReply, MatchNeeded, TooManyEntryChanges
from tests.worlds.http_client import Transport, World
from tests.worlds.waiting import PATIENCE

HERE = "/api/v1/directory"
ANN = {"Authorization": "Bearer ann"}
MAP = {"kind": "service", "name": "map", "address": "http://a/"}


class FakeRegistry:
    """Has one entry, and changes that the test makes."""

    def __init__(self) -> None:
        self.asked: list[Any] = []
        self.error: SwitchboardError | None = None
        self.fresh = True
        self.news_to_tell: list[tuple[str, str, dict[str, Any]]] = []
        self.missed = False
        self.followers: list[EventFollower] = []

    def _see(self, *asked: Any) -> EntryReply:
        if self.error is not None:
            raise self.error
        self.asked.append(asked)
        return EntryReply(b'{"id":"a1"}', '"tag"', "a1", self.fresh)

    async def page(
        self, principal: Principal, ask: EntryQuery
    ) -> tuple[list[dict[str, Any]], EntryCursor | None]:
        """One entry; all pages but the last have a cursor."""
        self._see(ask)
        behind = EntryCursor("", "service", "map", "a1") if ask.after is None else None
        return [{"id": "a1"}], behind

    async def one(self, principal: Principal, entry_id: str) -> EntryReply:
        """Any entry."""
        return self._see("one", entry_id)

    async def register(self, principal: Principal, new: Registration) -> EntryReply:
        """Accepts any entry."""
        return self._see("register", principal.name, new.name, bytes(new.data), new.ttl)

    async def put(
        self, principal: Principal, entry_id: str, new: Registration | None, match: str | None, address: str
    ) -> EntryReply:
        """Accepts any entry."""
        return self._see("put", entry_id, None if new is None else new.name, match, address)

    async def remove(self, principal: Principal, entry_id: str, match: str | None, address: str) -> None:
        """Accepts any id."""
        self._see("remove", entry_id, match, address)

    @contextmanager
    def following(self, principal: Principal, last: str | None) -> Iterator[tuple[EventFollower, bool]]:
        """Records the follower."""
        self.asked.append(last)
        follower = EventFollower(7)
        self.followers.append(follower)
        try:
            yield follower, last == "old-1"
        finally:
            self.followers.remove(follower)

    def event_id(self, follower: EventFollower) -> str:
        """A cursor of this process."""
        return f"run-{follower.number}"

    async def news(self, principal: Principal, ask: EntryQuery, follower: EventFollower) -> Any:
        """Changes of the test."""
        follower.fresh = False
        if self.error is not None:
            raise self.error
        reported, self.news_to_tell = self.news_to_tell, []
        missed, self.missed = self.missed, False
        return reported, missed, False


@pytest.fixture
def registry() -> FakeRegistry:
    """The registry of the site."""
    return FakeRegistry()


@pytest.fixture
def world(tmp_path: Path, registry: FakeRegistry) -> World:
    """A site with a service registry."""
    made = World(tmp_path)
    made.router.add(ServiceRegistryEndpoints(made.clock, cast(Any, registry)))
    return made


def test_a_page_has_the_cursor_of_the_next(world: World, registry: FakeRegistry) -> None:
    """The cursor is opaque; the last page has none."""
    first = world.ask("GET", f"{HERE}?kind=service&limit=1", **ANN)
    assert (first.status, first.json["entries"]) == (200, [{"id": "a1"}])
    second = world.ask("GET", f"{HERE}?kind=service&limit=1&after={first.json['next']}", **ANN)
    assert second.json["next"] is None
    assert [ask.after and ask.after.name for (ask,) in registry.asked] == [None, "map"]


def test_a_page_and_an_entry_that_are_known_are_not_sent_again(world: World) -> None:
    """By their entity tags."""
    for path in (HERE, f"{HERE}/a1"):
        first = world.ask("GET", path, **ANN)
        tag = first.headers["etag"]
        again = world.ask("GET", path, **ANN, If_None_Match=f'"other", {tag}')
        assert (again.status, again.body, again.headers["etag"]) == (304, b"", tag)
        assert world.ask("GET", path, **ANN, If_None_Match='"other"').status == 200


def test_registered_entry_has_an_address(world: World, registry: FakeRegistry) -> None:
    """201 with its address, or 200 for an existing entry."""
    answer = world.ask("POST", HERE, MAP, **ANN)
    assert (answer.status, answer.json) == (201, {"id": "a1"})
    assert (answer.headers["location"], answer.headers["etag"]) == (f"{HERE}/a1", '"tag"')
    registry.fresh = False
    answer = world.ask("POST", HERE, {**MAP, "data": {"a": 1}, "ttl": 2}, **ANN)
    assert (answer.status, answer.headers["location"]) == (200, f"{HERE}/a1")
    assert registry.asked == [
        ("register", "ann", "map", b"{}", 60.0),
        ("register", "ann", "map", b'{"a": 1}', 2.0),
    ]


def test_an_entry_is_renewed_changed_and_removed(world: World, registry: FakeRegistry) -> None:
    """Without a body, with one, and with conditions; ids of robots' own entries contain names."""
    answer = world.ask("PUT", f"{HERE}/a1", **ANN)
    assert (answer.status, answer.headers["etag"], answer.json) == (200, '"tag"', {"id": "a1"})
    world.ask("PUT", f"{HERE}/a1", MAP, **ANN, If_Match='"x"')
    assert world.ask("DELETE", f"{HERE}/a1", **ANN).status == 204
    world.ask("DELETE", f"{HERE}/a1", **ANN, If_Match="*")
    assert world.ask("GET", f"{HERE}/topic:rover:/scan/front", **ANN).status == 200
    assert registry.asked == [
        ("put", "a1", None, None, "192.0.2.9"),
        ("put", "a1", "map", '"x"', "192.0.2.9"),
        ("remove", "a1", None, "192.0.2.9"),
        ("remove", "a1", "*", "192.0.2.9"),
        ("one", "topic:rover:/scan/front"),
    ]


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (NotFound("x"), 404),
        (Refused("x"), 403),
        (Invalid("x"), 400),
        (AlreadyExists("x"), 409),
        (QuotaExceeded("x"), 409),
        (TooLarge("x"), 413),
        (MatchNeeded("x"), 428),
        (PreconditionFailed("x"), 412),
        (TooManyEntryChanges("x"), 429),
        (Unavailable("x"), 503),
    ],
    ids=lambda each: type(each).__name__,
)
def test_impossible_value_is_refused_with_a_reason(
    world: World, registry: FakeRegistry, error: SwitchboardError, status: int
) -> None:
    """As problem details; a client over the rate limit gets the time to wait."""
    registry.error = error
    for method, path, body in (
        ("POST", HERE, MAP),
        ("PUT", f"{HERE}/a1", None),
        ("DELETE", f"{HERE}/a1", None),
    ):
        answer = world.ask(method, path, body, **ANN)
        assert (answer.status, answer.json["detail"], answer.json["code"]) == (status, "x", error.code)
        assert answer.headers["content-type"] == "application/problem+json"
        assert ("retry-after" in answer.headers) == (status == 429)


@pytest.mark.parametrize(
    "body",
    [
        {"kind": "service", "name": "map"},
        {**MAP, "owner": "bob"},
        {**MAP, "name": ""},
        {**MAP, "name": "x" * 129},
        {**MAP, "kind": "x" * 64},
        {**MAP, "address": "http://" + "x" * 1024},
        {**MAP, "description": "x" * 256},
        {**MAP, "robot": "x" * 64},
        {**MAP, "robot": 3},
        {**MAP, "ttl": 1.9},
        {**MAP, "ttl": 86401},
        {**MAP, "ttl": "60"},
        [MAP],
        "map",
    ],
    ids=range(14),
)
def test_a_body_that_can_not_be_is_refused(world: World, registry: FakeRegistry, body: Any) -> None:
    """Before the service is called, for new and changed entries."""
    for method, path in (("POST", HERE), ("PUT", f"{HERE}/a1")):
        answer = world.ask(method, path, body, **ANN)
        assert (answer.status, registry.asked) == (400, [])
    assert world.ask("POST", HERE, raw=b"", **ANN).status == 400


@pytest.mark.parametrize("query", ["limit=0", "kind=a&kind=b", "sauce=x", "name=%ff", "after=%21"])
def test_invalid_value_is_refused(world: World, query: str) -> None:
    """As problem details."""
    answer = world.ask("GET", f"{HERE}?{query}", **ANN)
    assert (answer.status, answer.headers["content-type"]) == (400, "application/problem+json")


def test_clients_without_credentials_are_refused(world: World, registry: FakeRegistry) -> None:
    """A cookie needs a listed Origin for changes."""
    for method, path in (
        ("GET", HERE), ("POST", HERE), ("GET", f"{HERE}/a1"), ("PUT", f"{HERE}/a1"), ("DELETE", f"{HERE}/a1"),
    ):  # fmt: skip
        assert world.ask(method, path).status == 401
        if method != "GET":
            answer = world.ask(method, path, Cookie="sb=ann", Origin="https://evil.example")
            assert answer.status == 403
    assert registry.asked == []


def test_there_is_nothing_else(world: World) -> None:
    """Other methods get 405."""
    assert world.ask("DELETE", HERE, **ANN).status == 405
    assert world.ask("POST", f"{HERE}/a1", MAP, **ANN).status == 405


# --- streams ----------------------------------------------------------------------------------------------


def stream(world: World, last: str = "", query: str = "") -> Transport:
    """A client follows the registry."""
    transport = world.connect()
    lines = ["Host: 127.0.0.1:9090", "Authorization: Bearer ann", "Accept: text/event-stream"]
    lines += [f"Last-Event-ID: {last}"] if last else []
    world.send(transport, (f"GET {HERE}{query} HTTP/1.1\r\n" + "\r\n".join(lines) + "\r\n\r\n").encode())
    world.clock.advance(0)
    return transport


def test_changes_are_sent_as_they_come_with_heartbeats_between(world: World, registry: FakeRegistry) -> None:
    """A heartbeat every 5 s has the cursor of the last change."""
    transport = stream(world, "run-7")
    assert registry.asked == ["run-7"] and b"missed" not in transport.value()
    registry.news_to_tell = [("run-8", "registered", {"id": "a1"}), ("run-9", "expired", {"id": "a1"})]
    registry.followers[0].wake()
    assert b'id: run-8\nevent: registered\ndata: {"id":"a1"}\n\n' in transport.value()
    assert b'id: run-9\nevent: expired\ndata: {"id":"a1"}\n\n' in transport.value()
    transport.clear()
    world.clock.advance(4)
    assert transport.value() == b""
    world.clock.advance(1)
    assert b"id: run-7\n\n" in transport.value()
    transport.loseConnection()
    assert registry.followers == []


def test_possible_gap_is_reported(world: World, registry: FakeRegistry) -> None:
    """At the start, and when the follower was too slow."""
    transport = stream(world, "old-1")
    assert transport.value().count(b"event: missed\ndata: {}\n\n") == 1
    registry.missed = True
    registry.news_to_tell = [("run-8", "removed", {"id": "a1"})]
    registry.followers[0].wake()
    reported = transport.value()
    assert reported.count(b"event: missed") == 2 and reported.index(b"run-8") > reported.rindex(
        b"event: missed"
    )


def test_a_token_that_ends_ends_the_stream(world: World, registry: FakeRegistry) -> None:
    """The token is checked again."""
    transport = stream(world)
    del world.service.tokens["ann"]
    for _ in range(6):
        world.clock.advance(1)
    assert b"event: ended" in transport.value() and registry.followers == []


@pytest.mark.parametrize("query", ["?limit=5", "?after=x", "?sauce=x"])
def test_parameters_that_exclude_a_stream_are_refused(
    world: World, registry: FakeRegistry, query: str
) -> None:
    assert b" 400 " in stream(world, query=query).value().partition(b"\r\n")[0]
    assert registry.followers == []


@pytest_twisted.ensureDeferred
async def test_it_is_served_on_a_real_port(tmp_path: Path, registry: FakeRegistry) -> None:
    """With a client of the standard library."""
    made = World(tmp_path, clock=reactor)
    made.router.add(ServiceRegistryEndpoints(made.clock, cast(Any, registry)))
    port = reactor.listenTCP(0, made.site, interface="127.0.0.1")  # type: ignore[attr-defined]

    def ask() -> tuple[int, str | None, Any, int]:
        connection = http.client.HTTPConnection("127.0.0.1", port.getHost().port, timeout=PATIENCE)
        try:
            connection.request("POST", HERE, json.dumps(MAP), {**ANN, "Content-Type": "application/json"})
            answer = connection.getresponse()
            reported = json.loads(answer.read())
            place = answer.getheader("location")
            connection.request("PUT", place or "", headers=ANN)
            renewed = connection.getresponse()
            renewed.read()
            return answer.status, place, reported, renewed.status
        finally:
            connection.close()

    try:
        asking: Deferred[Any] = deferToThread(ask)
        assert await asking == (201, f"{HERE}/a1", {"id": "a1"}, 200)
    finally:
        await port.stopListening()
