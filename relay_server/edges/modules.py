"""``/api/v1/robots/<robot>/modules``: the nodes in a robot's graph, and what each does (SPEC section 1.13)."""

from __future__ import annotations

from typing import Any

from klein import Klein
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_server.edges.api import Api
from relay_server.edges.asked import UNTYPED
from relay_server.edges.collection import Collection
from relay_server.edges.resource_operations import member_of, members_of
from relay_server.openapi import described
from relay_server.openapi.told import Module, Modules
from relay_server.resources import ModuleDesk, Moments, ResourceDesk
from relay_server.resources.describing import module_graph


class RobotModules(Collection):
    """Modules of one robot, for one request.

    :param modules: tells of them
    """

    app = Klein()
    part = "modules"
    typed = False

    def __init__(
        self, modules: ModuleDesk, moments: Moments, desk: ResourceDesk, api: Api, robot: str
    ) -> None:
        super().__init__(moments, desk, api, robot)
        self._modules = modules

    @app.route("/", methods=["GET"])
    @described(members_of("modules", "A page of the nodes in the robot's graph", Modules, listing=UNTYPED))
    def members(self, request: Request) -> Any:
        return self._page(request, self._modules.members)

    @app.route("/<path:name>", methods=["GET"])
    @described(member_of("modules", "A node, with what it does as far as the caller may know", Module))
    def one(self, request: Request, name: str) -> Any:
        return self._member(request, name, self._modules.module, module_graph)

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def below(modules: ModuleDesk, moments: Moments, desk: ResourceDesk, api: Api, robot: str) -> IResource:
    """What serves the address of a robot's modules."""
    resource: IResource = RobotModules(modules, moments, desk, api, robot).app.resource()
    return resource
