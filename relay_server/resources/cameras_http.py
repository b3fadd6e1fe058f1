"""``/api/v1/robots/<robot>/cameras``: which there are, and where the pictures of each are (SPEC section 1.13)."""

from __future__ import annotations

from typing import Any, TypedDict

from klein import Klein
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_server.common.freshness_tokens import FreshnessTokens
from relay_server.http.api import Api
from relay_server.http.openapi.operation import described
from relay_server.http.openapi.schemas import CameraInfo
from relay_server.http.rdf.encode import camera_graph
from relay_server.resources.cameras import CameraService
from relay_server.resources.operations import member_of, members_of
from relay_server.resources.read_only_collection import ReadOnlyCollection
from relay_server.resources.service import RobotResourceService


class CameraPage(TypedDict):
    """A page of cameras.

    :param next: the name behind which there is more, or empty
    """

    cameras: list[CameraInfo]
    next: str


class CameraAddresses(TypedDict):
    """Paths at which the pictures of a camera are had (SPEC section 1.8).

    :param viewer: a page with the stream in it
    """

    snapshot: str
    stream: str
    viewer: str
    websocket: str


class AddressedCamera(CameraInfo):
    """A camera, and where its pictures are."""

    addresses: CameraAddresses


class CameraResource(ReadOnlyCollection):
    """Cameras of one robot, for one request.

    :param cameras: tells of them
    """

    app = Klein()
    part = "cameras"

    def __init__(
        self,
        cameras: CameraService,
        moments: FreshnessTokens,
        desk: RobotResourceService,
        api: Api,
        robot: str,
    ) -> None:
        super().__init__(moments, desk, api, robot)
        self._cameras = cameras

    @app.route("/", methods=["GET"])
    @described(members_of("cameras", "A page of the cameras that the caller may view", CameraPage))
    def members(self, request: Request) -> Any:
        return self._page(request, self._cameras.members)

    @app.route("/<path:name>", methods=["GET"])
    @described(member_of("cameras", "A camera, and where its pictures are", AddressedCamera))
    def one(self, request: Request, name: str) -> Any:
        return self._member(request, name, self._cameras.camera, camera_graph)

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def below(
    cameras: CameraService, moments: FreshnessTokens, desk: RobotResourceService, api: Api, robot: str
) -> IResource:
    """What serves the address of a robot's cameras."""
    resource: IResource = CameraResource(cameras, moments, desk, api, robot).app.resource()
    return resource
