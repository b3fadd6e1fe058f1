"""``/robots/<robot>/video/…`` over HTTP: which cameras there are, streams, snapshots, the way to the websocket.

A session cookie needs no Origin here, because an ``<img>`` sends none; but other sites' pages may not use it.
"""

from __future__ import annotations

import html
from collections.abc import Awaitable, Callable
from typing import Annotated, Any, Literal, Protocol

from msgspec import Meta
from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure
from twisted.web.resource import IResource, Resource
from twisted.web.server import NOT_DONE_YET, Request

from relay_protocol import jsontext, link
from relay_protocol.errors import Refused, SwitchboardError
from relay_protocol.limits import PICTURE_SIDE
from relay_server.access import Principal
from relay_server.auth.authenticator import TicketPurpose
from relay_server.common.clock import Clock
from relay_server.common.socket_writer import FlushScheduler
from relay_server.common.timers import PeriodicTimers
from relay_server.http.openapi.operation import (
    ApiOperation,
    Credential,
    Parameter,
    Response,
    described,
    query,
)
from relay_server.http.openapi.schemas import CameraList
from relay_server.http.problems import problem, problem_of
from relay_server.http.site import wants_websocket
from relay_server.http.time_limit import in_time
from relay_server.video.multipart import CONTENT_TYPE, Multipart, part
from relay_server.video.parameters import parse_parameters
from relay_server.video.snapshot import Snapshot
from relay_server.video.viewer import CameraViewer, FrameSink
from relay_server.video.viewing import CONTENT_TYPES, RenderCache, replace_status

_PATH = "/robots/{robot}/video"
_TOPIC = Parameter("topic", "the camera", required=True)
_HOW = (
    query("width", "pixels; of one alone the other follows", Annotated[int, Meta(ge=-1, le=PICTURE_SIDE)]),
    query("height", "pixels", Annotated[int, Meta(ge=-1, le=PICTURE_SIDE)]),
    query("quality", "of JPEG; 80 where left out", Annotated[int, Meta(ge=0, le=100)]),
    query("fps", "most pictures per second; 0 is all there are", Annotated[float, Meta(ge=0, le=1000)]),
    query("crop", "`x,y,width,height` in pixels of the camera"),
    query("rotate", "degrees, clockwise", Literal["0", "90", "180", "270"]),
    query("invert", "turned by 180 degrees, with any value that does not say no"),
    query("stamp", "the time burned in", Literal["", "true", "1", "false", "0"]),
    query("type", "form of the pictures", Literal["mjpeg", "ros_compressed", "png"]),
    query("qos_profile", "of the subscription", Literal["", "default", "sensor_data", "system_default"]),
    query("default_transport", "which of a camera's topics", Literal["", "raw", "compressed"]),
)
_SHOWN = {
    "X-Timestamp": "Unix seconds at the robot",
    "X-Reduced": "how far it is below what was asked for, 0 to 1",
    "X-Instead": "in what another form differs that is shown, because the robot is at its limit",
}

_METHODS = (b"GET", b"HEAD")
_OWN_PAGES = (None, b"same-origin", b"none")
"""``Sec-Fetch-Site`` (W3C Fetch Metadata) of what is no browser's, of the relay's own pages, of the address bar."""

_VIEWER = """<!DOCTYPE html>
<html lang="en">
<head><meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title></head>
<body><img src="stream?{query}" alt="{title}"></body>
</html>
"""
"""web_video_server's page around a stream, which others' pages have links to."""


class VideoServicePort(Protocol):
    """What is asked for here; the front desk's."""

    async def ticket(self, ticket: str, asked: TicketPurpose, *, spend: bool) -> Principal:
        """The principal of a single-use ticket."""

    async def cameras(self, principal: Principal, robot: str) -> list[dict[str, Any]]:
        """The cameras the principal may view."""

    async def may_view(
        self, principal: Principal, robot: str, camera: str, transport: str, address: str
    ) -> None:
        """Whether it may view this one."""

    async def viewing(
        self,
        principal: Principal,
        robot: str,
        camera: str,
        settings: link.VideoSettings,
        screen: FrameSink,
        address: str,
        *,
        snapshot: bool = False,
    ) -> CameraViewer:
        """Begin to watch."""


class VideoResource(Resource):
    """All below ``/robots/<robot>/video``.

    :param principal: who a request is from, by access token or cookie
    :param websocket: what takes a request for ``…/video/ws`` over
    """

    isLeaf = True
    log = Logger()

    def __init__(
        self,
        clock: Clock,
        rounds: PeriodicTimers,
        desk: VideoServicePort,
        principal: Callable[[Request], Awaitable[Principal]],
        websocket: IResource,
    ) -> None:
        super().__init__()
        self._clock = clock
        self._rounds = rounds
        self._turns = FlushScheduler(clock)
        self._desk = desk
        self._principal_of = principal
        self._websocket = websocket
        self._parts = RenderCache(part)
        self._answers: dict[bytes, Callable[[Request, str], Awaitable[bytes | None]]] = {
            b"cameras": self._cameras,
            b"stream": self._stream,
            b"stream_viewer": self._stream_viewer,
            b"snapshot": self._snapshot,
        }

    def render(self, request: Request) -> Any:
        """By what follows ``/video``."""
        what = request.postpath[1] if len(request.postpath) == 2 else b""
        if what == b"ws":
            return self._to_websocket(request)
        answer = self._answers.get(what)
        if answer is None:
            return problem(request, 404, "There is nothing at this address.")
        if request.method not in _METHODS:
            request.setHeader(b"allow", b", ".join(_METHODS))
            return problem(request, 405, "This address does not take that method.")
        request.setHeader(b"cache-control", b"no-store")
        running = Deferred.fromCoroutine(self._finish(request, answer))
        # A client that leaves early ends the work.
        request.notifyFinish().addErrback(lambda _: running.cancel())
        running.addErrback(self._failed, request)
        return NOT_DONE_YET

    @described(
        ApiOperation(
            method="GET",
            path=f"{_PATH}/ws",
            tag="video",
            summary="A camera over a websocket",
            parameters=(_TOPIC, *_HOW, query("codec", "of the pictures", Literal["jpeg", "h264"])),
            answers={101: Response("a websocket (SPEC section 1.8)")},
            errors=(426,),
            credential=Credential.VIEWER,
            lasts="It is a websocket.",
        )
    )
    def _to_websocket(self, request: Request) -> Any:
        if wants_websocket(request):
            return self._websocket.render(request)
        request.setHeader(b"upgrade", b"websocket")
        return problem(request, 426, "This is the address of a websocket.")

    # --- answers ------------------------------------------------------------------------------------------

    @described(
        ApiOperation(
            method="GET",
            path=f"{_PATH}/cameras",
            tag="video",
            summary="The cameras the caller may view",
            answers={200: Response("cameras", CameraList)},
            credential=Credential.VIEWER,
        )
    )
    async def _cameras(self, request: Request, robot: str) -> bytes:
        principal = await self._principal(request, TicketPurpose(robot, video=True))
        cameras = await in_time(request, self._desk.cameras(principal, robot))
        request.setHeader(b"content-type", b"application/json")
        return jsontext.encode({"cameras": cameras})

    @described(
        ApiOperation(
            method="GET",
            path=f"{_PATH}/stream",
            tag="video",
            summary="A camera as pictures that follow each other",
            parameters=(_TOPIC, *_HOW),
            answers={200: Response("JPEG after JPEG", media=("multipart/x-mixed-replace",))},
            errors=(504,),
            credential=Credential.VIEWER,
            lasts="It goes on until the viewer leaves.",
        )
    )
    async def _stream(self, request: Request, robot: str) -> bytes | None:
        wanted = parse_parameters(_query(request), "stream")
        principal = await self._principal(request, TicketPurpose(robot, video=True, camera=wanted.camera))
        if request.method == b"HEAD":
            transport = wanted.settings.transport
            await in_time(
                request,
                self._desk.may_view(principal, robot, wanted.camera, transport, _address(request)),
            )
            request.setHeader(b"content-type", CONTENT_TYPE)
            return b""
        request.site.limits.answer_streams(request, principal.user_id)
        screen = Multipart(self._clock, self._rounds, self._turns, self._parts, request)
        # No proxy shall hold it back.
        request.setHeader(b"x-accel-buffering", b"no")
        # The first picture may take longer.
        watching = await in_time(
            request,
            self._desk.viewing(principal, robot, wanted.camera, wanted.settings, screen, _address(request)),
        )
        request.setHeader(b"content-type", CONTENT_TYPE)
        try:
            await screen.done
        finally:
            watching.leave()
            screen.gone()
        return None

    @described(
        ApiOperation(
            method="GET",
            path=f"{_PATH}/stream_viewer",
            tag="video",
            summary="A page with that in it",
            parameters=(_TOPIC, *_HOW),
            answers={200: Response("the page", media=("text/html",))},
            credential=Credential.NONE,
        )
    )
    async def _stream_viewer(self, request: Request, robot: str) -> bytes:
        """Nothing of the robot is in it: who may see the stream is asked when the page asks for that."""
        query = _query(request)
        camera = parse_parameters(query, "stream").camera
        request.setHeader(b"content-type", b"text/html; charset=utf-8")
        return _VIEWER.format(title=html.escape(f"{camera} of {robot}"), query=html.escape(query)).encode()

    @described(
        ApiOperation(
            method="GET",
            path=f"{_PATH}/snapshot",
            tag="video",
            summary="One picture",
            parameters=(_TOPIC, *_HOW),
            answers={200: Response("the picture", media=("image/jpeg", "image/png"), headers=_SHOWN)},
            errors=(504,),
            credential=Credential.VIEWER,
            lasts="It waits for a picture, 10 s or longer of a slow camera.",
        )
    )
    async def _snapshot(self, request: Request, robot: str) -> bytes:
        wanted = parse_parameters(_query(request), "snapshot")
        principal = await self._principal(request, TicketPurpose(robot, video=True, camera=wanted.camera))
        if request.method == b"HEAD":
            transport = wanted.settings.transport
            await in_time(
                request,
                self._desk.may_view(principal, robot, wanted.camera, transport, _address(request)),
            )
            request.setHeader(b"content-type", CONTENT_TYPES[wanted.settings.codec])
            return b""
        screen = Snapshot(self._clock.seconds)
        watching = await in_time(
            request,
            self._desk.viewing(
                principal, robot, wanted.camera, wanted.settings, screen, _address(request), snapshot=True
            ),
        )
        try:
            picture = await screen.done
        finally:
            watching.leave()
        request.setHeader(b"content-type", CONTENT_TYPES[picture.codec])
        request.setHeader(b"x-timestamp", b"%.6f" % picture.stamp)
        if picture.reduced > 0:
            request.setHeader(b"x-reduced", b"%.3f" % picture.reduced)
        replace_status(request, screen.other)
        return picture.body

    # --- who asks -----------------------------------------------------------------------------------------

    async def _principal(self, request: Request, opens: TicketPurpose) -> Principal:
        """Who sent this, by the credentials of SPEC section 1.1, in their order.

        :param opens: what a ticket would have to be for
        :raises BadCredentials: nobody that can be told
        :raises Refused: a cookie that another site's page has the browser send
        """
        if not (request.getHeader("authorization") or "").lower().startswith("bearer "):
            ticket = request.args.get(b"ticket")
            if ticket:
                request.site.limits.of_network(request)
                # Who asks for the head wants the rest as well.
                spend = request.method != b"HEAD"
                given = ticket[0].decode("ascii", "replace")
                principal = await in_time(request, self._desk.ticket(given, opens, spend=spend))
                # Whoever was given a ticket may be a page of another site, with an <img>.
                request.setHeader(b"cross-origin-resource-policy", b"cross-origin")
                return principal
            if request.getHeader(b"sec-fetch-site") not in _OWN_PAGES:
                raise Refused("pages of other sites may not use your session; they need a ticket")
        return await in_time(request, self._principal_of(request))

    # --- answering ----------------------------------------------------------------------------------------

    async def _finish(
        self, request: Request, answer: Callable[[Request, str], Awaitable[bytes | None]]
    ) -> None:
        try:
            body = await answer(request, request.prepath[-1].decode("utf-8", "replace"))
        except SwitchboardError as error:
            body = problem_of(request, error)
        if body is not None:
            self._send(request, body)

    def _failed(self, failure: Failure, request: Request) -> None:
        if failure.check(CancelledError):
            return
        self.log.failure("{method} {path} failed", failure, method=request.method, path=request.path)
        if request.startedWriting:
            request.transport.abortConnection()
        else:
            self._send(
                request, problem(request, 500, "The relay failed on this request; its log tells more.")
            )

    def _send(self, request: Request, body: bytes) -> None:
        if request.method != b"HEAD":
            request.setHeader(b"content-length", b"%d" % len(body))
        request.write(body)
        request.finish()


def _query(request: Request) -> str:
    return str(request.uri.partition(b"?")[2].decode("latin-1"))


def _address(request: Request) -> str:
    return str(getattr(request.getClientAddress(), "host", "local"))
