"""``/api/v1/robots/<robot>/modules``: the nodes in a robot's graph, and what each does (SPEC section 1.13)."""

from __future__ import annotations

from typing import Any

from klein import Klein
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_server.common.freshness_tokens import FreshnessTokens
from relay_server.http.api import Api
from relay_server.http.openapi.operation import described
from relay_server.http.openapi.schemas import NodeInfo, NodePage
from relay_server.http.rdf.encode import module_graph
from relay_server.http.request_params import UNTYPED
from relay_server.resources.nodes import NodeService
from relay_server.resources.operations import member_of, members_of
from relay_server.resources.read_only_collection import ReadOnlyCollection
from relay_server.resources.service import RobotResourceService


class NodeResource(ReadOnlyCollection):
    """Modules of one robot, for one request.

    :param modules: tells of them
    """

    app = Klein()
    part = "modules"
    typed = False

    def __init__(
        self, modules: NodeService, moments: FreshnessTokens, desk: RobotResourceService, api: Api, robot: str
    ) -> None:
        super().__init__(moments, desk, api, robot)
        self._modules = modules

    @app.route("/", methods=["GET"])
    @described(members_of("modules", "A page of the nodes in the robot's graph", NodePage, listing=UNTYPED))
    def members(self, request: Request) -> Any:
        return self._page(request, self._modules.members)

    @app.route("/<path:name>", methods=["GET"])
    @described(member_of("modules", "A node, with what it does as far as the caller may know", NodeInfo))
    def one(self, request: Request, name: str) -> Any:
        return self._member(request, name, self._modules.module, module_graph)

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def below(
    modules: NodeService, moments: FreshnessTokens, desk: RobotResourceService, api: Api, robot: str
) -> IResource:
    """What serves the address of a robot's modules."""
    resource: IResource = NodeResource(modules, moments, desk, api, robot).app.resource()
    return resource
