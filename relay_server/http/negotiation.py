"""Resources in the form a request wants, and out of the form its body has (SPEC section 1.13, Forms)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Annotated, Any, ParamSpec, TypeVar
from urllib.parse import urlsplit

import msgspec
from msgspec import Meta
from rdflib import Graph
from twisted.web.server import Request

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, Unavailable
from relay_protocol.limits import NAME
from relay_server.common.database import BoundedThreadPool
from relay_server.http.api import STREAMED, Api, body_of
from relay_server.http.media_types import FORMS, JSON, MediaType, sent, tags_of, wanted
from relay_server.http.rdf.decode import DecodedGraph, message_in, value_in
from relay_server.http.rdf.encode import members_graph, param_graph, state_graph
from relay_server.http.rdf.serialize import read, write
from relay_server.http.request_params import field
from relay_server.resources.etags import ParamState, TopicState, tag_of, weak
from relay_server.resources.location import ResourceLocation
from relay_server.resources.service import RequestOrigin, RobotResourceService

P = ParamSpec("P")
T = TypeVar("T")

TypeName = Annotated[str, Meta(max_length=NAME)]


class MessageBody(msgspec.Struct, forbid_unknown_fields=True):
    """Body of what is said on a topic; ``type`` for one that nobody knows yet. What was read of it may be sent back.

    :param topic: the one at whose address this is sent
    :param at: passed over
    """

    value: msgspec.Raw
    type: TypeName = ""
    topic: TypeName = ""
    at: float | None = None


class ValueBody(msgspec.Struct, forbid_unknown_fields=True):
    """Body of a parameter that is set. What was read of it may be sent back.

    :param name: the one at whose address this is sent
    """

    value: msgspec.Raw
    name: TypeName = ""


class ConversionPool(BoundedThreadPool):
    """Where RDF is written and read: it takes long, and one at a time leaves the reactor its turns.

    :param reactor: calls results back
    """

    def __init__(self, reactor: Any) -> None:
        super().__init__(
            reactor, "forms", 1, 1, "too much is being converted; try again in a moment", only_reads=True
        )
        self._closed = False

    def close(self) -> None:
        """Begin nothing more; what waits for its turn fails."""
        self._closed = True

    async def run(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """As above.

        :raises Unavailable: as above, or the relay goes down
        """
        if self._closed:
            raise Unavailable("the relay is going down")
        return await super().run(work, *args, **kwargs)


class ContentNegotiation:
    """The forms of one robot's resources.

    :param part: the collection they are in
    """

    def __init__(self, api: Api, desk: RobotResourceService, robot: str, part: str) -> None:
        self._api = api
        self._desk = desk
        self._robot = robot
        self._part = part

    def form(self, request: Request, *more: MediaType) -> MediaType:
        """The form in which to answer.

        :param more: forms there are of just this resource
        :raises NotAcceptable: the request takes none
        """
        request.setHeader(b"vary", b"Accept")
        return wanted(field(request, "accept"), (*FORMS, *more))

    async def state(self, request: Request, asker: RequestOrigin, state: TopicState, form: MediaType) -> Any:
        """What a topic says."""
        tag = weak(form.tag(state.etag))
        if form is JSON:
            return _tagged(request, tag, state.json())
        background = await self._desk.background(asker, state)
        make = partial(state_graph, state, background, self._place(request))
        return await self._written(request, asker, make, form, tag)

    async def param(self, request: Request, asker: RequestOrigin, param: ParamState, form: MediaType) -> Any:
        """A parameter."""
        if self._known(request, form.tag(param.etag)):
            return STREAMED
        if form is JSON:
            return _tagged(request, param.etag, param.json())
        return await self._written(
            request, asker, partial(param_graph, param, self._place(request)), form, form.tag(param.etag)
        )

    async def members(
        self, request: Request, asker: RequestOrigin, page: Mapping[str, Any], form: MediaType
    ) -> Any:
        """A page of the collection."""
        return await self.told(request, asker, page, partial(members_graph, self._part), form)

    async def told(
        self,
        request: Request,
        asker: RequestOrigin,
        facts: Mapping[str, Any],
        graph: Callable[[Mapping[str, Any], ResourceLocation], Graph],
        form: MediaType,
    ) -> Any:
        """What is the same as long as its JSON is.

        :param graph: makes a graph of the facts
        """
        body = jsontext.encode(facts)
        etag = tag_of(body)
        if self._known(request, form.tag(etag)):
            return STREAMED
        if form is JSON:
            return _tagged(request, etag, body)
        make = partial(graph, facts, self._place(request))
        return await self._written(request, asker, make, form, form.tag(etag))

    async def message(self, request: Request, asker: RequestOrigin, name: str) -> MessageBody:
        """The message in a request's body.

        :raises UnknownForm: it is in none that is read
        :raises Invalid: there is none that can be read; in words
        """
        form = sent(request.getHeader("content-type"))
        if form is JSON:
            message = body_of(request, MessageBody, ("value",))
            _see_own("topic", message.topic, name)
            return message
        meant: DecodedGraph = await self._read(request, asker, name, form, message_in)
        return MessageBody(msgspec.Raw(jsontext.encode(meant.value)), meant.type)

    async def value(self, request: Request, asker: RequestOrigin, name: str) -> bytes:
        """The value of a parameter in a request's body, as JSON; see :meth:`message`."""
        form = sent(request.getHeader("content-type"))
        if form is JSON:
            param = body_of(request, ValueBody, ("value",))
            _see_own("name", param.name, name)
            return bytes(param.value)
        return jsontext.encode(await self._read(request, asker, name, form, value_in))

    async def _read(
        self,
        request: Request,
        asker: RequestOrigin,
        name: str,
        form: MediaType,
        find: Callable[[Graph, str], Any],
    ) -> Any:
        address = self._place(request).of(self._part, name)
        body = request.content.read()
        return await self._desk.made(asker, lambda: find(read(body, form, address), urlsplit(address).path))

    async def _written(
        self, request: Request, asker: RequestOrigin, make: Callable[[], Graph], form: MediaType, tag: str
    ) -> bytes:
        body = await self._desk.made(asker, lambda: write(make(), form))
        request.setHeader(b"etag", tag.encode())
        request.setHeader(b"content-type", f"{form.media}; charset=utf-8".encode())
        return body

    def _known(self, request: Request, tag: str) -> bool:
        """Whether who asks has it already, which he is told then."""
        if tag not in tags_of(field(request, "if-none-match")):
            return False
        request.setHeader(b"etag", tag.encode())
        request.setResponseCode(304)
        return True

    def _place(self, request: Request) -> ResourceLocation:
        return ResourceLocation(self._api.base(request), self._robot)


def _see_own(field: str, said: str, name: str) -> None:
    """See that a body is about the resource at whose address it is sent, where it names one.

    :raises Invalid: it is about another
    """
    if said and said.lstrip("/") != name.lstrip("/"):
        raise Invalid(
            f"'{field}' names another resource than the address does: leave it out, or send this there"
        )


def _tagged(request: Request, etag: str, body: bytes) -> Any:
    request.setHeader(b"etag", etag.encode())
    return msgspec.Raw(body)
