"""``/api/v1/robots/<robot>/people``: who is at a robot."""

from __future__ import annotations

from typing import Any, Protocol

from klein import Klein
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_server.access import Principal
from relay_server.http.api import Api
from relay_server.http.openapi.operation import ApiOperation, Response, described
from relay_server.http.openapi.schemas import RobotUsers


class PresencePort(Protocol):
    """What is asked; see :class:`relay_server.sessions.summaries.RobotSummaries`."""

    async def people(self, principal: Principal, robot: str) -> dict[str, Any]:
        """Who is at a robot."""


class RobotUsersResource:
    """The people at one robot, for one request."""

    app = Klein()

    def __init__(self, desk: PresencePort, api: Api, robot: str) -> None:
        self._desk = desk
        self._api = api
        self._robot = robot

    @app.route("/", methods=["GET"])
    @described(
        ApiOperation(
            method="GET",
            path="/api/v1/robots/{robot}/people",
            tag="robots",
            summary="Who is at a robot, and how good its link is",
            answers={200: Response("people", RobotUsers)},
        )
    )
    def people(self, request: Request) -> Any:
        return self._api.answer(request, self._people(request))

    async def _people(self, request: Request) -> Any:
        return await self._desk.people(await self._api.principal(request), self._robot)

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def below(desk: PresencePort, api: Api, robot: str) -> IResource:
    """What serves the address below a robot's ``people``."""
    resource: IResource = RobotUsersResource(desk, api, robot).app.resource()
    return resource
