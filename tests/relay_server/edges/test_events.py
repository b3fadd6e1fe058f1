"""``/api/v1/events`` on transports in memory: what is asked, in which form it is told, and when it ends."""

from __future__ import annotations

from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from relay_db.queries import EventCursor, StoredEventRecord
from relay_protocol.errors import NotFound, Unavailable
from relay_server.access import BadCredentials, Principal
from relay_server.events import http as module
from relay_server.events.query import EventFormatter, EventQuery
from relay_server.events.service import EventFollower, NewEvent
from relay_server.events.writer import EventQueueFull
from relay_server.http.idempotency import Idempotency
from tests.relay_server.edges.http_client import Transport, World

HERE = "/api/v1/events"
ANN = {"Authorization": "Bearer ann"}


def event(number: int) -> StoredEventRecord:
    """One about nothing."""
    return StoredEventRecord(number, "main", 1.5, "=app", "k", None, "ann", '{"n":1}', 0)


class Desk:
    """Tells of three events, one a page where that is asked for, and of news the test makes."""

    def __init__(self) -> None:
        self.asked: list[Any] = []
        self.error: Exception | None = None
        self.news_to_tell: list[StoredEventRecord] = []
        self.followers: list[EventFollower] = []

    def wall(self) -> float:
        """Unix time."""
        return 1000.0

    async def write(self, principal: Principal, events: list[NewEvent]) -> list[dict[str, Any]]:
        """Any."""
        if self.error is not None:
            raise self.error
        self.asked.append((principal.name, [each.kind for each in events]))
        return [{"id": number} for number, _ in enumerate(events)]

    async def may_write(self, principal: Principal, events: list[NewEvent]) -> None:
        """As long as there is no error."""
        if self.error is not None:
            raise self.error

    async def count(self, principal: Principal, ask: EventQuery) -> tuple[int, EventCursor | None]:
        """Always the same; there may be more behind what is not asked from a place on."""
        return 7, EventCursor(3.0, 5) if ask.after is None else None

    async def page(
        self, principal: Principal, ask: EventQuery, limit: int, *, uses: bool = True
    ) -> tuple[list[StoredEventRecord], EventFormatter, EventCursor | None]:
        """One at a time."""
        self.asked.append((ask, limit, uses))
        number = 3 if ask.after is None else ask.after.number - 1
        if number == 1 and self.error is not None:
            raise self.error
        return [event(number)], EventFormatter({}), EventCursor(1.5, number) if number > 1 else None

    async def follow_from(self, principal: Principal, number: int | None) -> EventFollower:
        """From anywhere."""
        self.asked.append(number)
        return EventFollower(number or 0)

    @asynccontextmanager
    async def following(self, following: EventFollower) -> Any:
        """Keep it."""
        self.followers.append(following)
        try:
            yield following
        finally:
            self.followers.remove(following)

    async def news(self, principal: Principal, ask: EventQuery, following: EventFollower) -> Any:
        """What the test has made."""
        following.fresh = False
        if self.error is not None:
            raise self.error
        told, self.news_to_tell = self.news_to_tell, []
        following.number = max([following.number, *(each.number for each in told)])
        return told, EventFormatter({}), False


@pytest.fixture
def desk() -> Desk:
    """Who is asked."""
    return Desk()


@pytest.fixture
def world(tmp_path: Path, desk: Desk) -> World:
    """A site with a memory."""
    made = World(tmp_path)
    made.beside["events"] = partial(module.beside, made.clock, desk, Idempotency(made.clock))
    return made


def test_one_event_or_several_are_written(world: World, desk: Desk) -> None:
    """Told as they came."""
    answer = world.ask("POST", HERE, {"kind": "x"}, **ANN)
    assert (answer.status, answer.json) == (201, {"id": 0})
    answer = world.ask("POST", HERE, [{"kind": "x"}, {"kind": "y", "data": {"n": 1}}], **ANN)
    assert (answer.status, answer.json) == (201, {"events": [{"id": 0}, {"id": 1}]})
    assert desk.asked == [("ann", ["x"]), ("ann", ["x", "y"])]


def test_what_is_sent_again_with_its_key_is_written_once(world: World, desk: Desk) -> None:
    """And answered as before; with another body it is refused, and so is who may not any more."""
    key = {"Idempotency-Key": '"a"', **ANN}
    told = [world.ask("POST", HERE, {"kind": "x"}, **key) for _ in "ab"]
    assert [(each.status, each.json) for each in told] == [(201, {"id": 0})] * 2
    assert desk.asked == [("ann", ["x"])]
    assert world.ask("POST", HERE, {"kind": "y"}, **key).status == 422
    desk.error = NotFound("no such robot")
    assert world.ask("POST", HERE, {"kind": "x"}, **key).status == 404


def test_when_too_many_wait_it_is_said_when_to_come_again(world: World, desk: Desk) -> None:
    """A database that fails is told without."""
    desk.error = EventQueueFull("too many")
    answer = world.ask("POST", HERE, {"kind": "x"}, **ANN)
    assert (answer.status, answer.headers["retry-after"], answer.json["code"]) == (503, "2", "full")


def test_a_page_says_where_the_next_one_begins(world: World, desk: Desk) -> None:
    """By an opaque word, until there is none."""
    numbers, after = [], ""
    while after is not None:
        page = world.ask("GET", f"{HERE}?limit=1&kind=k{after and f'&after={after}'}", **ANN).json
        numbers += [each["id"] for each in page["events"]]
        after = page["next"]
    assert numbers == [3, 2, 1]
    assert all(uses and limit == 1 for _, limit, uses in desk.asked)
    counted = world.ask("GET", f"{HERE}?count=true", **ANN).json
    assert counted["count"] == 7
    rest = world.ask("GET", f"{HERE}?count=true&after={counted['next']}", **ANN).json
    assert rest == {"count": 7, "next": None}


def test_an_export_has_all(world: World, desk: Desk) -> None:
    """As lines, and as a table without formulas; it is no use of them."""
    for accept in ("application/jsonl", "application/x-ndjson"):
        answer = world.ask("GET", HERE, **ANN, Accept=accept)
        assert answer.headers["content-type"] == accept and answer.body.count(b'"source":"=app"') == 3
    table = world.ask("GET", HERE, **ANN, Accept="text/csv")
    assert b"id,at,source,kind,robot,user,used,data\r\n" in table.body
    assert table.body.count(b'\'=app,k,,ann,0,"{""n"":1}"\r\n') == 3
    assert not any(uses for _, _, uses in desk.asked)


@pytest.mark.parametrize(
    ("accept", "type"),
    [
        ("application/json, text/csv;q=0.1", "application/json"),
        ("text/event-stream;q=0, */*", "application/json"),
        ("text/html, image/png", "application/json"),
        ("TEXT/CSV", "text/csv"),
    ],
)
def test_the_form_that_is_wanted_most_is_given(world: World, accept: str, type: str) -> None:
    """By the qualities of 'Accept'; a page of JSON to whoever takes none that there is."""
    assert world.ask("GET", HERE, **ANN, Accept=accept).headers["content-type"].partition(";")[0] == type


def test_an_export_that_can_not_go_on_breaks_off(world: World, desk: Desk) -> None:
    """What is not whole must not look so: the last chunk is missing."""
    desk.error = Unavailable("the disk is full")
    answer = world.ask("GET", HERE, **ANN, Accept="application/jsonl")
    assert answer.body.count(b'"source":"=app"') == 2 and not answer.body.endswith(b"0\r\n\r\n")


@pytest.mark.parametrize(
    "query", ["limit=0", "kind=a&kind=b", "sauce=x", "kind=%ff", "after=%21", "data.a=1&data.a=2", "last=x"]
)
def test_what_makes_no_sense_is_refused(world: World, query: str) -> None:
    """As problem details."""
    answer = world.ask("GET", f"{HERE}?{query}", **ANN)
    assert (answer.status, answer.headers["content-type"]) == (400, "application/problem+json")


@pytest.mark.parametrize(
    ("accept", "query"),
    [("text/csv", "limit=5"), ("application/jsonl", "count=true"), ("text/event-stream", "last=60")],
)
def test_what_does_not_go_with_a_form_is_refused(world: World, accept: str, query: str) -> None:
    """Rather than passed over."""
    assert world.ask("GET", f"{HERE}?{query}", **ANN, Accept=accept).status == 400


def test_nobody_gets_in_without_credentials(world: World, desk: Desk) -> None:
    """And a cookie writes nothing without a listed Origin."""
    assert world.ask("GET", HERE).status == 401
    assert world.ask("POST", HERE, {"kind": "x"}).status == 401
    answer = world.ask("POST", HERE, {"kind": "x"}, Cookie="sb=ann", Origin="https://evil.example")
    assert answer.status == 403 and desk.asked == []


def stream(world: World, last: str = "") -> Transport:
    """Somebody follows."""
    transport = world.connect()
    lines = ["Host: 127.0.0.1:9090", "Authorization: Bearer ann", "Accept: text/event-stream"]
    lines += [f"Last-Event-ID: {last}"] if last else []
    world.send(transport, (f"GET {HERE} HTTP/1.1\r\n" + "\r\n".join(lines) + "\r\n\r\n").encode())
    world.clock.advance(0)
    return transport


def test_news_are_told_as_they_come_and_silence_is_filled(world: World, desk: Desk) -> None:
    """Every 5 s by the number up to which all was heard; the next look begins at once."""
    transport = stream(world, "41")
    assert desk.asked == [41]
    desk.news_to_tell = [event(42), event(43)]
    desk.followers[0].wake()
    assert transport.value().count(b"id: 42\nevent: event\ndata: {") == 1
    assert b"id: 43\nevent: event" in transport.value()
    transport.clear()
    world.clock.advance(5)
    assert b"id: 43\n\n" in transport.value()
    transport.loseConnection()
    assert desk.followers == []


def test_where_others_are_busy_a_reader_hears_that_his_stream_goes_on(world: World, desk: Desk) -> None:
    """Every 5 s, and nothing in between, however often something is written that is not for him."""
    transport, told = stream(world, "41"), []
    for second in range(1, 13):
        transport.clear()
        world.clock.advance(1)
        desk.followers[0].number = 41 + second
        desk.followers[0].wake()
        if transport.value():
            told.append(second)
            assert transport.value().count(b"id: ") == 1
    assert told == [5, 10]
    transport.loseConnection()


@pytest.mark.parametrize("last", ["x", "-1", "9" * 30])
def test_a_last_event_that_can_not_be_is_none(world: World, desk: Desk, last: str) -> None:
    """The stream begins with what is new."""
    stream(world, last)
    assert desk.asked == [None]


def test_a_stream_ends_in_words_when_its_reader_may_not_read_any_more(world: World, desk: Desk) -> None:
    """Within a second or with the next event; while the database fails it goes on in silence."""
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


def test_who_takes_nothing_is_waited_for_and_cut_in_the_end(world: World, desk: Desk) -> None:
    """What is new meanwhile is not looked up for him."""
    transport = stream(world)
    transport.producer.pauseProducing()
    desk.news_to_tell = [event(1)]
    desk.followers[0].wake()
    transport.clear()
    desk.news_to_tell = [event(2)]
    desk.followers[0].wake()
    world.clock.advance(29)
    assert transport.value() == b"" and desk.news_to_tell != []
    transport.producer.resumeProducing()
    assert b"id: 2\n" in transport.value()
    transport.producer.pauseProducing()
    desk.news_to_tell = [event(3)]
    desk.followers[0].wake()
    world.clock.advance(30)
    assert not transport.connected
