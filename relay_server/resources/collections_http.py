"""Shared by the endpoints of a robot's collections: paths, pages, members, and rights to know of them."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, ClassVar, TypeVar

from relay_server.http.endpoint import ApiRequest, Endpoint, Freshness, Representation, endpoint
from relay_server.http.media_types import FORMS
from relay_server.http.rdf.encode import member_graph
from relay_server.in_process_sessions.in_process_port import MaybeDone
from relay_server.resources import representations
from relay_server.resources.page import TypedPageQuery
from relay_server.resources.representations import caller_at
from relay_server.resources.service import RobotResourceService

T = TypeVar("T")

ROBOT_PATH = "/api/v1/robots/{robot}"

MOVING = (409, 504)
"""Error statuses of requests that may move a robot, or ask one of its nodes."""


def page_endpoint(part: str, **more: Any) -> Callable[[Any], Endpoint]:
    """A page of a collection, in every form."""
    return endpoint(
        "GET",
        f"{ROBOT_PATH}/{part}",
        tag="resources",
        summary=f"A page of the {more.pop('noun', part)} that the caller may use",
        returns="a page",
        forms=FORMS,
        freshness=Freshness.GIVEN,
        **more,
    )


def member_endpoint(part: str, summary: str, **more: Any) -> Callable[[Any], Endpoint]:
    """One member of a collection, in every form."""
    return endpoint(
        "GET",
        f"{ROBOT_PATH}/{part}/{{name:path}}",
        tag="resources",
        summary=summary,
        returns="the member",
        forms=more.pop("forms", FORMS),
        freshness=Freshness.GIVEN,
        **more,
    )


async def read_only(work: Awaitable[T]) -> T:
    """The result of work that changes nothing: a failure leaves no doubt whether it was done."""
    try:
        return await work
    except MaybeDone as error:
        raise error.reason from None


class GraphCollection:
    """A collection that is in the robot's graph: topics, services or actions."""

    kind: ClassVar[str]
    """Its name, as in :data:`relay_server.resources.service.KINDS`."""

    def __init__(self, service: RobotResourceService) -> None:
        self._service = service

    async def check_may_know(self, request: ApiRequest, robot: str, name: str = "") -> None:
        """:raises NotFound: no such robot or member, or the caller may not know of it"""
        if name:
            await self._service.member(caller_at(request, robot), self.kind, name)
        else:
            await self._service.check_may_know(caller_at(request, robot))

    async def page(self, request: ApiRequest, robot: str, query: TypedPageQuery) -> Representation[Any]:
        """A page of the members that the caller may know of."""
        found = await self._service.members(caller_at(request, robot), self.kind, query)
        return representations.page(self._service, request, robot, self.kind, found)

    async def member(self, request: ApiRequest, robot: str, name: str) -> Representation[Any]:
        """:raises NotFound: no such robot or member, or the caller may not know of it"""
        found = await self._service.member(caller_at(request, robot), self.kind, name)
        return representations.facts(self._service, request, robot, found, partial(member_graph, self.kind))
