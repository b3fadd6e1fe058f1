"""``/api/v1/events`` on transports in memory: queries, formats, and the end of streams."""

from __future__ import annotations

from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, cast

import pytest

from relay_db.queries import EventCursor, StoredEventRecord
from relay_protocol.errors import NotFound, Unavailable
from relay_server.access import BadCredentials, Principal
from relay_server.events.bus import EventFollower
from relay_server.events.http import EventEndpoints
from relay_server.events.query import EventFormatter, EventQuery
from relay_server.events.service import NewEvent
from relay_server.events.writer import EventQueueFull
from relay_server.http.idempotency import Idempotency
from tests.worlds.http_client import Transport, World

HERE = "/api/v1/events"
ANN = {"Authorization": "Bearer ann"}


def event(number: int) -> StoredEventRecord:
    """An event without data."""
    return StoredEventRecord(number, "main", 1.5, "=app", "k", None, "ann", '{"n":1}', 0)


class FakeEventService:
    """Has three events, one per page on request, and new ones that the test adds."""

    def __init__(self) -> None:
        self.asked: list[Any] = []
        self.error: Exception | None = None
        self.news_to_tell: list[StoredEventRecord] = []
        self.followers: list[EventFollower] = []

    def wall(self) -> float:
        """Unix time."""
        return 1000.0

    async def write(self, principal: Principal, events: list[NewEvent]) -> list[dict[str, Any]]:
        """Accepts any event."""
        if self.error is not None:
            raise self.error
        self.asked.append((principal.name, [each.kind for each in events]))
        return [{"id": number} for number, _ in enumerate(events)]

    async def may_write(self, principal: Principal, events: list[NewEvent]) -> None:
        """Allowed unless the test sets an error."""
        if self.error is not None:
            raise self.error

    async def count(self, principal: Principal, ask: EventQuery) -> tuple[int, EventCursor | None]:
        """A fixed count; from a cursor on it is a lower bound."""
        return 7, EventCursor(3.0, 5) if ask.after is None else None

    async def page(
        self, principal: Principal, ask: EventQuery, limit: int, *, uses: bool = True
    ) -> tuple[list[StoredEventRecord], EventFormatter, EventCursor | None]:
        """One event per page."""
        self.asked.append((ask, limit, uses))
        number = 3 if ask.after is None else ask.after.number - 1
        if number == 1 and self.error is not None:
            raise self.error
        return [event(number)], EventFormatter({}), EventCursor(1.5, number) if number > 1 else None

    async def follow_from(self, principal: Principal, number: int | None) -> EventFollower:
        """From any cursor."""
        self.asked.append(number)
        return EventFollower(number or 0)

    @asynccontextmanager
    async def following(self, following: EventFollower) -> Any:
        """Records the follower."""
        self.followers.append(following)
        try:
            yield following
        finally:
            self.followers.remove(following)

    async def news(self, principal: Principal, ask: EventQuery, following: EventFollower) -> Any:
        """New events of the test."""
        following.fresh = False
        if self.error is not None:
            raise self.error
        reported, self.news_to_tell = self.news_to_tell, []
        following.number = max([following.number, *(each.number for each in reported)])
        return reported, EventFormatter({}), False


@pytest.fixture
def service() -> FakeEventService:
    """The event service of the world."""
    return FakeEventService()


@pytest.fixture
def world(tmp_path: Path, service: FakeEventService) -> World:
    """A site with stored events."""
    made = World(tmp_path)
    made.router.add(EventEndpoints(made.clock, cast(Any, service), Idempotency(made.clock)))
    return made


def test_single_events_and_lists_are_written(world: World, service: FakeEventService) -> None:
    answer = world.ask("POST", HERE, {"kind": "x"}, **ANN)
    assert (answer.status, answer.json) == (201, {"id": 0})
    answer = world.ask("POST", HERE, [{"kind": "x"}, {"kind": "y", "data": {"n": 1}}], **ANN)
    assert (answer.status, answer.json) == (201, {"events": [{"id": 0}, {"id": 1}]})
    assert service.asked == [("ann", ["x"]), ("ann", ["x", "y"])]


def test_a_repeated_idempotency_key_writes_once(world: World, service: FakeEventService) -> None:
    key = {"Idempotency-Key": '"a"', **ANN}
    reported = [world.ask("POST", HERE, {"kind": "x"}, **key) for _ in "ab"]
    assert [(each.status, each.json) for each in reported] == [(201, {"id": 0})] * 2
    assert service.asked == [("ann", ["x"])]
    assert world.ask("POST", HERE, {"kind": "y"}, **key).status == 422
    service.error = NotFound("no such robot")
    assert world.ask("POST", HERE, {"kind": "x"}, **key).status == 404


def test_too_many_waiting_writes_get_a_time_to_retry(world: World, service: FakeEventService) -> None:
    service.error = EventQueueFull("too many")
    answer = world.ask("POST", HERE, {"kind": "x"}, **ANN)
    assert (answer.status, answer.headers["retry-after"], answer.json["code"]) == (503, "2", "full")


def test_a_page_has_the_cursor_of_the_next(world: World, service: FakeEventService) -> None:
    numbers, after = [], ""
    while after is not None:
        page = world.ask("GET", f"{HERE}?limit=1&kind=k{after and f'&after={after}'}", **ANN).json
        numbers += [each["id"] for each in page["events"]]
        after = page["next"]
    assert numbers == [3, 2, 1]
    assert all(uses and limit == 1 for _, limit, uses in service.asked)
    counted = world.ask("GET", f"{HERE}?count=true", **ANN).json
    assert counted["count"] == 7
    rest = world.ask("GET", f"{HERE}?count=true&after={counted['next']}", **ANN).json
    assert rest == {"count": 7, "next": None}


def test_an_export_has_all(world: World, service: FakeEventService) -> None:
    for accept in ("application/jsonl", "application/x-ndjson"):
        answer = world.ask("GET", HERE, **ANN, Accept=accept)
        assert answer.headers["content-type"] == accept and answer.body.count(b'"source":"=app"') == 3
    table = world.ask("GET", HERE, **ANN, Accept="text/csv")
    assert b"id,at,source,kind,robot,user,use_count,data\r\n" in table.body
    assert table.body.count(b'\'=app,k,,ann,0,"{""n"":1}"\r\n') == 3
    assert not any(uses for _, _, uses in service.asked)


@pytest.mark.parametrize(
    ("accept", "type"),
    [
        ("application/json, text/csv;q=0.1", "application/json"),
        ("text/event-stream;q=0, */*", "application/json"),
        ("text/html, image/png", "application/json"),
        ("TEXT/CSV", "text/csv"),
    ],
)
def test_the_preferred_media_type_is_sent(world: World, accept: str, type: str) -> None:
    assert world.ask("GET", HERE, **ANN, Accept=accept).headers["content-type"].partition(";")[0] == type


def test_an_export_that_can_not_go_on_breaks_off(world: World, service: FakeEventService) -> None:
    service.error = Unavailable("the disk is full")
    answer = world.ask("GET", HERE, **ANN, Accept="application/jsonl")
    assert answer.body.count(b'"source":"=app"') == 2 and not answer.body.endswith(b"0\r\n\r\n")


@pytest.mark.parametrize(
    "query", ["limit=0", "kind=a&kind=b", "sauce=x", "kind=%ff", "after=%21", "data.a=1&data.a=2", "last=x"]
)
def test_invalid_requests_are_refused(world: World, query: str) -> None:
    answer = world.ask("GET", f"{HERE}?{query}", **ANN)
    assert (answer.status, answer.headers["content-type"]) == (400, "application/problem+json")


@pytest.mark.parametrize(
    ("accept", "query"),
    [("text/csv", "limit=5"), ("application/jsonl", "count=true"), ("text/event-stream", "last=60")],
)
def test_parameters_of_other_media_types_are_refused(world: World, accept: str, query: str) -> None:
    assert world.ask("GET", f"{HERE}?{query}", **ANN, Accept=accept).status == 400


def test_requests_without_credentials_are_refused(world: World, service: FakeEventService) -> None:
    assert world.ask("GET", HERE).status == 401
    assert world.ask("POST", HERE, {"kind": "x"}).status == 401
    answer = world.ask("POST", HERE, {"kind": "x"}, Cookie="sb=ann", Origin="https://evil.example")
    assert answer.status == 403 and service.asked == []


def stream(world: World, last: str = "") -> Transport:
    """A client follows the events."""
    transport = world.connect()
    lines = ["Host: 127.0.0.1:9090", "Authorization: Bearer ann", "Accept: text/event-stream"]
    lines += [f"Last-Event-ID: {last}"] if last else []
    world.send(transport, (f"GET {HERE} HTTP/1.1\r\n" + "\r\n".join(lines) + "\r\n\r\n").encode())
    world.clock.advance(0)
    return transport


def test_new_events_are_sent_and_pauses_are_filled(world: World, service: FakeEventService) -> None:
    transport = stream(world, "41")
    assert service.asked == [41]
    service.news_to_tell = [event(42), event(43)]
    service.followers[0].wake()
    assert transport.value().count(b"id: 42\nevent: event\ndata: {") == 1
    assert b"id: 43\nevent: event" in transport.value()
    transport.clear()
    world.clock.advance(5)
    assert b"id: 43\n\n" in transport.value()
    transport.loseConnection()
    assert service.followers == []


def test_a_reader_without_matching_events_gets_marks(world: World, service: FakeEventService) -> None:
    transport, reported = stream(world, "41"), []
    for second in range(1, 13):
        transport.clear()
        world.clock.advance(1)
        service.followers[0].number = 41 + second
        service.followers[0].wake()
        if transport.value():
            reported.append(second)
            assert transport.value().count(b"id: ") == 1
    assert reported == [5, 10]
    transport.loseConnection()


@pytest.mark.parametrize("last", ["x", "-1", "9" * 30])
def test_an_invalid_last_event_counts_as_none(world: World, service: FakeEventService, last: str) -> None:
    """The stream begins with new events."""
    stream(world, last)
    assert service.asked == [None]


def test_a_stream_ends_with_a_reason_when_the_right_is_lost(world: World, service: FakeEventService) -> None:
    """Within a second or with the next event. While the database fails the stream stays open."""
    transport = stream(world)
    service.error = Unavailable("locked")
    service.followers[0].wake()
    for _ in range(3):
        world.clock.advance(1)
    assert b"ended" not in transport.value() and len(service.followers) == 1
    service.error = BadCredentials("your session was ended")
    world.clock.advance(1)
    assert b'event: ended\ndata: "your session was ended"\n\n' in transport.value()
    assert service.followers == []


def test_a_stalled_reader_is_disconnected(world: World, service: FakeEventService) -> None:
    transport = stream(world)
    transport.producer.pauseProducing()
    service.news_to_tell = [event(1)]
    service.followers[0].wake()
    transport.clear()
    service.news_to_tell = [event(2)]
    service.followers[0].wake()
    world.clock.advance(29)
    assert transport.value() == b"" and service.news_to_tell != []
    transport.producer.resumeProducing()
    assert b"id: 2\n" in transport.value()
    transport.producer.pauseProducing()
    service.news_to_tell = [event(3)]
    service.followers[0].wake()
    world.clock.advance(30)
    assert not transport.connected
