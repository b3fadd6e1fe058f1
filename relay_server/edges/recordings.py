"""``/api/v1/robots/<robot>/recordings``: what is recorded of a robot, and the files."""

from __future__ import annotations

from typing import Any, Protocol

from klein import Klein
from twisted.internet.defer import Deferred
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_protocol.limits import KIB
from relay_server.access import Principal
from relay_server.clock import Clock, cancel
from relay_server.edges.api import STREAMED, Api, body_of
from relay_server.edges.problems import problem
from relay_server.edges.ranges import Part, part_of
from relay_server.recording import Ask

PART_BYTES = 256 * KIB
"""Read from the disk at a time. No more of a file is in memory than this and what the transport holds."""

STALL_SECONDS = 30.0
"""Who takes nothing of a file for so long is cut."""


class File(Protocol):
    """A file on its way to somebody.

    :ivar tag: names this content, which never changes under it
    """

    name: str
    size: int
    tag: str

    async def begin(self) -> None:
        """It is about to be sent.

        :raises Unavailable: not now
        """

    def watch(self, denied: Any) -> None:
        """Call ``denied`` with the reason when it may not go on."""

    async def part(self, offset: int, size: int) -> bytes:
        """Some of its bytes."""

    def close(self) -> None:
        """It is on its way no more."""


class Desk(Protocol):
    """What is asked about recordings; see :class:`relay_server.recording.RecordingDesk`."""

    async def start(self, principal: Principal, robot: str, ask: Ask, address: str) -> dict[str, Any]:
        """Begin one."""

    async def possible(self, principal: Principal, robot: str, address: str) -> dict[str, Any]:
        """What could be recorded now."""

    async def all(self, principal: Principal, robot: str, address: str) -> list[dict[str, Any]]:
        """Those the principal may have."""

    async def one(self, principal: Principal, robot: str, id: str, address: str) -> dict[str, Any]:
        """One of them."""

    async def stop(self, principal: Principal, robot: str, id: str, address: str) -> dict[str, Any]:
        """Finish one."""

    async def delete(self, principal: Principal, robot: str, id: str, address: str) -> None:
        """Delete one."""

    async def download(self, principal: Principal, robot: str, id: str, address: str) -> File:
        """The file of one."""


class RobotRecordings:
    """The recordings of one robot, for one request."""

    app = Klein()

    def __init__(self, clock: Clock, desk: Desk, api: Api, robot: str) -> None:
        self._clock = clock
        self._desk = desk
        self._api = api
        self._robot = robot

    @app.route("/", methods=["GET"])
    def list(self, request: Request) -> Any:
        return self._api.answer(request, self._list(request))

    async def _list(self, request: Request) -> Any:
        return {"recordings": await self._desk.all(*await self._asked(request))}

    @app.route("/", methods=["POST"])
    def start(self, request: Request) -> Any:
        return self._api.answer(request, self._start(request))

    async def _start(self, request: Request) -> Any:
        principal, robot, address = await self._asked(request)
        begun = await self._desk.start(principal, robot, body_of(request, Ask), address)
        request.setResponseCode(201)
        request.setHeader(b"location", f"/api/v1/robots/{robot}/recordings/{begun['id']}".encode())
        return begun

    @app.route("/new", methods=["GET"])
    def possible(self, request: Request) -> Any:
        return self._api.answer(request, self._possible(request))

    async def _possible(self, request: Request) -> Any:
        return await self._desk.possible(*await self._asked(request))

    @app.route("/<id>", methods=["GET"])
    def one(self, request: Request, id: str) -> Any:
        return self._api.answer(request, self._one(request, id))

    async def _one(self, request: Request, id: str) -> Any:
        principal, robot, address = await self._asked(request)
        return await self._desk.one(principal, robot, id, address)

    @app.route("/<id>", methods=["DELETE"])
    def delete(self, request: Request, id: str) -> Any:
        return self._api.answer(request, self._delete(request, id))

    async def _delete(self, request: Request, id: str) -> Any:
        principal, robot, address = await self._asked(request)
        await self._desk.delete(principal, robot, id, address)

    @app.route("/<id>/stop", methods=["POST"])
    def stop(self, request: Request, id: str) -> Any:
        return self._api.answer(request, self._stop(request, id))

    async def _stop(self, request: Request, id: str) -> Any:
        principal, robot, address = await self._asked(request)
        return await self._desk.stop(principal, robot, id, address)

    @app.route("/<id>/file", methods=["GET"])
    def file(self, request: Request, id: str) -> Any:
        return self._api.answer(request, self._file(request, id))

    async def _file(self, request: Request, id: str) -> Any:
        principal, robot, address = await self._asked(request)
        file = await self._desk.download(principal, robot, id, address)
        try:
            tag = f'"{file.tag}"'
            part = part_of(request, file.size, tag)
            if part is None:
                request.setHeader(b"content-range", f"bytes */{file.size}".encode())
                request.write(problem(request, 416, f"The file has {file.size} bytes."))
                return STREAMED
            if request.method == b"GET":
                await file.begin()
            self._head(request, file, tag, part)
            if request.method == b"GET":
                await _Sending(self._clock, request, file, part).run()
        finally:
            file.close()
        return STREAMED

    @staticmethod
    def _head(request: Request, file: File, tag: str, part: Part) -> None:
        if part.ranged:
            request.setResponseCode(206)
            request.setHeader(b"content-range", part.content_range(file.size).encode())
        request.setHeader(b"accept-ranges", b"bytes")
        request.setHeader(b"etag", tag.encode())
        request.setHeader(b"content-type", b"application/octet-stream")
        request.setHeader(b"content-length", str(part.stop - part.start).encode())
        request.setHeader(b"content-disposition", f'attachment; filename="{file.name}"'.encode())

    async def _asked(self, request: Request) -> tuple[Principal, str, str]:
        """Who asks, about which robot, from where."""
        principal = await self._api.principal(request)
        return principal, self._robot, getattr(request.getClientAddress(), "host", "local")

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


class _Sending:
    """A file on its way out, no faster than it is taken: Twisted's push producer."""

    def __init__(self, clock: Clock, request: Request, file: File, part: Part) -> None:
        self._clock = clock
        self._request = request
        self._file = file
        self._part = part
        self._paused = False
        self._wake: Deferred[None] | None = None

    async def run(self) -> None:
        """Until it is sent, the client leaves or takes nothing any more, or it may not go on."""
        request, file = self._request, self._file
        file.watch(lambda reason: self._cut())
        request.registerProducer(self, True)
        try:
            offset, stop = self._part.start, self._part.stop
            while offset < stop and not request._disconnected:
                if self._paused:
                    await self._room()
                    continue
                try:
                    part = await file.part(offset, min(PART_BYTES, stop - offset))
                except OSError:
                    part = b""
                if not part:
                    # What was promised can't be sent: the client must see that it has not got all.
                    self._cut()
                    return
                offset += len(part)
                if not request._disconnected:
                    request.write(part)
        finally:
            request.unregisterProducer()

    def pauseProducing(self) -> None:
        """The transport's buffer is full."""
        self._paused = True

    def resumeProducing(self) -> None:
        """The transport takes bytes again."""
        self._paused = False
        wake, self._wake = self._wake, None
        if wake is not None:
            wake.callback(None)

    def stopProducing(self) -> None:
        """The client has left; the request's own end follows."""

    async def _room(self) -> None:
        wake = self._wake = Deferred()
        timer = self._clock.callLater(STALL_SECONDS, self._cut)
        try:
            await wake
        finally:
            cancel(timer)

    def _cut(self) -> None:
        if not self._request._disconnected:
            self._request.transport.abortConnection()


def below(clock: Clock, desk: Desk, api: Api, robot: str) -> IResource:
    """What serves the addresses below a robot's ``recordings``."""
    resource: IResource = RobotRecordings(clock, desk, api, robot).app.resource()
    return resource
