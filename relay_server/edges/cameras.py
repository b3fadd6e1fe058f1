"""``/api/v1/robots/<robot>/cameras``: which there are, and where the pictures of each are (SPEC section 1.13)."""

from __future__ import annotations

from typing import Any, TypedDict

from klein import Klein
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_server.edges.api import Api
from relay_server.edges.collection import Collection
from relay_server.edges.resource_operations import member_of, members_of
from relay_server.openapi import described
from relay_server.openapi.kept import Camera
from relay_server.resources import CameraDesk, Moments, ResourceDesk
from relay_server.resources.describing import camera_graph


class CameraPage(TypedDict):
    """A page of cameras.

    :param next: the name behind which there is more, or empty
    """

    cameras: list[Camera]
    next: str


class CameraAddresses(TypedDict):
    """Paths at which the pictures of a camera are had (SPEC section 1.8).

    :param viewer: a page with the stream in it
    """

    snapshot: str
    stream: str
    viewer: str
    websocket: str


class AddressedCamera(Camera):
    """A camera, and where its pictures are."""

    addresses: CameraAddresses


class RobotCameras(Collection):
    """Cameras of one robot, for one request.

    :param cameras: tells of them
    """

    app = Klein()
    part = "cameras"

    def __init__(
        self, cameras: CameraDesk, moments: Moments, desk: ResourceDesk, api: Api, robot: str
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


def below(cameras: CameraDesk, moments: Moments, desk: ResourceDesk, api: Api, robot: str) -> IResource:
    """What serves the address of a robot's cameras."""
    resource: IResource = RobotCameras(cameras, moments, desk, api, robot).app.resource()
    return resource
