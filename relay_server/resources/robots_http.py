"""``/api/v1/robots`` and ``/api/v1/robots/<robot>``: which robots there are, and what each is (SPEC section 1.13)."""

from __future__ import annotations

from typing import Any

from twisted.web.server import Request

from relay_protocol import jsontext
from relay_server.common.database import BoundedThreadPool
from relay_server.common.fair_lock import FairLock
from relay_server.http.api import STREAMED, Api
from relay_server.http.conditional import known, told
from relay_server.http.media_types import JSON, wanted
from relay_server.http.rdf.encode import robot_graph
from relay_server.http.rdf.serialize import write
from relay_server.http.request_params import field, query_of
from relay_server.resources.etags import weak
from relay_server.resources.location import ResourceLocation
from relay_server.resources.page import PageQuery
from relay_server.resources.robots import RobotService, RobotSource, robot_tag, robots_tag


class RobotResource:
    """Robots themselves, as they are told at the routes of :class:`relay_server.http.api.Api`.

    :param threads: do what takes long
    """

    def __init__(self, overview: RobotSource, threads: BoundedThreadPool) -> None:
        self._desk = RobotService(overview)
        self._threads = threads
        self._turns = FairLock()

    async def page(self, api: Api, request: Request) -> Any:
        """A page of those that the caller has a right on.

        :raises Invalid: a parameter that there is not, or that can't be
        """
        principal = await api.principal(request)
        page = await self._desk.members(principal, PageQuery.of(query_of(request), typed=False))
        return told(request, jsontext.encode(page), weak(robots_tag(page)))

    async def one(self, api: Api, request: Request, name: str) -> Any:
        """One of them, in the form that the request wants.

        :raises NotFound: there is none, or the caller has no right on it
        :raises NotAcceptable: the request takes none of the forms there are
        :raises Unavailable: too much is being converted
        """
        principal = await api.principal(request)
        request.setHeader(b"vary", b"Accept")
        form = wanted(field(request, "accept"))
        robot = await self._desk.robot(principal, name)
        etag = weak(form.tag(robot_tag(robot)))
        if form is JSON:
            return told(request, jsontext.encode(robot), etag)
        if known(request, etag):
            return STREAMED
        place = ResourceLocation(api.base(request), name)
        async with self._turns.turn(principal.user_id):
            body = await self._threads.run(lambda: write(robot_graph(robot, place), form))
        request.setHeader(b"content-type", f"{form.media}; charset=utf-8".encode())
        request.write(body)
        return STREAMED
