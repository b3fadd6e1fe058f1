"""``/api/v1/directory``: which services and applications there are, and where (SPEC section 1.15)."""

from __future__ import annotations

from collections.abc import Mapping
from os import SEEK_END
from typing import Annotated, Any, TypedDict

import msgspec
from klein import Klein
from msgspec import Meta
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, Refused, Unavailable
from relay_server.access import Principal
from relay_server.common.clock import Clock
from relay_server.http.api import STREAMED, Api, body_of
from relay_server.http.conditional import told
from relay_server.http.idempotent_requests import see_no_key
from relay_server.http.openapi.operation import JSON, ApiOperation, Response, described, header, query
from relay_server.http.request_params import field, query_of, streams
from relay_server.http.sse import news_within, sent
from relay_server.http.streaming import StreamingResponse
from relay_server.registry.entries import EntryQuery, Registration, ask_of, place_text
from relay_server.registry.limits import MOST
from relay_server.registry.service import Kept, RegistryService
from relay_server.resources.etags import tag_of

HERE = "/api/v1/directory"
STREAM = "text/event-stream"


class EntryInfo(TypedDict):
    """Something in the directory; what robots have has no user and no lease.

    :param robot: the one it is about
    :param user: who registered it
    :param ttl: seconds that its lease lasts
    :param registered: Unix seconds
    :param expires: Unix seconds
    """

    id: str
    kind: str
    name: str
    robot: str | None
    address: str
    description: str
    data: dict[str, Any]
    user: str | None
    ttl: float | None
    registered: float | None
    expires: float | None


class EntryPage(TypedDict):
    """A page of the directory.

    :param next: goes into `after`, where there is more
    """

    entries: list[EntryInfo]
    next: str | None


_TAGGED = {"ETag": "names what is told"}
_KNOWN = header("If-None-Match", "entity tags of what is known already")
_MATCH = header("If-Match", "entity tags: only if it is one of these")
_UNCHANGED = Response("it is as it is known", headers=_TAGGED)

LIST = ApiOperation(
    method="GET",
    path=HERE,
    tag="directory",
    summary="Services, applications, and what robots have",
    more="By `Accept` also the changes of what is registered, as events that go on.",
    parameters=(
        query("kind", "exactly of this kind"),
        query("robot", "only about robots of this name; shell wildcards"),
        query("name", "only of this name; shell wildcards"),
        query("realm", "only of this realm: of another than the caller's there is nothing"),
        query("limit", "most entries of a page; 100 where left out", Annotated[int, Meta(ge=1, le=MOST)]),
        query("after", "`next` of an earlier answer: what comes behind that"),
        _KNOWN,
        header("Last-Event-ID", "of a stream: what came behind this first"),
    ),
    answers={200: Response("entries", EntryPage, media=(JSON, STREAM), headers=_TAGGED), 304: _UNCHANGED},
)
REGISTER = ApiOperation(
    method="POST",
    path=HERE,
    tag="directory",
    summary="Register a service or an application",
    more="It stays for `ttl` seconds, and as long as it is renewed.",
    body=Registration,
    answers={
        201: Response("as it is kept", EntryInfo, headers={"Location": "its address", **_TAGGED}),
        200: Response("it was registered by the same user, and is renewed", EntryInfo, headers=_TAGGED),
    },
    errors=(404, 409),
)
ONE = ApiOperation(
    method="GET",
    path=f"{HERE}/{{id}}",
    tag="directory",
    summary="One entry",
    parameters=(_KNOWN,),
    answers={200: Response("the entry", EntryInfo, headers=_TAGGED), 304: _UNCHANGED},
)
PUT = ApiOperation(
    method="PUT",
    path=f"{HERE}/{{id}}",
    tag="directory",
    summary="Renew an entry, or change it",
    more="Without a body it is renewed. What changes it needs `If-Match`.",
    parameters=(_MATCH,),
    body=Registration,
    optional=True,
    answers={200: Response("the entry", EntryInfo, headers=_TAGGED)},
    errors=(412, 428),
)
REMOVE = ApiOperation(
    method="DELETE",
    path=f"{HERE}/{{id}}",
    tag="directory",
    summary="Remove an entry",
    parameters=(_MATCH,),
    answers={204: Response("removed")},
    errors=(412,),
)

QUIET_SECONDS = 5.0
"""After so long in which nothing was written to a reader his stream says that it goes on, and he is judged anew."""

AGAIN_SECONDS = 1.0
"""A stream for which the database does not answer asks again after so long; and proves its reader as often."""


class RegistryResource:
    """The addresses below ``/api/v1/directory``, for one request."""

    app = Klein()

    def __init__(self, clock: Clock, desk: RegistryService, api: Api) -> None:
        self._clock = clock
        self._desk = desk
        self._api = api

    @app.route("/", methods=["GET"])
    @described(LIST)
    def list(self, request: Request) -> Any:
        return self._api.answer(request, self._list(request))

    async def _list(self, request: Request) -> Any:
        principal = await self._api.principal(request)
        query = query_of(request)
        ask = ask_of(query)
        if streams(request):
            _see_none(query, "limit", "after")
            return await self._stream(request, principal, ask)
        entries, behind = await self._desk.page(principal, ask)
        body = jsontext.encode({"entries": entries, "next": None if behind is None else place_text(behind)})
        return told(request, body, tag_of(body))

    @app.route("/", methods=["POST"])
    @described(REGISTER)
    def register(self, request: Request) -> Any:
        return self._api.answer(request, self._register(request))

    async def _register(self, request: Request) -> Any:
        principal = await self._api.principal(request)
        see_no_key(request)
        kept = await self._desk.register(principal, body_of(request, Registration))
        if kept.fresh:
            request.setResponseCode(201)
        request.setHeader("location", f"{HERE}/{kept.id}")
        return _kept(request, kept)

    @app.route("/<path:id>", methods=["GET"])
    @described(ONE)
    def one(self, request: Request, id: str) -> Any:
        return self._api.answer(request, self._one(request, id))

    async def _one(self, request: Request, id: str) -> Any:
        kept = await self._desk.one(await self._api.principal(request), id)
        return told(request, kept.body, kept.etag)

    @app.route("/<path:id>", methods=["PUT"])
    @described(PUT)
    def put(self, request: Request, id: str) -> Any:
        return self._api.answer(request, self._put(request, id))

    async def _put(self, request: Request, id: str) -> Any:
        principal = await self._api.principal(request)
        new, match = _said(request), field(request, "if-match")
        return _kept(request, await self._desk.put(principal, id, new, match, _address(request)))

    @app.route("/<path:id>", methods=["DELETE"])
    @described(REMOVE)
    def remove(self, request: Request, id: str) -> Any:
        return self._api.answer(request, self._remove(request, id))

    async def _remove(self, request: Request, id: str) -> Any:
        principal = await self._api.principal(request)
        await self._desk.remove(principal, id, field(request, "if-match"), _address(request))

    # --- streams ------------------------------------------------------------------------------------------

    async def _stream(self, request: Request, principal: Principal, ask: EntryQuery) -> Any:
        """Changes as they come, or what came since ``Last-Event-ID``, until the reader leaves or may not read."""
        self._api.streams(request, principal)
        proved = self._clock.seconds()
        request.setHeader("content-type", "text/event-stream")
        last = request.getHeader("last-event-id") or None
        async with StreamingResponse(self._clock, request) as out:
            with self._desk.following(principal, last) as (follower, missed):
                out.write(b": this stream goes on until you leave\n\n")
                due = self._clock.seconds() + QUIET_SECONDS
                while not request._disconnected:
                    told, lost, more, wait = list[Any](), False, False, QUIET_SECONDS
                    try:
                        if self._clock.seconds() - proved >= AGAIN_SECONDS:
                            principal, proved = await self._api.principal(request), self._clock.seconds()
                        told, lost, more = await self._desk.news(principal, ask, follower)
                    except Refused as error:
                        out.write(sent("ended", jsontext.encode(str(error))))
                        break
                    except Unavailable:
                        wait = AGAIN_SECONDS
                    if missed or lost:
                        out.write(sent("missed", b"{}"))
                    out.write(b"".join(sent(what, jsontext.encode(entry), id) for id, what, entry in told))
                    if told or missed or lost or self._clock.seconds() >= due:
                        out.write(b"id: " + self._desk.mark(follower).encode() + b"\n\n")
                        due = self._clock.seconds() + QUIET_SECONDS
                    missed = False
                    await out.room()
                    if not more:
                        await news_within(self._clock, follower, min(wait, due - self._clock.seconds()))
        return STREAMED

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def beside(clock: Clock, desk: RegistryService, api: Api) -> IResource:
    """What serves ``/api/v1/directory``."""
    resource: IResource = RegistryResource(clock, desk, api).app.resource()
    return resource


def _kept(request: Request, kept: Kept) -> Any:
    request.setHeader("etag", kept.etag)
    return msgspec.Raw(kept.body)


def _said(request: Request) -> Registration | None:
    """The body of a request, ``None`` where it has none."""
    there = request.content.seek(0, SEEK_END) > 0
    request.content.seek(0)
    return body_of(request, Registration) if there else None


def _see_none(query: Mapping[str, str], *names: str) -> None:
    """:raises Invalid: there is one of these"""
    found = [each for each in names if each in query]
    if found:
        raise Invalid(f"'{found[0]}' does not go with a stream")


def _address(request: Request) -> str:
    return str(getattr(request.getClientAddress(), "host", "local"))
