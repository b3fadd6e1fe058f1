"""``/api/v1/events``: stored events are written, searched, followed and exported (SPEC 1.14)."""

from __future__ import annotations

import csv
import io
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta
from twisted.web.server import Request

from relay_db.queries import EventCursor, StoredEventRecord
from relay_protocol import jsontext
from relay_protocol.errors import Invalid
from relay_server.access import Principal
from relay_server.common.clock import Clock
from relay_server.events.bus import EventFollower
from relay_server.events.limits import MAX_PAGE, MAX_PER_REQUEST
from relay_server.events.query import EventFormatter, EventInfo, EventQuery, cursor_text, parse_query
from relay_server.events.service import EventService, NewEvent
from relay_server.http.endpoint import ApiRequest, Created, IdempotencyKey, Streamed, endpoint
from relay_server.http.idempotency import Idempotency
from relay_server.http.media_types import EVENTS, JSON, MediaType
from relay_server.http.openapi.operation import header, query
from relay_server.http.request_fields import query_of
from relay_server.http.streaming import StreamingResponse, follow, sent

BASE_PATH = "/api/v1/events"
CSV = MediaType("text/csv")
LINES = (MediaType("application/jsonl"), MediaType("application/x-ndjson"))

CHUNK = 500
"""Events of an export that are looked up and sent at a time."""

NewEvents = NewEvent | Annotated[list[NewEvent], Meta(min_length=1, max_length=MAX_PER_REQUEST)]
"""Body of a ``POST``: one event, or several."""

PARAMETERS = (
    *(
        query(name, f"only of this {name}; `*` at the end matches any rest")
        for name in ("source", "kind", "robot")
    ),
    query("user", "only of this user"),
    query("since", "from this time on: Unix seconds or RFC 3339"),
    query("until", "before this time"),
    query("last", "only of the last seconds, this many", Annotated[float, Meta(gt=0)]),
    query("limit", "most events of a page; default 100", Annotated[int, Meta(ge=1, le=MAX_PAGE)]),
    query("after", "`next` of an earlier answer: the events behind that"),
    query("count", "return the number of events instead of the events", Literal["true", "false"]),
    header("Last-Event-ID", "of a stream: begin with the events after this one"),
)


class EventPage(msgspec.Struct):
    """A page of events, the newest first.

    :param next: the ``after`` of the next page; null on the last one
    """

    events: list[EventInfo]
    next: str | None


class StoredEvents(msgspec.Struct):
    """Events as they were stored."""

    events: list[EventInfo]


class EventCount(msgspec.Struct):
    """The number of events that match.

    :param next: if not null there may be more: count again with this as ``after``, and add the numbers
    """

    count: int
    next: str | None


class EventEndpoints:
    """Stored events.

    :param remembered: answers to earlier requests with an idempotency key
    """

    def __init__(self, clock: Clock, service: EventService, remembered: Idempotency) -> None:
        self.remembered = remembered
        self._clock = clock
        self._service = service

    @endpoint(
        "POST",
        BASE_PATH,
        tag="events",
        summary="Write an event, or up to 100",
        more="All are stored or none. They are in the database when this is answered.",
        returns="the stored events",
        key=IdempotencyKey.REMEMBERED,
        errors=(404,),
    )
    async def write(self, request: ApiRequest, body: NewEvents) -> Created[EventInfo | StoredEvents]:
        if isinstance(body, list):
            return Created(StoredEvents(await self._service.write(request.principal, body)))
        (stored,) = await self._service.write(request.principal, [body])
        return Created(stored)

    @write.replay
    async def may_write(self, request: ApiRequest, body: NewEvents) -> None:
        events = body if isinstance(body, list) else [body]
        await self._service.may_write(request.principal, events)

    @endpoint(
        "GET",
        BASE_PATH,
        tag="events",
        summary="Stored events, the newest first",
        more="`Accept` selects JSON, lines of JSON, CSV, or a stream of new events. Parameters `data.<field>`, at most "
        "eight, search for the value of a field of the data.",
        returns="events",
        forms=(JSON, EVENTS, CSV, *LINES),
        items=(EventInfo,),
        parameters=PARAMETERS,
    )
    async def read(self, request: ApiRequest) -> EventPage | EventCount | Streamed:
        parameters = query_of(request.http)
        wanted = parse_query(parameters, self._service.wall())
        if request.form is not JSON:
            _reject(parameters, "limit", "after", "count")
        if request.form is EVENTS:
            _reject(parameters, "since", "until", "last")
            return await self._stream(request, wanted)
        if request.form is not JSON:
            return await self._export(request, wanted)
        if wanted.counts:
            count, more = await self._service.count(request.principal, wanted)
            return EventCount(count=count, next=_next(more))
        events, formatter, more = await self._service.page(request.principal, wanted, wanted.limit)
        return EventPage(events=[formatter.info(each) for each in events], next=_next(more))

    async def _export(self, request: ApiRequest, wanted: EventQuery) -> Streamed:
        """All events that match, in parts. Each part is judged by the sender's rights when the one before was read."""
        write, name = (_table, "events.csv") if request.form is CSV else (_lines, "events.jsonl")
        # Read before the answer begins: a later error can only break the answer off.
        first = await self._service.page(request.principal, wanted, CHUNK, uses=False)

        async def run(http: Request) -> None:
            events, formatter, cursor = first
            async with StreamingResponse(self._clock, http) as out:
                if request.form is CSV:
                    out.write(_row(EventFormatter.COLUMNS))
                out.write(write(events, formatter))
                while cursor is not None:
                    await out.room()
                    principal = await request.authenticate()
                    events, formatter, cursor = await self._service.page(
                        principal, wanted._replace(after=cursor), CHUNK, uses=False
                    )
                    out.write(write(events, formatter))

        media = f"{CSV.media}; charset=utf-8" if request.form is CSV else request.form.media
        return Streamed(
            media, run, counted=False, headers={"content-disposition": f'attachment; filename="{name}"'}
        )

    async def _stream(self, request: ApiRequest, wanted: EventQuery) -> Streamed:
        """New events, beginning after ``Last-Event-ID`` if the request has it."""
        begun = await self._service.follow_from(request.principal, _last_id(request))

        async def run(http: Request) -> None:
            async with (
                StreamingResponse(self._clock, http) as out,
                self._service.following(begun) as follower,
            ):
                await follow(self._clock, request, out, _StoredEventFeed(self._service, wanted, follower))

        return Streamed(EVENTS.media, run)


class _StoredEventFeed:
    """New events as server-sent events."""

    def __init__(self, service: EventService, wanted: EventQuery, follower: EventFollower) -> None:
        self.follower = follower
        self._service = service
        self._wanted = wanted

    async def news(self, principal: Principal) -> tuple[bytes, bool]:
        events, formatter, more = await self._service.news(principal, self._wanted, self.follower)
        lines = (sent("event", jsontext.encode(formatter.info(each)), each.number) for each in events)
        return b"".join(lines), more

    def mark(self) -> bytes:
        # A reader that reconnects continues here, without a search of what it has.
        return b"id: %d\n\n" % self.follower.number


def _next(cursor: EventCursor | None) -> str | None:
    return None if cursor is None else cursor_text(cursor)


def _reject(parameters: dict[str, str], *names: str) -> None:
    """:raises Invalid: one of these parameters is parameters"""
    found = [each for each in names if each in parameters]
    if found:
        raise Invalid(f"the parameter '{found[0]}' cannot be used with this media type")


def _last_id(request: ApiRequest) -> int | None:
    text = request.http.getHeader("last-event-id") or ""
    return int(text) if text.isascii() and text.isdigit() and len(text) <= 18 else None


def _lines(events: list[StoredEventRecord], formatter: EventFormatter) -> bytes:
    return b"".join(jsontext.encode(formatter.info(each)) + b"\n" for each in events)


def _table(events: list[StoredEventRecord], formatter: EventFormatter) -> bytes:
    return b"".join(_row(formatter.cells(each)) for each in events)


def _row(cells: Any) -> bytes:
    line = io.StringIO(newline="")
    csv.writer(line).writerow(cells)
    return line.getvalue().encode()
