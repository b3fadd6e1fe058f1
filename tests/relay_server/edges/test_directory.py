"""``/api/v1/directory`` on transports in memory and on a real port: what is asked, how it is answered, when it ends."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import Deferred
from twisted.internet.threads import deferToThread

from relay_db.queries import AlreadyExists, EntryCursor, QuotaExceeded
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable
from relay_server.access import BadCredentials, Principal
from relay_server.events.service import EventFollower
from relay_server.registry import http as module
from relay_server.registry.entries import EntryQuery, Registration, TooLarge
from relay_server.registry.service import Kept, MatchNeeded, TooManyRegistryChanges
from relay_server.resources.etags import PreconditionFailed
from tests.harness.switchboard_waiting import PATIENCE
from tests.relay_server.edges.http_client import Transport, World

HERE = "/api/v1/directory"
ANN = {"Authorization": "Bearer ann"}
MAP = {"kind": "service", "name": "map", "address": "http://a/"}


class Desk:
    """Has one entry, and news the test makes."""

    def __init__(self) -> None:
        self.asked: list[Any] = []
        self.error: SwitchboardError | None = None
        self.fresh = True
        self.news_to_tell: list[tuple[str, str, dict[str, Any]]] = []
        self.missed = False
        self.followers: list[EventFollower] = []

    def _see(self, *asked: Any) -> Kept:
        if self.error is not None:
            raise self.error
        self.asked.append(asked)
        return Kept(b'{"id":"a1"}', '"tag"', "a1", self.fresh)

    async def page(
        self, principal: Principal, ask: EntryQuery
    ) -> tuple[list[dict[str, Any]], EntryCursor | None]:
        """One, with more behind it but for the last."""
        self._see(ask)
        behind = EntryCursor("", "service", "map", "a1") if ask.after is None else None
        return [{"id": "a1"}], behind

    async def one(self, principal: Principal, entry_id: str) -> Kept:
        """Any."""
        return self._see("one", entry_id)

    async def register(self, principal: Principal, new: Registration) -> Kept:
        """Any."""
        return self._see("register", principal.name, new.name, bytes(new.data), new.ttl)

    async def put(
        self, principal: Principal, entry_id: str, new: Registration | None, match: str | None, address: str
    ) -> Kept:
        """Any."""
        return self._see("put", entry_id, None if new is None else new.name, match, address)

    async def remove(self, principal: Principal, entry_id: str, match: str | None, address: str) -> None:
        """Any."""
        self._see("remove", entry_id, match, address)

    @contextmanager
    def following(self, principal: Principal, last: str | None) -> Iterator[tuple[EventFollower, bool]]:
        """Keep it."""
        self.asked.append(last)
        follower = EventFollower(7)
        self.followers.append(follower)
        try:
            yield follower, last == "old-1"
        finally:
            self.followers.remove(follower)

    def mark(self, follower: EventFollower) -> str:
        """Of this run."""
        return f"run-{follower.number}"

    async def news(self, principal: Principal, ask: EntryQuery, follower: EventFollower) -> Any:
        """What the test has made."""
        follower.fresh = False
        if self.error is not None:
            raise self.error
        told, self.news_to_tell = self.news_to_tell, []
        missed, self.missed = self.missed, False
        return told, missed, False


@pytest.fixture
def desk() -> Desk:
    """Who is asked."""
    return Desk()


@pytest.fixture
def world(tmp_path: Path, desk: Desk) -> World:
    """A site with a directory."""
    made = World(tmp_path)
    made.beside["directory"] = partial(module.beside, made.clock, desk)
    return made


def test_a_page_says_where_the_next_one_begins(world: World, desk: Desk) -> None:
    """By an opaque word, until there is none."""
    first = world.ask("GET", f"{HERE}?kind=service&limit=1", **ANN)
    assert (first.status, first.json["entries"]) == (200, [{"id": "a1"}])
    second = world.ask("GET", f"{HERE}?kind=service&limit=1&after={first.json['next']}", **ANN)
    assert second.json["next"] is None
    assert [ask.after and ask.after.name for (ask,) in desk.asked] == [None, "map"]


def test_a_page_and_an_entry_that_are_known_are_not_told_again(world: World) -> None:
    """By their entity tags."""
    for path in (HERE, f"{HERE}/a1"):
        first = world.ask("GET", path, **ANN)
        tag = first.headers["etag"]
        again = world.ask("GET", path, **ANN, If_None_Match=f'"other", {tag}')
        assert (again.status, again.body, again.headers["etag"]) == (304, b"", tag)
        assert world.ask("GET", path, **ANN, If_None_Match='"other"').status == 200


def test_what_is_registered_has_an_address(world: World, desk: Desk) -> None:
    """201 with it, or 200 for what was there."""
    answer = world.ask("POST", HERE, MAP, **ANN)
    assert (answer.status, answer.json) == (201, {"id": "a1"})
    assert (answer.headers["location"], answer.headers["etag"]) == (f"{HERE}/a1", '"tag"')
    desk.fresh = False
    answer = world.ask("POST", HERE, {**MAP, "data": {"a": 1}, "ttl": 2}, **ANN)
    assert (answer.status, answer.headers["location"]) == (200, f"{HERE}/a1")
    assert desk.asked == [
        ("register", "ann", "map", b"{}", 60.0),
        ("register", "ann", "map", b'{"a": 1}', 2.0),
    ]


def test_an_entry_is_renewed_changed_and_removed(world: World, desk: Desk) -> None:
    """Without a body, with one, and under conditions; ids of what robots have hold names."""
    answer = world.ask("PUT", f"{HERE}/a1", **ANN)
    assert (answer.status, answer.headers["etag"], answer.json) == (200, '"tag"', {"id": "a1"})
    world.ask("PUT", f"{HERE}/a1", MAP, **ANN, If_Match='"x"')
    assert world.ask("DELETE", f"{HERE}/a1", **ANN).status == 204
    world.ask("DELETE", f"{HERE}/a1", **ANN, If_Match="*")
    assert world.ask("GET", f"{HERE}/topic:rover:/scan/front", **ANN).status == 200
    assert desk.asked == [
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
        (TooManyRegistryChanges("x"), 429),
        (Unavailable("x"), 503),
    ],
    ids=lambda each: type(each).__name__,
)
def test_what_can_not_be_is_said_in_words(
    world: World, desk: Desk, error: SwitchboardError, status: int
) -> None:
    """As problem details; who is too quick is told when to come again."""
    desk.error = error
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
def test_a_body_that_can_not_be_is_refused(world: World, desk: Desk, body: Any) -> None:
    """Before the desk is asked, to register and to change alike."""
    for method, path in (("POST", HERE), ("PUT", f"{HERE}/a1")):
        answer = world.ask(method, path, body, **ANN)
        assert (answer.status, desk.asked) == (400, [])
    assert world.ask("POST", HERE, raw=b"", **ANN).status == 400


@pytest.mark.parametrize("query", ["limit=0", "kind=a&kind=b", "sauce=x", "name=%ff", "after=%21"])
def test_what_makes_no_sense_is_refused(world: World, query: str) -> None:
    """As problem details."""
    answer = world.ask("GET", f"{HERE}?{query}", **ANN)
    assert (answer.status, answer.headers["content-type"]) == (400, "application/problem+json")


def test_nobody_gets_in_without_credentials(world: World, desk: Desk) -> None:
    """And a cookie changes nothing without a listed Origin."""
    for method, path in (
        ("GET", HERE), ("POST", HERE), ("GET", f"{HERE}/a1"), ("PUT", f"{HERE}/a1"), ("DELETE", f"{HERE}/a1"),
    ):  # fmt: skip
        assert world.ask(method, path).status == 401
        if method != "GET":
            answer = world.ask(method, path, Cookie="sb=ann", Origin="https://evil.example")
            assert answer.status == 403
    assert desk.asked == []


def test_there_is_nothing_else(world: World) -> None:
    """Of methods."""
    assert world.ask("DELETE", HERE, **ANN).status == 405
    assert world.ask("POST", f"{HERE}/a1", MAP, **ANN).status == 405


# --- streams ----------------------------------------------------------------------------------------------


def stream(world: World, last: str = "", query: str = "") -> Transport:
    """Somebody follows."""
    transport = world.connect()
    lines = ["Host: 127.0.0.1:9090", "Authorization: Bearer ann", "Accept: text/event-stream"]
    lines += [f"Last-Event-ID: {last}"] if last else []
    world.send(transport, (f"GET {HERE}{query} HTTP/1.1\r\n" + "\r\n".join(lines) + "\r\n\r\n").encode())
    world.clock.advance(0)
    return transport


def test_changes_are_told_as_they_come_and_silence_is_filled(world: World, desk: Desk) -> None:
    """Every 5 s by the mark up to which all was heard."""
    transport = stream(world, "run-7")
    assert desk.asked == ["run-7"] and b"missed" not in transport.value()
    desk.news_to_tell = [("run-8", "registered", {"id": "a1"}), ("run-9", "expired", {"id": "a1"})]
    desk.followers[0].wake()
    assert b'id: run-8\nevent: registered\ndata: {"id":"a1"}\n\n' in transport.value()
    assert b'id: run-9\nevent: expired\ndata: {"id":"a1"}\n\n' in transport.value()
    transport.clear()
    world.clock.advance(4)
    assert transport.value() == b""
    world.clock.advance(1)
    assert b"id: run-7\n\n" in transport.value()
    transport.loseConnection()
    assert desk.followers == []


def test_who_may_have_missed_something_is_told(world: World, desk: Desk) -> None:
    """When he begins, and when he was too slow."""
    transport = stream(world, "old-1")
    assert transport.value().count(b"event: missed\ndata: {}\n\n") == 1
    desk.missed = True
    desk.news_to_tell = [("run-8", "removed", {"id": "a1"})]
    desk.followers[0].wake()
    told = transport.value()
    assert told.count(b"event: missed") == 2 and told.index(b"run-8") > told.rindex(b"event: missed")


def test_a_stream_ends_in_words_when_its_reader_may_not_read_any_more(world: World, desk: Desk) -> None:
    """Within seconds or with the next change; while the database fails it goes on in silence."""
    transport = stream(world)
    desk.error = Unavailable("locked")
    desk.followers[0].wake()
    for _ in range(3):
        world.clock.advance(1)
    assert b"ended" not in transport.value() and len(desk.followers) == 1
    desk.error = BadCredentials("your session was ended")
    world.clock.advance(1)
    assert b'event: ended\ndata: "your session was ended"\n\n' in transport.value()
    assert desk.followers == []


def test_a_token_that_ends_ends_the_stream(world: World, desk: Desk) -> None:
    """Who reads is proved again."""
    transport = stream(world)
    del world.desk.tokens["ann"]
    for _ in range(6):
        world.clock.advance(1)
    assert b"event: ended" in transport.value() and desk.followers == []


@pytest.mark.parametrize("query", ["?limit=5", "?after=x", "?sauce=x"])
def test_what_does_not_go_with_a_stream_is_refused(world: World, desk: Desk, query: str) -> None:
    """Rather than passed over."""
    assert b" 400 " in stream(world, query=query).value().partition(b"\r\n")[0]
    assert desk.followers == []


@pytest_twisted.ensureDeferred
async def test_it_is_served_on_a_real_port(tmp_path: Path, desk: Desk) -> None:
    """To a client of the standard library."""
    made = World(tmp_path, clock=reactor)
    made.beside["directory"] = partial(module.beside, made.clock, desk)
    port = reactor.listenTCP(0, made.site, interface="127.0.0.1")  # type: ignore[attr-defined]

    def ask() -> tuple[int, str | None, Any, int]:
        connection = http.client.HTTPConnection("127.0.0.1", port.getHost().port, timeout=PATIENCE)
        try:
            connection.request("POST", HERE, json.dumps(MAP), {**ANN, "Content-Type": "application/json"})
            answer = connection.getresponse()
            told = json.loads(answer.read())
            place = answer.getheader("location")
            connection.request("PUT", place or "", headers=ANN)
            renewed = connection.getresponse()
            renewed.read()
            return answer.status, place, told, renewed.status
        finally:
            connection.close()

    try:
        asking: Deferred[Any] = deferToThread(ask)
        assert await asking == (201, f"{HERE}/a1", {"id": "a1"}, 200)
    finally:
        await port.stopListening()
