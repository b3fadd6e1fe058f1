"""What the collections of a robot that are only read have in common: pages and members of them, in every form."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from rdflib import Graph
from twisted.web.server import Request

from relay_server.common.freshness_tokens import FreshnessTokens
from relay_server.http.api import Api
from relay_server.http.freshness_header import dated_in_form
from relay_server.http.negotiation import ContentNegotiation
from relay_server.http.request_params import query_of
from relay_server.resources.location import ResourceLocation
from relay_server.resources.page import PageQuery
from relay_server.resources.service import RequestOrigin, RobotResourceService

Facts = dict[str, Any]


class ReadOnlyCollection:
    """One collection of one robot, for one request; its routes are those of its kind.

    :param desk: makes what takes long
    """

    part: str
    """The last word of its address."""
    typed = True
    """Whether its members have types, which pages can be asked for by."""

    def __init__(self, moments: FreshnessTokens, desk: RobotResourceService, api: Api, robot: str) -> None:
        self._moments = moments
        self._forms = ContentNegotiation(api, desk, robot, self.part)
        self._api = api
        self._robot = robot

    def _page(self, request: Request, look: Callable[[RequestOrigin, PageQuery], Awaitable[Facts]]) -> Any:
        """Answer with a page."""

        async def work() -> Any:
            asker, form = await self._asker(request), self._forms.form(request)
            page = await look(asker, PageQuery.of(query_of(request), typed=self.typed))
            return await self._forms.members(request, asker, page, form)

        return self._answer(request, work())

    def _member(
        self,
        request: Request,
        name: str,
        look: Callable[[RequestOrigin, str], Awaitable[Facts]],
        graph: Callable[[Mapping[str, Any], ResourceLocation], Graph],
    ) -> Any:
        """Answer with one member.

        :param graph: makes a graph of what ``look`` tells
        """

        async def work() -> Any:
            asker, form = await self._asker(request), self._forms.form(request)
            return await self._forms.told(request, asker, await look(asker, name), graph, form)

        return self._answer(request, work())

    def _answer(self, request: Request, work: Awaitable[Any]) -> Any:
        return self._api.answer(request, dated_in_form(request, self._moments, work))

    async def _asker(self, request: Request) -> RequestOrigin:
        address = getattr(request.getClientAddress(), "host", "local")
        return RequestOrigin(await self._api.principal(request), self._robot, address)
