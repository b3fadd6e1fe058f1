"""What the collections of a robot that are only read have in common: pages and members of them, in every form."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from rdflib import Graph
from twisted.web.server import Request

from relay_server.edges.api import Api
from relay_server.edges.asked import query_of
from relay_server.edges.dated import dated_in_form
from relay_server.edges.representing import Representing
from relay_server.resources import Asker, Listing, Moments, ResourceDesk
from relay_server.resources.describing import Place

Facts = dict[str, Any]


class Collection:
    """One collection of one robot, for one request; its routes are those of its kind.

    :param desk: makes what takes long
    """

    part: str
    """The last word of its address."""
    typed = True
    """Whether its members have types, which pages can be asked for by."""

    def __init__(self, moments: Moments, desk: ResourceDesk, api: Api, robot: str) -> None:
        self._moments = moments
        self._forms = Representing(api, desk, robot, self.part)
        self._api = api
        self._robot = robot

    def _page(self, request: Request, look: Callable[[Asker, Listing], Awaitable[Facts]]) -> Any:
        """Answer with a page."""

        async def work() -> Any:
            asker, form = await self._asker(request), self._forms.form(request)
            page = await look(asker, Listing.of(query_of(request), typed=self.typed))
            return await self._forms.members(request, asker, page, form)

        return self._answer(request, work())

    def _member(
        self,
        request: Request,
        name: str,
        look: Callable[[Asker, str], Awaitable[Facts]],
        graph: Callable[[Mapping[str, Any], Place], Graph],
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

    async def _asker(self, request: Request) -> Asker:
        address = getattr(request.getClientAddress(), "host", "local")
        return Asker(await self._api.principal(request), self._robot, address)
