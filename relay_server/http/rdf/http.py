"""``/api/v1/vocabulary``: what the words of the forms of RDF mean, at their own addresses (SPEC section 1.13)."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from klein import Klein
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_protocol.errors import Invalid, NotFound
from relay_protocol.ros.definition import Definition, normalise
from relay_server.access import Access, Principal
from relay_server.common.database import BoundedThreadPool
from relay_server.common.fair_lock import FairLock
from relay_server.http.api import STREAMED, Api
from relay_server.http.media_types import MediaType, tags_of, wanted
from relay_server.http.openapi.operation import (
    PROBLEM,
    ApiOperation,
    Credential,
    Parameter,
    Response,
    described,
    header,
)
from relay_server.http.openapi.schemas import Available
from relay_server.http.rdf.vocabulary_page import DOCUMENTS, fixed, is_fixed, of_type
from relay_server.http.request_params import field
from relay_server.relay_node.interfaces import TYPES
from relay_server.resources.etags import tag_of
from relay_server.robots.registry import RobotRegistry

PLACE = "/api/v1/vocabulary"

_TAGGED = {"ETag": "names this text"}
_MEDIA = tuple(each.media for each in DOCUMENTS)


def _described(path: str, summary: str, named: Parameter, credential: Credential) -> ApiOperation:
    return ApiOperation(
        method="GET",
        path=f"{PLACE}/{path}",
        tag="relay",
        summary=summary,
        parameters=(named, header("If-None-Match", "entity tags of what is known already")),
        answers={
            200: Response("the document", media=_MEDIA, headers=_TAGGED),
            304: Response("it is as it is known", headers=_TAGGED),
        },
        problems={406: Response("none of these forms is accepted", Available, media=(PROBLEM,))},
        credential=credential,
    )


def _named(words: str) -> Parameter:
    return Parameter("name", words, str, "path", True)


_OF_TYPE = "What a type of messages is, and its fields"
_NOT_WHOLE = "of a part of one: `…_Request`, `…_Response`, `…_Goal`, `…_Result`, `…_Feedback`"

NOT_KNOWN = (
    "no robot that you have a right on has told what this is; ask for a topic of that type as RDF, then again"
)


class TypeDocs:
    """Types of messages, as the robots somebody may know of have told them.

    :param threads: do what takes long
    """

    def __init__(self, access: Access, registry: RobotRegistry, threads: BoundedThreadPool) -> None:
        self._access = access
        self._registry = registry
        self._threads = threads
        self._turns = FairLock()

    async def of_type(self, principal: Principal, name: str, form: MediaType, base: str) -> bytes:
        """What a type is.

        :param name: in full
        :param base: ``scheme://host[:port]`` of the relay, as who asks sees it
        :raises NotFound: nobody that he may ask has told
        :raises Unavailable: too much is being converted
        """
        definition = await self._definition(principal, name)
        async with self._turns.turn(principal.user_id):
            return await self._threads.run(of_type, definition, form, base)

    async def _definition(self, principal: Principal, name: str) -> Definition:
        robots = [self._registry.find(record.id) for record, _ in await self._access.robots(principal)]
        for types in (TYPES, *(robot.types for robot in robots if robot is not None)):
            with suppress(NotFound):
                return types.definitions(name)[name]
        raise NotFound(NOT_KNOWN)


class VocabularyResource:
    """The addresses of words, for one request."""

    app = Klein()

    def __init__(self, meanings: TypeDocs, api: Api) -> None:
        self._meanings = meanings
        self._api = api

    @app.route("/<name>", methods=["GET"])
    @described(
        _described(
            "{name}",
            "What the words of the forms of RDF mean",
            _named("`switchboard`: the relay's own words, or `fields`: names of fields without a type"),
            Credential.NONE,
        )
    )
    def words(self, request: Request, name: str) -> Any:
        return self._api.answer(request, self._words(request, name))

    async def _words(self, request: Request, name: str) -> Any:
        # It says nothing of anybody: like the portal's files it is there for all.
        if not is_fixed(name):
            raise NotFound("there is nothing at this address")
        form = _form(request)
        return _told(request, fixed(name, form, self._api.base(request)), form)

    @app.route("/<package>/<name>", methods=["GET"])
    @described(_described("{package}/{name}", _OF_TYPE, _named("of the type"), Credential.USER))
    def message(self, request: Request, package: str, name: str) -> Any:
        return self._api.answer(request, self._type(request, f"{package}/msg/{name}"))

    @app.route("/<package>/<any(srv,action):kind>/<name>", methods=["GET"])
    @described(
        _described("{package}/srv/{name}", "The same of a service", _named(_NOT_WHOLE), Credential.USER),
        _described("{package}/action/{name}", "The same of an action", _named(_NOT_WHOLE), Credential.USER),
    )
    def part(self, request: Request, package: str, kind: str, name: str) -> Any:
        return self._api.answer(request, self._type(request, f"{package}/{kind}/{name}"))

    async def _type(self, request: Request, name: str) -> Any:
        principal, form = await self._api.principal(request), _form(request)
        try:
            known = normalise(name)
        except Invalid:
            raise NotFound(NOT_KNOWN) from None
        body = await self._meanings.of_type(principal, known, form, self._api.base(request))
        return _told(request, body, form)

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def beside(meanings: TypeDocs, api: Api) -> IResource:
    """What serves ``/api/v1/vocabulary``."""
    resource: IResource = VocabularyResource(meanings, api).app.resource()
    return resource


def _form(request: Request) -> MediaType:
    """:raises NotAcceptable: the request takes none of the forms there are"""
    request.setHeader(b"vary", b"Accept")
    return wanted(field(request, "accept"), DOCUMENTS)


def _told(request: Request, body: bytes, form: MediaType) -> Any:
    tag = form.tag(tag_of(body))
    request.setHeader(b"etag", tag.encode())
    if tag in tags_of(field(request, "if-none-match")):
        request.setResponseCode(304)
        return STREAMED
    request.setHeader(b"content-type", f"{form.media}; charset=utf-8".encode())
    request.write(body)
    return STREAMED
