"""``/robots/<robot>/video/…`` over HTTP: cameras, MJPEG streams, snapshots, and the upgrade to a websocket.

A session cookie needs no Origin here, because an ``<img>`` sends none. Pages of other sites are refused instead, unless
they send an Origin that is listed.
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
from relay_protocol.limits import IMAGE_SIDE
from relay_server.access import Principal
from relay_server.auth.authenticator import TicketPurpose
from relay_server.cluster.forwarding import FORWARDED_SECONDS, ForwardedClient, RequestForwarding
from relay_server.common.clock import Clock, PeriodicTimers
from relay_server.common.socket_writer import FlushScheduler
from relay_server.http.limits import extend_time_limit, in_time
from relay_server.http.openapi.operation import (
    ApiOperation,
    Credential,
    Parameter,
    Response,
    described,
    query,
)
from relay_server.http.problems import problem, problem_of
from relay_server.http.site import wants_websocket
from relay_server.video.frames import CONTENT_TYPES, RenderCache, replace_status
from relay_server.video.multipart import CONTENT_TYPE, Multipart, part
from relay_server.video.parameters import CameraList, parse_parameters
from relay_server.video.viewer import CameraViewer, FrameSink, Snapshot

_PATH = "/robots/{robot}/video"
_TOPIC = Parameter("topic", "the camera", required=True)
_HOW = (
    query("width", "pixels; the height follows if omitted", Annotated[int, Meta(ge=-1, le=IMAGE_SIDE)]),
    query("height", "pixels; the width follows if omitted", Annotated[int, Meta(ge=-1, le=IMAGE_SIDE)]),
    query("quality", "of JPEG; 80 by default", Annotated[int, Meta(ge=0, le=100)]),
    query("fps", "most frames per second; 0 is no limit", Annotated[float, Meta(ge=0, le=1000)]),
    query("crop", "`x,y,width,height` in pixels of the camera"),
    query("rotate", "degrees, clockwise", Literal["0", "90", "180", "270"]),
    query("invert", "turn by 180 degrees, with any value except `false`, `no`, `off` and `0`"),
    query("stamp", "draw the time into the image", Literal["", "true", "1", "false", "0"]),
    query("type", "encoding of the frames", Literal["mjpeg", "ros_compressed", "png"]),
    query(
        "qos_profile",
        "quality of service of the subscription",
        Literal["", "default", "sensor_data", "system_default"],
    ),
    query("default_transport", "the camera's topic to be used", Literal["", "raw", "compressed"]),
)
_SHOWN = {
    "X-Timestamp": "Unix seconds at the robot",
    "X-Reduced": "how far the frame is below the requested quality, 0 to 1",
    "X-Instead": "parameters that differ from the requested ones, because the robot is at its limit",
}

_METHODS = (b"GET", b"HEAD")
_OWN_PAGES = (None, b"same-origin", b"none")
"""``Sec-Fetch-Site`` (W3C Fetch Metadata): not a browser, the relay's own pages, the address bar."""

_VIEWER = """<!DOCTYPE html>
<html lang="en">
<head><meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title></head>
<body>{content}</body>
</html>
"""
"""The page around a stream, as web_video_server has it."""

_STREAM = """<img alt="{title}"><p></p><script src="/stream_viewer.js"></script>
<noscript><img src="stream?{query}" alt="{title}"></noscript>"""
"""The script holds none of the browser's six HTTP/1.1 connections for JPEG, and for PNG only while it is seen."""


class TicketChecker(Protocol):
    """Redeems tickets; see :class:`relay_server.auth.service.AuthService`."""

    async def ticket(self, ticket: str, purpose: TicketPurpose, *, spend: bool) -> Principal:
        """The principal of a single-use ticket."""


class VideoServicePort(Protocol):
    """Cameras for a principal; see :class:`relay_server.sessions.manager.SessionManager`."""

    async def cameras(self, principal: Principal, robot: str) -> list[dict[str, Any]]:
        """The cameras that the principal may view."""

    async def may_view(
        self, principal: Principal, robot: str, camera: str, transport: str, address: str
    ) -> None:
        """Check that the principal may view a camera."""

    async def view(
        self,
        principal: Principal,
        robot: str,
        camera: str,
        settings: link.VideoSettings,
        sink: FrameSink,
        address: str,
        *,
        snapshot: bool = False,
    ) -> CameraViewer:
        """Begin to watch a camera."""


class VideoResource(Resource):
    """All addresses below ``/robots/<robot>/video``.

    :param principal: the sender of a request, by access token or cookie
    :param websocket: the resource ``…/video/ws``
    :param forwarding: ``None``: this is the only relay
    """

    isLeaf = True
    log = Logger()

    def __init__(
        self,
        clock: Clock,
        rounds: PeriodicTimers,
        tickets: TicketChecker,
        service: VideoServicePort,
        principal: Callable[[Request], Awaitable[Principal]],
        websocket: IResource,
        forwarding: RequestForwarding | None = None,
    ) -> None:
        super().__init__()
        self._clock = clock
        self._rounds = rounds
        self._flushes = FlushScheduler(clock)
        self._tickets = tickets
        self._service = service
        self._principal_of = principal
        self._websocket = websocket
        self._forwarding = forwarding
        self._parts = RenderCache(part)
        self._answers: dict[bytes, Callable[[Request, str], Awaitable[bytes | None]]] = {
            b"cameras": self._cameras,
            b"stream": self._stream,
            b"stream_viewer": self._stream_viewer,
            b"snapshot": self._snapshot,
        }

    def render(self, request: Request) -> Any:
        """Find the handler by the segment after ``/video``."""
        segment = request.postpath[1] if len(request.postpath) == 2 else b""
        if segment == b"ws":
            return self._to_websocket(request)
        answer = self._answers.get(segment)
        if answer is None:
            return problem(request, 404, "There is nothing at this address.")
        if request.method not in _METHODS:
            request.setHeader(b"allow", b", ".join(_METHODS))
            return problem(request, 405, "This address does not support that method; see 'Allow'.")
        request.setHeader(b"cache-control", b"no-store")
        running = Deferred.fromCoroutine(self._finish(request, answer))
        # A client that disconnects cancels the work.
        request.notifyFinish().addErrback(lambda _: running.cancel())
        running.addErrback(self._failed, request)
        return NOT_DONE_YET

    @described(
        ApiOperation(
            method="GET",
            path=f"{_PATH}/ws",
            tag="video",
            summary="A camera over a websocket",
            parameters=(_TOPIC, *_HOW, query("codec", "encoding of the frames", Literal["jpeg", "h264"])),
            answers={101: Response("a websocket (SPEC 1.8)")},
            errors=(426,),
            credential=Credential.VIEWER,
            lasts="The answer is a websocket.",
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
            summary="Cameras that the caller may view",
            answers={200: Response("cameras", CameraList)},
            credential=Credential.VIEWER,
        )
    )
    async def _cameras(self, request: Request, robot: str) -> bytes | None:
        principal = await self._principal(request, TicketPurpose(robot, video=True))
        if await self._forwarded(request, principal, robot):
            return None
        cameras = await in_time(request, self._service.cameras(principal, robot))
        request.setHeader(b"content-type", b"application/json")
        return jsontext.encode({"cameras": cameras})

    @described(
        ApiOperation(
            method="GET",
            path=f"{_PATH}/stream",
            tag="video",
            summary="A camera as a stream of JPEG images (MJPEG)",
            parameters=(_TOPIC, *_HOW),
            answers={200: Response("one part for each image", media=("multipart/x-mixed-replace",))},
            errors=(504,),
            credential=Credential.VIEWER,
            lasts="The stream continues until the viewer disconnects.",
        )
    )
    async def _stream(self, request: Request, robot: str) -> bytes | None:
        wanted = parse_parameters(_query(request), "stream")
        principal = await self._principal(request, TicketPurpose(robot, video=True, camera=wanted.camera))
        if request.method != b"HEAD":
            request.site.limits.answer_streams(request, principal.user_id)
        if await self._forwarded(request, principal, robot):
            return None
        if request.method == b"HEAD":
            transport = wanted.settings.transport
            await in_time(
                request,
                self._service.may_view(principal, robot, wanted.camera, transport, _address(request)),
            )
            request.setHeader(b"content-type", CONTENT_TYPE)
            return b""
        sink = Multipart(self._clock, self._rounds, self._flushes, self._parts, request)
        # Keeps nginx from buffering the stream.
        request.setHeader(b"x-accel-buffering", b"no")
        # The time limit is for the opening; the first frame may take longer.
        viewer = await in_time(
            request,
            self._service.view(principal, robot, wanted.camera, wanted.settings, sink, _address(request)),
        )
        request.setHeader(b"content-type", CONTENT_TYPE)
        try:
            await sink.done
        finally:
            viewer.leave()
            sink.disconnected()
        return None

    @described(
        ApiOperation(
            method="GET",
            path=f"{_PATH}/stream_viewer",
            tag="video",
            summary="A page that shows a stream",
            parameters=(_TOPIC, *_HOW),
            answers={200: Response("the page", media=("text/html",))},
            credential=Credential.NONE,
        )
    )
    async def _stream_viewer(self, request: Request, robot: str) -> bytes:
        """The page contains nothing of the robot, so it needs no credentials. The stream in it does.

        Pages of listed origins may show it in a frame. The session cookie does not count there, so they give a ticket.
        """
        query = _query(request)
        wanted = parse_parameters(query, "stream")
        title = html.escape(f"{wanted.camera} of {robot}")
        request.setHeader(b"content-type", b"text/html; charset=utf-8")
        if request.site.cross_origin is not None:
            request.site.cross_origin.allow_frames(request)
        return _VIEWER.format(
            title=title, content=_STREAM.format(title=title, query=html.escape(query))
        ).encode()

    @described(
        ApiOperation(
            method="GET",
            path=f"{_PATH}/snapshot",
            tag="video",
            summary="A single image of a camera",
            parameters=(_TOPIC, *_HOW),
            answers={200: Response("the image", media=("image/jpeg", "image/png"), headers=_SHOWN)},
            errors=(504,),
            credential=Credential.VIEWER,
            lasts="It waits for a frame for 10 s, or longer if the camera is slow.",
        )
    )
    async def _snapshot(self, request: Request, robot: str) -> bytes | None:
        wanted = parse_parameters(_query(request), "snapshot")
        principal = await self._principal(request, TicketPurpose(robot, video=True, camera=wanted.camera))
        if await self._forwarded(request, principal, robot):
            return None
        if request.method == b"HEAD":
            transport = wanted.settings.transport
            await in_time(
                request,
                self._service.may_view(principal, robot, wanted.camera, transport, _address(request)),
            )
            request.setHeader(b"content-type", CONTENT_TYPES[wanted.settings.codec])
            return b""
        sink = Snapshot(self._clock.seconds)
        viewer = await in_time(
            request,
            self._service.view(
                principal, robot, wanted.camera, wanted.settings, sink, _address(request), snapshot=True
            ),
        )
        try:
            picture = await sink.done
        finally:
            viewer.leave()
        request.setHeader(b"content-type", CONTENT_TYPES[picture.codec])
        request.setHeader(b"x-timestamp", b"%.6f" % picture.stamp)
        if picture.reduced > 0:
            request.setHeader(b"x-reduced", b"%.3f" % picture.reduced)
        replace_status(request, sink.other)
        return picture.body

    # --- authentication -----------------------------------------------------------------------------------

    async def _principal(self, request: Request, opens: TicketPurpose) -> Principal:
        """The sender, by the credentials of SPEC 1.1 in their order.

        :param opens: the purpose that a ticket must have
        :raises BadCredentials: no valid credentials
        :raises Refused: a cookie that the browser sent for a page of another site
        """
        if request.forwarded_client is not None:
            # Another relay has checked the credentials.
            return await in_time(request, self._principal_of(request))
        if not (request.getHeader("authorization") or "").lower().startswith("bearer "):
            ticket = request.args.get(b"ticket")
            if ticket:
                request.site.limits.of_network(request)
                # A client that asks for the head will send the ticket again with a GET.
                spend = request.method != b"HEAD"
                given = ticket[0].decode("ascii", "replace")
                principal = await in_time(request, self._tickets.ticket(given, opens, spend=spend))
                # Pages of other sites may use a ticket, in an <img>.
                request.setHeader(b"cross-origin-resource-policy", b"cross-origin")
                return principal
            own = request.from_listed_page or request.getHeader(b"sec-fetch-site") in _OWN_PAGES
            if not own:
                raise Refused("pages of other sites may not use your session: request a ticket for them")
        return await in_time(request, self._principal_of(request))

    async def _forwarded(self, request: Request, principal: Principal, robot: str) -> bool:
        """Have a request answered by the relay that its robot is at.

        :returns: false: the robot is here
        :raises Unavailable: that relay can't be reached
        """
        forwarding = self._forwarding
        if forwarding is None or request.forwarded_client is not None:
            return False
        relay = await in_time(request, forwarding.relay_of(principal, robot, from_memory=False))
        if relay is None:
            return False
        extend_time_limit(request, FORWARDED_SECONDS)
        client = ForwardedClient.of(principal, _address(request))
        await in_time(request, forwarding.forwarder.forward(request, b"", relay, client, None))
        if not request._disconnected:
            request.finish()
        return True

    # --- answering ----------------------------------------------------------------------------------------

    async def _finish(
        self, request: Request, answer: Callable[[Request, str], Awaitable[bytes | None]]
    ) -> None:
        try:
            body = await answer(request, request.prepath[-1].decode("utf-8", "replace"))
        except SwitchboardError as error:
            if request.startedWriting:
                # A truncated answer must not look complete.
                request.transport.abortConnection()
                return
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
            self._send(request, problem(request, 500, "The relay failed on this request; see its log."))

    def _send(self, request: Request, body: bytes) -> None:
        if request.method != b"HEAD":
            request.setHeader(b"content-length", b"%d" % len(body))
        request.write(body)
        request.finish()


def _query(request: Request) -> str:
    return str(request.uri.partition(b"?")[2].decode("latin-1"))


def _address(request: Request) -> str:
    return str(getattr(request.getClientAddress(), "host", "local"))
