"""Services, actions and parameters of robots over HTTP (SPEC 1.13)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Annotated

import msgspec
from msgspec import UNSET, Meta, UnsetType

from relay_protocol import jsontext
from relay_protocol.rights import Operation
from relay_server.channels.names import resolve
from relay_server.http.endpoint import (
    Answered,
    ApiRequest,
    Endpoint,
    Freshness,
    IdempotencyKey,
    Representation,
    endpoint,
)
from relay_server.http.idempotency import Idempotency, StoredReply, once
from relay_server.http.media_types import FORMS, MediaType, of_any_form
from relay_server.http.openapi.operation import raw
from relay_server.http.request_fields import wait_preferred
from relay_server.resources import representations
from relay_server.resources.collections_http import (
    MOVING,
    ROBOT_PATH,
    GraphCollection,
    member_endpoint,
    page_endpoint,
    read_only,
)
from relay_server.resources.page import TypedPageQuery
from relay_server.resources.representations import TypeName, ValueBody, caller_at
from relay_server.resources.schemas import (
    ActionPage,
    CallAnswer,
    ParamPage,
    ParamValue,
    Provided,
    ServicePage,
)
from relay_server.resources.service import RobotResourceService
from relay_server.sessions.service_calls import STOPPING_SERVICES

TIMEOUT = 10.0
"""Default timeout of a service call, in seconds."""

LEAST_TIMEOUT = 0.1


class ServiceCall(msgspec.Struct, forbid_unknown_fields=True):
    """A call of a service.

    :param args: an object, or a list in the order of the fields
    :param timeout: seconds; by default those of ``Prefer: wait``, or 10
    """

    args: msgspec.Raw = raw(b"{}")
    type: TypeName = ""
    timeout: Annotated[float, Meta(ge=LEAST_TIMEOUT, le=300.0)] | UnsetType = UNSET


NO_ARGUMENTS = ServiceCall()


def _stops_robot(request: ApiRequest, names: Mapping[str, str]) -> bool:
    return resolve(names["name"]) in STOPPING_SERVICES


class ServiceEndpoints(GraphCollection):
    """Services of robots.

    :param remembered: answers to requests with an idempotency key
    """

    kind = "services"

    def __init__(self, service: RobotResourceService, remembered: Idempotency) -> None:
        super().__init__(service)
        self._remembered = remembered

    @page_endpoint("services")
    async def members(
        self, request: ApiRequest, robot: str, query: TypedPageQuery
    ) -> Representation[ServicePage]:
        return await self.page(request, robot, query)

    @member_endpoint("services", "A service")
    async def one(self, request: ApiRequest, robot: str, name: str) -> Representation[Provided]:
        return await self.member(request, robot, name)

    @endpoint(
        "POST",
        f"{ROBOT_PATH}/services/{{name:path}}",
        tag="resources",
        summary="Call a service",
        more="Without a body the request is empty. `/relay/release_control` is never rate limited.",
        returns="the answer of the service",
        numbers=("args",),
        key=IdempotencyKey.HANDLED,
        freshness=Freshness.TAKEN,
        never_limited=_stops_robot,
        errors=MOVING,
    )
    async def call(
        self, request: ApiRequest, robot: str, name: str, body: ServiceCall = NO_ARGUMENTS
    ) -> Answered[CallAnswer]:
        caller = caller_at(request, robot)
        seconds = wait_preferred(request.http, LEAST_TIMEOUT) if body.timeout is UNSET else body.timeout
        timeout = TIMEOUT if seconds is None else seconds
        request.extend_time_limit(timeout)

        async def work() -> StoredReply:
            values = await self._service.call(
                caller, name, body.args, body.type, timeout, request.earliest_sent
            )
            return StoredReply(200, jsontext.encode({"values": msgspec.Raw(values)}))

        if resolve(name) in STOPPING_SERVICES:
            # A stop is always carried out, even with a key that was used before.
            reply = await work()
        else:
            may = partial(self._service.may, caller, Operation.CALL, name)
            reply = await once(self._remembered, request, robot, work, may)
        return Answered(msgspec.Raw(reply.body))


class ActionEndpoints(GraphCollection):
    """Actions of robots; goals are given in :mod:`relay_server.resources.goals_http`."""

    kind = "actions"

    @page_endpoint("actions")
    async def members(
        self, request: ApiRequest, robot: str, query: TypedPageQuery
    ) -> Representation[ActionPage]:
        return await self.page(request, robot, query)

    @member_endpoint("actions", "An action")
    async def one(self, request: ApiRequest, robot: str, name: str) -> Representation[Provided]:
        return await self.member(request, robot, name)


class ParameterEndpoints:
    """Parameters of the nodes of robots."""

    def __init__(self, service: RobotResourceService) -> None:
        self._service = service

    async def check_may_know(self, request: ApiRequest, robot: str, name: str = "") -> None:
        """:raises NotFound: no such robot or parameter, or the caller may not know of it"""
        if name:
            await read_only(self._service.param(caller_at(request, robot), name))
        else:
            await self._service.check_may_know(caller_at(request, robot))

    async def read_body(
        self, request: ApiRequest, endpoint: Endpoint, form: MediaType, robot: str, name: str
    ) -> ValueBody:
        """A value in RDF."""
        return await representations.read_value(self._service, request, form, robot, name)

    @page_endpoint("params", noun="parameters", errors=MOVING)
    async def members(
        self, request: ApiRequest, robot: str, query: TypedPageQuery
    ) -> Representation[ParamPage]:
        found = await read_only(self._service.params(caller_at(request, robot), query))
        return representations.page(self._service, request, robot, "params", found)

    @member_endpoint("params", "A parameter", errors=MOVING)
    async def one(self, request: ApiRequest, robot: str, name: str) -> Representation[ParamValue]:
        found = await read_only(self._service.param(caller_at(request, robot), name))
        return representations.param_state(self._service, request, robot, found)

    @endpoint(
        "PUT",
        f"{ROBOT_PATH}/params/{{name:path}}",
        tag="resources",
        summary="Set a parameter",
        returns="set",
        reads=FORMS,
        numbers=("value",),
        if_match=True,
        freshness=Freshness.GIVEN,
        errors=MOVING,
    )
    async def set(self, request: ApiRequest, robot: str, name: str, body: ValueBody) -> None:
        representations.check_own("name", body.name, name)
        match = of_any_form(request.header("if-match"))
        await self._service.set_param(caller_at(request, robot), name, bytes(body.value), match)

    @endpoint(
        "DELETE",
        f"{ROBOT_PATH}/params/{{name:path}}",
        tag="resources",
        summary="Delete a parameter",
        returns="deleted",
        if_match=True,
        freshness=Freshness.GIVEN,
        errors=MOVING,
    )
    async def remove(self, request: ApiRequest, robot: str, name: str) -> None:
        match = of_any_form(request.header("if-match"))
        await self._service.remove_param(caller_at(request, robot), name, match)
