"""``/api/v1/events``: the short-term memory, written, asked, followed and exported (SPEC section 1.14)."""

from __future__ import annotations

import csv
import io
from functools import partial
from typing import Annotated, Any, Literal

from klein import Klein
from msgspec import Meta
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_db.queries import EventCursor, StoredEventRecord
from relay_protocol import jsontext
from relay_protocol.errors import Invalid, Refused, Unavailable
from relay_server.common.clock import Clock
from relay_server.events.limits import LONGEST, SEVERAL
from relay_server.events.query import EventFormatter, EventQuery, ask_of, place_text
from relay_server.events.service import EventService, NewEvent
from relay_server.http.api import STREAMED, Api, body_of
from relay_server.http.idempotency import Idempotency, StoredReply
from relay_server.http.idempotent_requests import KEYED, once, send
from relay_server.http.media_types import EVENTS, MediaType, preferred
from relay_server.http.media_types import JSON as JSON_FORM
from relay_server.http.openapi.operation import JSON, ApiOperation, Response, described, query
from relay_server.http.openapi.schemas import EventCount, EventInfo, EventPage, EventsKept
from relay_server.http.request_params import field, query_of
from relay_server.http.sse import news_within, sent
from relay_server.http.streaming import StreamingResponse

STREAM = EVENTS.media
CSV = "text/csv"
LINES = ("application/jsonl", "application/x-ndjson")
FORMS_THERE = (JSON_FORM, EVENTS, *(MediaType(each) for each in (CSV, *LINES)))

CHUNK = 500
"""Events of an export that are looked up and sent at a time."""

QUIET_SECONDS = 5.0
"""After so long in which nothing was written to a reader his stream says that it goes on, and he is judged anew."""

AGAIN_SECONDS = 1.0
"""A stream for which the database does not answer asks again after so long."""

PROVED_SECONDS = 1.0
"""Who reads a stream is proved again after so long."""

BODY: Any = NewEvent | Annotated[list[NewEvent], Meta(min_length=1, max_length=SEVERAL)]
"""Of a ``POST``: one event, or several."""


class EventResource:
    """The address ``/api/v1/events``, for one request."""

    app = Klein()

    def __init__(self, clock: Clock, desk: EventService, keys: Idempotency, api: Api) -> None:
        self._clock = clock
        self._desk = desk
        self._keys = keys
        self._api = api

    @app.route("/", methods=["POST"])
    @described(
        ApiOperation(
            method="POST",
            path="/api/v1/events",
            tag="events",
            summary="Write an event, or up to 100",
            more="All are kept or none; they are safe when this is answered.",
            parameters=(KEYED,),
            body=BODY,
            answers={201: Response("as it was kept", (EventInfo, EventsKept))},
            errors=(404, 422),
        )
    )
    def write(self, request: Request) -> Any:
        return self._api.answer(request, self._write(request))

    async def _write(self, request: Request) -> Any:
        principal, body = await self._api.principal(request), body_of(request, BODY)
        several = isinstance(body, list)
        events: list[NewEvent] = body if several else [body]

        async def work() -> StoredReply:
            kept = await self._desk.write(principal, events)
            return StoredReply(201, jsontext.encode({"events": kept} if several else kept[0]))

        may = partial(self._desk.may_write, principal, events)
        return send(request, await once(self._keys, request, principal, "", work, may))

    @app.route("/", methods=["GET"])
    @described(
        ApiOperation(
            method="GET",
            path="/api/v1/events",
            tag="events",
            summary="What happened, the newest first",
            more="By `Accept` also as lines of JSON, a table, or as events that go on. A parameter `data.<field>` asks "
            "for a field of the data, up to eight of them.",
            parameters=(
                *(
                    query(name, f"the {name}; with `*` at its end what begins so")
                    for name in ("source", "kind", "robot")
                ),
                query("user", "the user"),
                query("since", "from this moment on: Unix seconds or RFC 3339"),
                query("until", "before this moment"),
                query("last", "the last so many seconds", Annotated[float, Meta(gt=0)]),
                query(
                    "limit",
                    "most events of a page; 100 where left out",
                    Annotated[int, Meta(ge=1, le=LONGEST)],
                ),
                query("after", "`next` of an earlier answer: what comes behind that"),
                query(
                    "count", "how many there are is wanted, and where to count on", Literal["true", "false"]
                ),
            ),
            answers={200: Response("events", (EventPage, EventCount), media=(JSON, *LINES, CSV, STREAM))},
        )
    )
    def read(self, request: Request) -> Any:
        return self._api.answer(request, self._read(request))

    async def _read(self, request: Request) -> Any:
        principal = await self._api.principal(request)
        query = query_of(request)
        ask, form = ask_of(query, self._desk.wall()), _form(request)
        if form:
            _see_none(query, "limit", "after", "count")
        if form == STREAM:
            _see_none(query, "since", "until", "last")
            return await self._stream(request, ask)
        if form:
            return await self._export(request, ask, form)
        if ask.counts:
            count, more = await self._desk.count(principal, ask)
            return {"count": count, "next": _next(more)}
        events, forms, more = await self._desk.page(principal, ask, ask.limit)
        return {"events": [forms.json(each) for each in events], "next": _next(more)}

    # --- exports ------------------------------------------------------------------------------------------

    async def _export(self, request: Request, ask: EventQuery, form: str) -> Any:
        """All that match, some at a time: who asks is judged anew for each part, and takes it before the next."""
        tell, name = (_table, "events.csv") if form == CSV else (_lines, "events.jsonl")
        # Before the answer begins: what goes wrong later can only break it off.
        events, forms, place = await self._part(request, ask)
        request.setHeader(
            b"content-type", f"{form}; charset=utf-8".encode() if form == CSV else form.encode()
        )
        request.setHeader(b"content-disposition", f'attachment; filename="{name}"'.encode())
        async with StreamingResponse(self._clock, request) as out:
            try:
                if form == CSV:
                    out.write(_row(EventFormatter.COLUMNS))
                out.write(tell(events, forms))
                while place is not None:
                    await out.room()
                    events, forms, place = await self._part(request, ask._replace(after=place))
                    out.write(tell(events, forms))
            except (Refused, Unavailable):
                # What is not whole must not look so.
                out.cut()
        return STREAMED

    async def _part(
        self, request: Request, ask: EventQuery
    ) -> tuple[list[StoredEventRecord], EventFormatter, Any]:
        return await self._desk.page(await self._api.principal(request), ask, CHUNK, uses=False)

    # --- streams ------------------------------------------------------------------------------------------

    async def _stream(self, request: Request, ask: EventQuery) -> Any:
        """New events as they come, or what came since ``Last-Event-ID``, until the reader leaves or may not read."""
        principal, proved = await self._api.principal(request), self._clock.seconds()
        self._api.streams(request, principal)
        begun = await self._desk.follow_from(principal, _last_id(request))
        request.setHeader(b"content-type", STREAM.encode())
        async with StreamingResponse(self._clock, request) as out, self._desk.following(begun) as following:
            out.write(b": this stream goes on until you leave\n\n")
            due = self._clock.seconds() + QUIET_SECONDS
            while not request._disconnected:
                events, forms, more, wait = (
                    list[StoredEventRecord](),
                    EventFormatter({}),
                    False,
                    QUIET_SECONDS,
                )
                try:
                    if self._clock.seconds() - proved >= PROVED_SECONDS:
                        principal, proved = await self._api.principal(request), self._clock.seconds()
                    events, forms, more = await self._desk.news(principal, ask, following)
                except Refused as error:
                    out.write(sent("ended", jsontext.encode(str(error))))
                    break
                except Unavailable:
                    wait = AGAIN_SECONDS
                if events or self._clock.seconds() >= due:
                    out.write(_news(events, forms, following.number))
                    due = self._clock.seconds() + QUIET_SECONDS
                await out.room()
                if not more:
                    await news_within(self._clock, following, min(wait, due - self._clock.seconds()))
        return STREAMED

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def beside(clock: Clock, desk: EventService, keys: Idempotency, api: Api) -> IResource:
    """What serves ``/api/v1/events``.

    :param keys: requests that were sent with a key
    """
    resource: IResource = EventResource(clock, desk, keys, api).app.resource()
    return resource


def _form(request: Request) -> str:
    """The form that is asked for; empty for a page in JSON."""
    form = preferred(field(request, "accept"), FORMS_THERE)
    return "" if form is JSON_FORM else form.media


def _next(place: EventCursor | None) -> str | None:
    return None if place is None else place_text(place)


def _see_none(query: dict[str, str], *names: str) -> None:
    """:raises Invalid: there is one of these"""
    found = [each for each in names if each in query]
    if found:
        raise Invalid(f"'{found[0]}' does not go with this form of answer")


def _last_id(request: Request) -> int | None:
    text = request.getHeader("last-event-id") or ""
    return int(text) if text.isascii() and text.isdigit() and len(text) <= 18 else None


def _news(events: list[StoredEventRecord], forms: EventFormatter, number: int) -> bytes:
    """Events for a reader; where none is for him, how far he has heard: that need not be looked through again."""
    if not events:
        return b"id: %d\n\n" % number
    return b"".join(sent("event", jsontext.encode(forms.json(each)), each.number) for each in events)


def _lines(events: list[StoredEventRecord], forms: EventFormatter) -> bytes:
    return b"".join(jsontext.encode(forms.json(each)) + b"\n" for each in events)


def _table(events: list[StoredEventRecord], forms: EventFormatter) -> bytes:
    return b"".join(_row(forms.cells(each)) for each in events)


def _row(cells: Any) -> bytes:
    line = io.StringIO(newline="")
    csv.writer(line).writerow(cells)
    return line.getvalue().encode()
