"""Things over HTTP (W3C WoT Discovery): ``/.well-known/wot``, the directory, and one description for each Thing."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from relay_protocol import jsontext
from relay_server.common.freshness_tokens import FreshnessTokens
from relay_server.http.endpoint import ApiRequest, Document, endpoint
from relay_server.http.media_types import MediaType
from relay_server.http.openapi.operation import Credential
from relay_server.resources.representations import caller_at
from relay_server.wot.description import directory_description
from relay_server.wot.service import ThingService

WELL_KNOWN = "/.well-known/wot"
THINGS = "/api/v1/things"

TD = MediaType("application/td+json")
TM = MediaType("application/tm+json")
LIST = MediaType("application/ld+json")

PAGE = 10
LONGEST_PAGE = 50
PAGE_SECONDS = 60.0
"""Additional time for a page: robots may have to send their types first."""


class ThingQuery(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Query for a page of Things.

    :param offset: number of the first one
    :param limit: most Things of the page; 10 by default
    """

    offset: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    limit: Annotated[int, Meta(ge=1, le=LONGEST_PAGE)] = PAGE


class DescriptionQuery(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Query for a Thing Description.

    :param typed: give each schema a type, without null, for clients that need one
    """

    typed: bool = False


class FreshnessTokenValue(msgspec.Struct, frozen=True):
    """A freshness token (SPEC 1.13)."""

    freshness: str


class ThingEndpoints:
    """Thing Descriptions and Thing Models."""

    def __init__(self, service: ThingService, tokens: FreshnessTokens) -> None:
        self._service = service
        self._tokens = tokens

    @endpoint(
        "GET",
        WELL_KNOWN,
        tag="things",
        summary="The Thing Description of the directory of Things",
        returns="the description",
        forms=(TD,),
        credential=Credential.NONE,
    )
    async def introduction(self, request: ApiRequest) -> Document:
        base = request.base
        return _document(jsontext.encode(directory_description(base, base + THINGS)), TD)

    @endpoint(
        "GET",
        THINGS,
        tag="things",
        summary="Thing Descriptions of the robots, devices and Roles the caller may see",
        more="Roles come last, each in the order of names. `Link` has the address of the next page.",
        returns="a list of descriptions",
        forms=(LIST,),
        headers={"Link": "address of the next page, with `rel=next`"},
        seconds=PAGE_SECONDS,
    )
    async def things(self, request: ApiRequest, query: ThingQuery) -> Document:
        found = await self._service.page(
            request.principal, request.address, request.base, query.offset, query.limit
        )
        headers = {}
        if found.next is not None:
            headers["link"] = f'<{THINGS}?offset={found.next}&limit={query.limit}>; rel="next"'
        return _document(b"[" + b",".join(found.things) + b"]", LIST, headers)

    @endpoint(
        "GET",
        f"{THINGS}/{{id}}",
        tag="things",
        summary="The Thing Description with this id",
        more="It is redirected to the address of the description.",
        returns={307: "its address is in `Location`"},
        names={"id": "`id` of a Thing"},
        forms=(TD,),
        headers={"Location": "address of the description"},
        errors=(404,),
    )
    async def thing(self, request: ApiRequest, id: str) -> Document:
        location = await self._service.address_of(request.principal, id, request.base)
        return Document(b"", TD.media, headers={"location": location}, status=307)

    @endpoint(
        "GET",
        "/api/v1/robots/{robot}/td",
        tag="things",
        summary="The Thing Description of a robot or device",
        more="It has the topics, services and actions that the caller may use.",
        returns="the description",
        forms=(TD,),
        errors=(404,),
    )
    async def robot(self, request: ApiRequest, robot: str, query: DescriptionQuery) -> Document:
        body = await self._service.robot(caller_at(request, robot), request.base, typed=query.typed)
        return _document(body, TD)

    @endpoint(
        "GET",
        "/api/v1/robots/{robot}/freshness",
        tag="things",
        summary="A freshness token, for clients that can't read the header of an answer",
        returns="the token",
        errors=(404,),
    )
    async def freshness(self, request: ApiRequest, robot: str) -> FreshnessTokenValue:
        await self._service.check(request.principal, robot)
        return FreshnessTokenValue(self._tokens.now())

    @endpoint(
        "GET",
        "/api/v1/roles/{role}/td",
        tag="things",
        summary="The Thing Description of a Role",
        more="It has the elements that take a command which the caller may send.",
        returns="the description",
        forms=(TD,),
        errors=(404,),
    )
    async def role(self, request: ApiRequest, role: str, query: DescriptionQuery) -> Document:
        body = await self._service.role(request.principal, role, request.base, typed=query.typed)
        return _document(body, TD)

    @endpoint(
        "GET",
        "/api/v1/roles/{role}/tm",
        tag="things",
        summary="The Thing Model of a Role",
        returns="the model",
        forms=(TM,),
        errors=(404,),
    )
    async def model(self, request: ApiRequest, role: str) -> Document:
        return _document(await self._service.model(request.principal, role), TM)


def _document(body: bytes, form: MediaType, headers: dict[str, str] | None = None) -> Document:
    return Document(body, form.media, headers=headers or {})
