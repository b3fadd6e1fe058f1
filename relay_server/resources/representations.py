"""Representations of robots' resources, and request bodies in RDF (SPEC 1.13, Forms)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Annotated, Any, ParamSpec, TypeVar
from urllib.parse import urlsplit

import msgspec
from msgspec import Meta
from rdflib import Graph

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, Unavailable
from relay_protocol.limits import NAME
from relay_server.common.database import BoundedThreadPool
from relay_server.http.endpoint import ApiRequest, Representation
from relay_server.http.media_types import MediaType
from relay_server.http.rdf.decode import DecodedGraph, message_in, value_in
from relay_server.http.rdf.encode import members_graph, param_graph, state_graph
from relay_server.http.rdf.serialize import read, write
from relay_server.in_process_sessions.pool import RobotCaller
from relay_server.resources.service import RobotResourceService
from relay_server.resources.states import ParamState, ResourceLocation, TopicState

P = ParamSpec("P")
T = TypeVar("T")
GraphMaker = Callable[[Mapping[str, Any], ResourceLocation], Graph]

TypeName = Annotated[str, Meta(max_length=NAME)]


class MessageBody(msgspec.Struct, forbid_unknown_fields=True):
    """A message to be published. A body that was read from the topic can be sent back unchanged.

    :param type: needed if the robot does not know the topic yet
    :param topic: the topic of the address, or omitted
    :param at: ignored
    """

    value: msgspec.Raw
    type: TypeName = ""
    topic: TypeName = ""
    at: float | None = None


class ValueBody(msgspec.Struct, forbid_unknown_fields=True):
    """A value for a parameter. A body that was read from the parameter can be sent back unchanged.

    :param name: the parameter of the address, or omitted
    """

    value: msgspec.Raw
    name: TypeName = ""


class ConversionPool(BoundedThreadPool):
    """A thread that writes and reads RDF: that takes long, and more threads would delay the reactor.

    :param reactor: calls back with results
    """

    def __init__(self, reactor: Any) -> None:
        super().__init__(
            reactor,
            "forms",
            1,
            1,
            "too many conversions are in progress; try again in a moment",
            only_reads=True,
        )
        self._closed = False

    def close(self) -> None:
        """Begin no more work; waiting work fails."""
        self._closed = True

    async def run(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run work in the thread.

        :raises Unavailable: too much work waits, or the relay shuts down
        """
        if self._closed:
            raise Unavailable("the relay is shutting down; try again later")
        return await super().run(work, *args, **kwargs)


def caller_at(request: ApiRequest, robot: str) -> RobotCaller:
    """The caller of a request to a robot."""
    return RobotCaller(request.principal, robot, request.address)


def location(request: ApiRequest, robot: str) -> ResourceLocation:
    """The address of a robot's resources, as the caller addresses the relay.

    :raises Invalid: the request has no usable ``Host``
    """
    return ResourceLocation(request.base, robot)


def facts(
    service: RobotResourceService, request: ApiRequest, robot: str, value: Any, graph: GraphMaker
) -> Representation[Any]:
    """A representation whose state is its JSON.

    :param graph: makes its RDF graph
    """

    async def render(form: MediaType) -> bytes:
        place = location(request, robot)
        return await service.convert(caller_at(request, robot), lambda: write(graph(value, place), form))

    return Representation(value, render)


def page(
    service: RobotResourceService, request: ApiRequest, robot: str, part: str, members: Any
) -> Representation[Any]:
    """A page of a collection of a robot.

    :param part: the last segment of its address
    """
    return facts(service, request, robot, members, partial(members_graph, part))


def newest_message(
    service: RobotResourceService, request: ApiRequest, robot: str, state: TopicState
) -> Representation[Any]:
    """The newest message of a topic. Its tag is weak, since equal messages may have different times."""

    async def render(form: MediaType) -> bytes:
        caller, place = caller_at(request, robot), location(request, robot)
        context = await service.topic_context(caller, state)
        return await service.convert(caller, lambda: write(state_graph(state, context, place), form))

    return Representation(msgspec.Raw(state.json()), render, state.etag, weak=True)


def param_state(
    service: RobotResourceService, request: ApiRequest, robot: str, param: ParamState
) -> Representation[Any]:
    """A parameter and its value."""

    async def render(form: MediaType) -> bytes:
        place = location(request, robot)
        return await service.convert(
            caller_at(request, robot), lambda: write(param_graph(param, place), form)
        )

    return Representation(msgspec.Raw(param.json()), render, param.etag)


async def read_message(
    service: RobotResourceService, request: ApiRequest, form: MediaType, robot: str, name: str
) -> MessageBody:
    """The message in a body in RDF.

    :raises Invalid: there is none, or it is not valid
    """
    found: DecodedGraph = await _read(service, request, form, robot, "topics", name, message_in)
    return MessageBody(msgspec.Raw(jsontext.encode(found.value)), found.type)


async def read_value(
    service: RobotResourceService, request: ApiRequest, form: MediaType, robot: str, name: str
) -> ValueBody:
    """The value of a parameter in a body in RDF; see :func:`read_message`."""
    found = await _read(service, request, form, robot, "params", name, value_in)
    return ValueBody(msgspec.Raw(jsontext.encode(found)))


async def _read(
    service: RobotResourceService,
    request: ApiRequest,
    form: MediaType,
    robot: str,
    part: str,
    name: str,
    find: Callable[[Graph, str], Any],
) -> Any:
    address, body = location(request, robot).of(part, name), request.content()
    return await service.convert(
        caller_at(request, robot), lambda: find(read(body, form, address), urlsplit(address).path)
    )


def check_own(field: str, given: str, name: str) -> None:
    """Check that a body that names a resource names that of its address.

    :raises Invalid: it names another
    """
    if given and given.lstrip("/") != name.lstrip("/"):
        raise Invalid(
            f"'{field}' is '{given[:100]}', which is not the resource of this address: remove the field, or use the "
            "address of that resource"
        )
