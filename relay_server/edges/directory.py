"""``/api/v1/directory``: which services and applications there are, and where (SPEC section 1.15)."""

from __future__ import annotations

from collections.abc import Mapping
from os import SEEK_END
from typing import Any

import msgspec
from klein import Klein
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, Refused, Unavailable
from relay_server.access import Principal
from relay_server.clock import Clock
from relay_server.directory.desk import DirectoryDesk, Kept
from relay_server.directory.entries import Ask, Registration, ask_of, place_text
from relay_server.edges import directory_operations as operations
from relay_server.edges.api import STREAMED, Api, body_of
from relay_server.edges.asked import field, query_of, streams
from relay_server.edges.once import see_no_key
from relay_server.edges.outflow import Outflow
from relay_server.edges.sse import news_within, sent
from relay_server.edges.tagged import told
from relay_server.openapi import described
from relay_server.resources.states import tag_of

QUIET_SECONDS = 5.0
"""After so long in which nothing was written to a reader his stream says that it goes on, and he is judged anew."""

AGAIN_SECONDS = 1.0
"""A stream for which the database does not answer asks again after so long; and proves its reader as often."""


class DirectoryPages:
    """The addresses below ``/api/v1/directory``, for one request."""

    app = Klein()

    def __init__(self, clock: Clock, desk: DirectoryDesk, api: Api) -> None:
        self._clock = clock
        self._desk = desk
        self._api = api

    @app.route("/", methods=["GET"])
    @described(operations.LIST)
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
    @described(operations.REGISTER)
    def register(self, request: Request) -> Any:
        return self._api.answer(request, self._register(request))

    async def _register(self, request: Request) -> Any:
        principal = await self._api.principal(request)
        see_no_key(request)
        kept = await self._desk.register(principal, body_of(request, Registration))
        if kept.fresh:
            request.setResponseCode(201)
        request.setHeader("location", f"{operations.HERE}/{kept.id}")
        return _kept(request, kept)

    @app.route("/<path:id>", methods=["GET"])
    @described(operations.ONE)
    def one(self, request: Request, id: str) -> Any:
        return self._api.answer(request, self._one(request, id))

    async def _one(self, request: Request, id: str) -> Any:
        kept = await self._desk.one(await self._api.principal(request), id)
        return told(request, kept.body, kept.etag)

    @app.route("/<path:id>", methods=["PUT"])
    @described(operations.PUT)
    def put(self, request: Request, id: str) -> Any:
        return self._api.answer(request, self._put(request, id))

    async def _put(self, request: Request, id: str) -> Any:
        principal = await self._api.principal(request)
        new, match = _said(request), field(request, "if-match")
        return _kept(request, await self._desk.put(principal, id, new, match, _address(request)))

    @app.route("/<path:id>", methods=["DELETE"])
    @described(operations.REMOVE)
    def remove(self, request: Request, id: str) -> Any:
        return self._api.answer(request, self._remove(request, id))

    async def _remove(self, request: Request, id: str) -> Any:
        principal = await self._api.principal(request)
        await self._desk.remove(principal, id, field(request, "if-match"), _address(request))

    # --- streams ------------------------------------------------------------------------------------------

    async def _stream(self, request: Request, principal: Principal, ask: Ask) -> Any:
        """Changes as they come, or what came since ``Last-Event-ID``, until the reader leaves or may not read."""
        self._api.streams(request, principal)
        proved = self._clock.seconds()
        request.setHeader("content-type", "text/event-stream")
        last = request.getHeader("last-event-id") or None
        async with Outflow(self._clock, request) as out:
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


def beside(clock: Clock, desk: DirectoryDesk, api: Api) -> IResource:
    """What serves ``/api/v1/directory``."""
    resource: IResource = DirectoryPages(clock, desk, api).app.resource()
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
