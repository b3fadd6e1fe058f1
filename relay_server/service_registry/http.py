"""``/api/v1/directory``: services and applications with their addresses (SPEC 1.15)."""

from __future__ import annotations

import msgspec
from twisted.web.server import Request

from relay_protocol import jsontext
from relay_protocol.errors import Invalid
from relay_server.access import Principal
from relay_server.common.clock import Clock
from relay_server.events.bus import EventFollower
from relay_server.http.endpoint import ApiRequest, Created, IdempotencyKey, Streamed, Tagged, endpoint
from relay_server.http.media_types import EVENTS, JSON
from relay_server.http.openapi.operation import header
from relay_server.http.streaming import StreamingResponse, follow, sent
from relay_server.service_registry.entries import (
    EntryInfo,
    EntryParameters,
    EntryQuery,
    Registration,
    cursor_text,
)
from relay_server.service_registry.service import EntryReply, EntryService

BASE_PATH = "/api/v1/directory"


class EntryPage(msgspec.Struct):
    """A page of the directory.

    :param next: ``after`` of the next page; null on the last page
    """

    entries: list[EntryInfo]
    next: str | None


class ServiceRegistryEndpoints:
    """Entries of the directory."""

    def __init__(self, clock: Clock, service: EntryService) -> None:
        self._clock = clock
        self._service = service

    @endpoint(
        "GET",
        BASE_PATH,
        tag="directory",
        summary="Services and applications, and the resources of robots",
        more="With `Accept: text/event-stream` the changes of registered entries, until the reader disconnects.",
        returns="entries",
        forms=(JSON, EVENTS),
        parameters=(header("Last-Event-ID", "of a stream: begin with the changes after this one"),),
    )
    async def list(self, request: ApiRequest, query: EntryParameters) -> EntryPage | Streamed:
        wanted = query.wanted()
        if request.form is EVENTS:
            return self._changes(request, query, wanted)
        entries, behind = await self._service.page(request.principal, wanted)
        return EntryPage(entries, None if behind is None else cursor_text(behind))

    def _changes(self, request: ApiRequest, query: EntryParameters, wanted: EntryQuery) -> Streamed:
        """A stream of changes, which begins after ``Last-Event-ID``."""
        for name in ("limit", "after"):
            if getattr(query, name) is not msgspec.UNSET:
                raise Invalid(f"'{name}' cannot be used with a stream: remove it")
        last = request.http.getHeader("last-event-id") or None

        async def run(http: Request) -> None:
            async with StreamingResponse(self._clock, http) as out:
                with self._service.following(request.principal, last) as (follower, missed):
                    feed = _ChangeFeed(self._service, wanted, follower, missed)
                    await follow(self._clock, request, out, feed)

        return Streamed(EVENTS.media, run)

    @endpoint(
        "POST",
        BASE_PATH,
        tag="directory",
        summary="Register a service or an application",
        more="The entry expires `ttl` seconds after it was registered or renewed.",
        returns={201: "the new entry", 200: "the same user had registered it; it is renewed"},
        key=IdempotencyKey.REFUSED,
        errors=(404, 409),
    )
    async def register(
        self, request: ApiRequest, body: Registration
    ) -> Created[EntryInfo] | Tagged[EntryInfo]:
        reply = await self._service.register(request.principal, body)
        location = f"{BASE_PATH}/{reply.id}"
        if reply.created:
            return Created(msgspec.Raw(reply.body), reply.etag, location=location)
        return Tagged(msgspec.Raw(reply.body), reply.etag, {"location": location})

    @endpoint("GET", f"{BASE_PATH}/{{id:path}}", tag="directory", summary="One entry", returns="the entry")
    async def one(self, request: ApiRequest, id: str) -> Tagged[EntryInfo]:
        return _tagged(await self._service.one(request.principal, id))

    @endpoint(
        "PUT",
        f"{BASE_PATH}/{{id:path}}",
        tag="directory",
        summary="Renew an entry, or change it",
        more="Without a body the entry is renewed. A change needs `If-Match`.",
        returns="the entry",
        if_match=True,
        errors=(428,),
    )
    async def put(self, request: ApiRequest, id: str, body: Registration | None = None) -> Tagged[EntryInfo]:
        match = request.header("if-match")
        return _tagged(await self._service.put(request.principal, id, body, match, request.address))

    @endpoint(
        "DELETE",
        f"{BASE_PATH}/{{id:path}}",
        tag="directory",
        summary="Remove an entry",
        returns="removed",
        if_match=True,
    )
    async def remove(self, request: ApiRequest, id: str) -> None:
        await self._service.remove(request.principal, id, request.header("if-match"), request.address)


class _ChangeFeed:
    """Changes of the directory on the wire.

    :param missed: whether earlier changes were missed
    """

    def __init__(
        self, service: EntryService, wanted: EntryQuery, follower: EventFollower, missed: bool
    ) -> None:
        self.follower = follower
        self._service = service
        self._wanted = wanted
        self._missed = missed

    async def news(self, principal: Principal) -> tuple[bytes, bool]:
        changes, lost, more = await self._service.news(principal, self._wanted, self.follower)
        parts = [sent("missed", b"{}")] if self._missed or lost else []
        self._missed = False
        parts += [sent(what, jsontext.encode(entry), id) for id, what, entry in changes]
        return b"".join([*parts, self.mark()]) if parts else b"", more

    def mark(self) -> bytes:
        return b"id: " + self._service.event_id(self.follower).encode() + b"\n\n"


def _tagged(reply: EntryReply) -> Tagged[EntryInfo]:
    return Tagged(msgspec.Raw(reply.body), reply.etag)
