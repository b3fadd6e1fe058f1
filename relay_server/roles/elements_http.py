"""``/api/v1/roles/<role>/elements``: elements of Roles, and commands on them."""

from __future__ import annotations

from contextlib import suppress
from functools import partial

from relay_protocol.errors import NotFound, SwitchboardError
from relay_server.cluster.relays import RelayInfo
from relay_server.http.endpoint import ApiRequest, Freshness, IdempotencyKey, endpoint
from relay_server.resources.collections_http import MOVING
from relay_server.resources.page import PageQuery
from relay_server.roles.bindings import KINDS, Command
from relay_server.roles.commands import RoleCommands, RoleUser
from relay_server.roles.schemas import (
    ElementCall,
    ElementDone,
    ElementValue,
    NewElementValue,
    RoleElementPage,
)
from relay_server.roles.service import RoleService

BASE_PATH = "/api/v1/roles/{role}/elements"

_CALL = ElementCall()
_COMMANDS: dict[bytes, Command] = {b"GET": "get", b"HEAD": "get", b"PUT": "set"}


class RoleElementEndpoints:
    """Elements of Roles of the caller's realm."""

    def __init__(self, service: RoleService, commands: RoleCommands) -> None:
        self._service = service
        self._commands = commands

    async def relay_of(
        self, request: ApiRequest, role: str, element: str = "", command: str = ""
    ) -> RelayInfo | None:
        """The home of the robot that the element is bound to, or the relay that its pipe runs at."""
        wanted = command or _COMMANDS.get(request.http.method)
        if request.forwarding is None or not element or wanted not in KINDS:
            return None
        relay_of_robot = partial(request.forwarding.relay_of, request.principal, from_memory=False)
        with suppress(SwitchboardError):
            return await self._commands.relay_of(_user(request), role, element, wanted, relay_of_robot)
        # The handler says what is wrong.
        return None

    @endpoint(
        "GET", BASE_PATH, tag="roles", summary="The elements of a Role", returns="a page", errors=(404,)
    )
    async def list(self, request: ApiRequest, role: str, query: PageQuery) -> RoleElementPage:
        elements = await self._service.elements(request.principal, role)
        found, after = query.page({each.name: each for each in elements}, lambda _: ())
        return RoleElementPage([each for _, each in found], after)

    @endpoint(
        "GET",
        f"{BASE_PATH}/{{element}}",
        tag="roles",
        summary="The value of an element",
        more="Of the resource that the element is bound to, or an element that it is mapped to within the Role: the "
        "newest message of a topic, a parameter, or the state of a module or pipe; or a field of it.",
        returns="the value",
        freshness=Freshness.GIVEN,
        errors=(404, *MOVING),
    )
    async def get(self, request: ApiRequest, role: str, element: str) -> ElementValue:
        return await self._commands.get(_user(request), role, element)

    @endpoint(
        "PUT",
        f"{BASE_PATH}/{{element}}",
        tag="roles",
        summary="Set the value of an element",
        more="Publishes a message or sets a parameter. Of a field of a topic a message is published whose other "
        "fields have their default values. A topic `<name>/set`, as of devices, goes before `<name>`.",
        returns="it was sent",
        numbers=("value",),
        key=IdempotencyKey.REFUSED,
        freshness=Freshness.TAKEN,
        errors=(404, *MOVING),
    )
    async def set(self, request: ApiRequest, role: str, element: str, body: NewElementValue) -> ElementDone:
        return await self._commands.set(_user(request), role, element, body)

    @endpoint(
        "POST",
        f"{BASE_PATH}/{{element}}/{{command}}",
        tag="roles",
        summary="Call, start or stop an element",
        more="`call` calls a service, or has a goal executed by an action and waits for its end: `args` are the goal, "
        "and one that has not ended within `timeout` is cancelled. `stop` of an action cancels the caller's goals. "
        "`start` and `stop` are for a module, a pipe, and a device that is switched: a "
        "topic of type `std_msgs/msg/Bool` or a service of type `std_srvs/srv/SetBool`. The body is for `call` alone.",
        returns="it was done, or is pending",
        numbers=("args",),
        names={"command": "`call`, `start` or `stop`"},
        key=IdempotencyKey.REFUSED,
        freshness=Freshness.TAKEN,
        errors=(404, *MOVING),
    )
    async def order(
        self, request: ApiRequest, role: str, element: str, command: str, body: ElementCall = _CALL
    ) -> ElementDone:
        user = _user(request)
        if command == "call":
            request.extend_time_limit(body.timeout)
            return await self._commands.call(user, role, element, body)
        if command in ("start", "stop"):
            return await self._commands.switch(user, role, element, "start" if command == "start" else "stop")
        raise NotFound(f"'{command[:20]}' is not 'call', 'start' or 'stop'")


def _user(request: ApiRequest) -> RoleUser:
    return RoleUser(request.principal, request.address, request.earliest_sent)
