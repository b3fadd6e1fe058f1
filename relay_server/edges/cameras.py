"""``/api/v1/robots/<robot>/cameras``: which there are, and where the pictures of each are (SPEC section 1.13)."""

from __future__ import annotations

from collections.abc import Awaitable
from typing import Any, TypedDict

from klein import Klein
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_server.edges.api import STREAMED, Api
from relay_server.edges.asked import query_of
from relay_server.edges.goals import LISTING
from relay_server.edges.representing import Representing
from relay_server.openapi import PROBLEM, Answer, Operation, described, header
from relay_server.openapi.kept import Camera
from relay_server.openapi.told import Available
from relay_server.resources import HEADER, Asker, CameraDesk, Listing, Moments, ResourceDesk
from relay_server.resources.forms import FORMS

PLACE = "/api/v1/robots/{robot}/cameras"

_MEDIA = tuple(each.media for each in FORMS)
_KNOWN = header("If-None-Match", "entity tags of what is known already")
_TAGGED = {
    "ETag": "names this state in this form",
    HEADER: "when this was answered; what moves the robot gives it back",
}
_UNCHANGED = Answer("it is as it is known", headers=_TAGGED)
_NOT_ACCEPTABLE = {406: Answer("none of these forms is accepted", Available, media=(PROBLEM,))}


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


class RobotCameras:
    """Cameras of one robot, for one request.

    :param cameras: tells of them
    :param forms: in which they are told
    """

    app = Klein()

    def __init__(
        self, cameras: CameraDesk, moments: Moments, forms: Representing, api: Api, robot: str
    ) -> None:
        self._cameras = cameras
        self._moments = moments
        self._forms = forms
        self._api = api
        self._robot = robot

    @app.route("/", methods=["GET"])
    @described(
        Operation(
            method="GET",
            path=PLACE,
            tag="resources",
            summary="A page of the cameras that the caller may view",
            parameters=(*LISTING, _KNOWN),
            answers={200: Answer("a page", CameraPage, media=_MEDIA, headers=_TAGGED), 304: _UNCHANGED},
            problems=_NOT_ACCEPTABLE,
        )
    )
    def members(self, request: Request) -> Any:
        return self._answer(request, self._members(request))

    async def _members(self, request: Request) -> Any:
        asker, form = await self._asker(request), self._forms.form(request)
        page = await self._cameras.members(asker, Listing.of(query_of(request)))
        return await self._forms.members(request, asker, page, form)

    @app.route("/<path:name>", methods=["GET"])
    @described(
        Operation(
            method="GET",
            path=f"{PLACE}/{{name}}",
            tag="resources",
            summary="A camera, and where its pictures are",
            parameters=(_KNOWN,),
            answers={
                200: Answer("the camera", AddressedCamera, media=_MEDIA, headers=_TAGGED),
                304: _UNCHANGED,
            },
            problems=_NOT_ACCEPTABLE,
        )
    )
    def one(self, request: Request, name: str) -> Any:
        return self._answer(request, self._one(request, name))

    async def _one(self, request: Request, name: str) -> Any:
        asker, form = await self._asker(request), self._forms.form(request)
        return await self._forms.camera(request, asker, await self._cameras.camera(asker, name), form)

    # --- requests and answers -----------------------------------------------------------------------------

    def _answer(self, request: Request, work: Awaitable[Any]) -> Any:
        async def dated() -> Any:
            try:
                answer = await work
            finally:
                request.setHeader(HEADER, self._moments.now())
            if not isinstance(answer, bytes):
                return answer
            # It is no JSON. All headers are there now.
            request.write(answer)
            return STREAMED

        return self._api.answer(request, dated())

    async def _asker(self, request: Request) -> Asker:
        address = getattr(request.getClientAddress(), "host", "local")
        return Asker(await self._api.principal(request), self._robot, address)

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def below(cameras: CameraDesk, moments: Moments, desk: ResourceDesk, api: Api, robot: str) -> IResource:
    """What serves the address of a robot's cameras."""
    forms = Representing(api, desk, robot, "cameras")
    resource: IResource = RobotCameras(cameras, moments, forms, api, robot).app.resource()
    return resource
