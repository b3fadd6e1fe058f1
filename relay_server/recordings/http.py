"""``/api/v1/robots/<robot>/recordings``: what is recorded of a robot, and the files."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, NamedTuple, Protocol

from klein import Klein
from msgspec import Meta
from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import Logger
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException
from werkzeug.http import parse_range_header

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, Unavailable
from relay_protocol.limits import KIB
from relay_server.access import Principal
from relay_server.common.clock import Clock, cancel
from relay_server.http.api import STREAMED, Api, body_of
from relay_server.http.conditional import answers, told_facts
from relay_server.http.idempotency import Idempotency, StoredReply
from relay_server.http.idempotent_requests import KEYED, once, send
from relay_server.http.openapi.operation import ApiOperation, Response, described, header, query
from relay_server.http.openapi.schemas import Recordable, RecordingInfo, RecordingPage
from relay_server.http.problems import problem
from relay_server.http.request_params import KNOWN
from relay_server.recordings.recordings import RecordingRequest
from relay_server.recordings.service import PAGE, PAGE_MOST


class ByteRange(NamedTuple):
    """Bytes from ``start`` up to before ``stop``.

    :param ranged: whether the request named them
    """

    start: int
    stop: int
    ranged: bool

    def content_range(self, size: int) -> str:
        """The ``Content-Range`` of an answer with this part, of a file of so many bytes."""
        return f"bytes {self.start}-{self.stop - 1}/{size}"


def range_of(request: Request, size: int, tag: str) -> ByteRange | None:
    """What a request wants of a file: all, or the one range it names; ``None`` when the file has nothing there.

    A ``Range`` that is not understood or names several ranges is passed over, as section 14.2 allows.

    :param size: of the file, bytes
    :param tag: the file's strong ``ETag``, with its quotes
    """
    whole = ByteRange(0, size, False)
    if request.method != b"GET" or request.getHeader("if-range") not in (None, tag):
        return whole
    asked = parse_range_header(request.getHeader("range"))
    if asked is None or asked.units != "bytes" or len(asked.ranges) != 1:
        return whole
    start, stop = asked.ranges[0]
    if start < 0:
        # So many bytes from the end; all of a file that has less.
        start = max(0, size + start)
    return ByteRange(start, min(size, size if stop is None else stop), True) if start < size else None


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


class RecordingServicePort(Protocol):
    """What is asked about recordings; see :class:`relay_server.recordings.service.RecordingService`."""

    async def start(
        self, principal: Principal, robot: str, ask: RecordingRequest, address: str
    ) -> dict[str, Any]:
        """Begin one."""

    async def may_start(self, principal: Principal, robot: str, ask: RecordingRequest, address: str) -> None:
        """See that it could be begun, as far as rights go."""

    async def possible(self, principal: Principal, robot: str, address: str) -> dict[str, Any]:
        """What could be recorded now."""

    async def all(
        self, principal: Principal, robot: str, address: str, limit: int, before: str
    ) -> dict[str, Any]:
        """Those the principal may have, a page of them."""

    async def one(self, principal: Principal, robot: str, id: str, address: str) -> dict[str, Any]:
        """One of them."""

    async def stop(self, principal: Principal, robot: str, id: str, address: str) -> dict[str, Any]:
        """Finish one."""

    async def delete(self, principal: Principal, robot: str, id: str, address: str) -> None:
        """Delete one."""

    async def download(self, principal: Principal, robot: str, id: str, address: str) -> File:
        """The file of one."""


PATH = "/api/v1/robots/{robot}/recordings"
FILE = "application/octet-stream"
_TAG = {"ETag": "names this content"}


class RecordingResource:
    """The recordings of one robot, for one request."""

    app = Klein()

    def __init__(
        self, clock: Clock, desk: RecordingServicePort, keys: Idempotency, api: Api, robot: str
    ) -> None:
        self._clock = clock
        self._desk = desk
        self._keys = keys
        self._api = api
        self._robot = robot

    @app.route("/", methods=["GET"])
    @described(
        ApiOperation(
            method="GET",
            path=PATH,
            tag="recordings",
            summary="Recordings of a robot, the latest first",
            parameters=(
                query(
                    "limit",
                    f"most of an answer; {PAGE} where left out",
                    Annotated[int, Meta(ge=1, le=PAGE_MOST)],
                ),
                query("before", "`next` of an earlier answer: what comes behind that"),
                KNOWN,
            ),
            answers=answers("recordings", RecordingPage),
        )
    )
    def list(self, request: Request) -> Any:
        return self._api.answer(request, self._list(request))

    async def _list(self, request: Request) -> Any:
        asked = await self._asked(request)
        limit, before = _argument(request, b"limit"), _argument(request, b"before")
        if limit and not (
            limit.isascii() and limit.isdecimal() and len(limit) <= 9 and 1 <= int(limit) <= PAGE_MOST
        ):
            raise Invalid(f"'limit' is a number from 1 to {PAGE_MOST}")
        return told_facts(request, await self._desk.all(*asked, int(limit or PAGE), before))

    @app.route("/", methods=["POST"])
    @described(
        ApiOperation(
            method="POST",
            path=PATH,
            tag="recordings",
            summary="Begin a recording",
            parameters=(KEYED,),
            body=RecordingRequest,
            answers={201: Response("the recording", RecordingInfo, headers={"Location": "its address"})},
            errors=(422,),
        )
    )
    def start(self, request: Request) -> Any:
        return self._api.answer(request, self._start(request))

    async def _start(self, request: Request) -> Any:
        principal, robot, address = await self._asked(request)
        asked = principal, robot, body_of(request, RecordingRequest), address

        async def work() -> StoredReply:
            begun = await self._desk.start(*asked)
            where = f"/api/v1/robots/{robot}/recordings/{begun['id']}"
            return StoredReply(201, jsontext.encode(begun), where)

        may = partial(self._desk.may_start, *asked)
        return send(request, await once(self._keys, request, principal, robot, work, may))

    @app.route("/new", methods=["GET"])
    @described(
        ApiOperation(
            method="GET",
            path=f"{PATH}/new",
            tag="recordings",
            summary="What could be recorded now",
            answers={200: Response("topics and cameras", Recordable)},
        )
    )
    def possible(self, request: Request) -> Any:
        return self._api.answer(request, self._possible(request))

    async def _possible(self, request: Request) -> Any:
        return await self._desk.possible(*await self._asked(request))

    @app.route("/<id>", methods=["GET"])
    @described(
        ApiOperation(
            method="GET",
            path=f"{PATH}/{{id}}",
            tag="recordings",
            summary="One recording",
            answers={200: Response("the recording", RecordingInfo)},
        )
    )
    def one(self, request: Request, id: str) -> Any:
        return self._api.answer(request, self._one(request, id))

    async def _one(self, request: Request, id: str) -> Any:
        principal, robot, address = await self._asked(request)
        return await self._desk.one(principal, robot, id, address)

    @app.route("/<id>", methods=["DELETE"])
    @described(
        ApiOperation(
            method="DELETE",
            path=f"{PATH}/{{id}}",
            tag="recordings",
            summary="Delete a recording",
            more="For who began it, and for owners.",
            answers={204: Response("deleted")},
        )
    )
    def delete(self, request: Request, id: str) -> Any:
        return self._api.answer(request, self._delete(request, id))

    async def _delete(self, request: Request, id: str) -> Any:
        principal, robot, address = await self._asked(request)
        await self._desk.delete(principal, robot, id, address)

    @app.route("/<id>/stop", methods=["POST"])
    @described(
        ApiOperation(
            method="POST",
            path=f"{PATH}/{{id}}/stop",
            tag="recordings",
            summary="Finish a recording",
            more="For who began it, and for owners.",
            answers={200: Response("the recording", RecordingInfo)},
        )
    )
    def stop(self, request: Request, id: str) -> Any:
        return self._api.answer(request, self._stop(request, id))

    async def _stop(self, request: Request, id: str) -> Any:
        principal, robot, address = await self._asked(request, stops=True)
        return await self._desk.stop(principal, robot, id, address)

    @app.route("/<id>/file", methods=["GET"])
    @described(
        ApiOperation(
            method="GET",
            path=f"{PATH}/{{id}}/file",
            tag="recordings",
            summary="The file of a recording (MCAP)",
            parameters=(
                header("Range", "one part of it, in bytes"),
                header("If-Range", "the `ETag` it should have"),
            ),
            answers={
                200: Response("the file", media=(FILE,), headers=_TAG),
                206: Response("a part of it", media=(FILE,), headers=_TAG),
            },
            errors=(416,),
            lasts="It may be as large as a disk, and comes as fast as it is taken.",
        )
    )
    def file(self, request: Request, id: str) -> Any:
        return self._api.answer(request, self._file(request, id))

    async def _file(self, request: Request, id: str) -> Any:
        principal, robot, address = await self._asked(request)
        file = await self._desk.download(principal, robot, id, address)
        try:
            tag = f'"{file.tag}"'
            part = range_of(request, file.size, tag)
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
    def _head(request: Request, file: File, tag: str, part: ByteRange) -> None:
        if part.ranged:
            request.setResponseCode(206)
            request.setHeader(b"content-range", part.content_range(file.size).encode())
        request.setHeader(b"accept-ranges", b"bytes")
        request.setHeader(b"etag", tag.encode())
        request.setHeader(b"content-type", FILE.encode())
        request.setHeader(b"content-length", str(part.stop - part.start).encode())
        request.setHeader(b"content-disposition", f'attachment; filename="{file.name}"'.encode())

    async def _asked(self, request: Request, *, stops: bool = False) -> tuple[Principal, str, str]:
        """Who asks, about which robot, from where."""
        principal = await self._api.principal(request, passes=stops)
        return principal, self._robot, getattr(request.getClientAddress(), "host", "local")

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


class _Sending:
    """A file on its way out, no faster than it is taken: Twisted's push producer.

    What was promised and can't be sent ends the connection: a client must see that it has not got all, and nothing
    else may stand where the file should go on.
    """

    log = Logger()

    def __init__(self, clock: Clock, request: Request, file: File, part: ByteRange) -> None:
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
            await self._send()
        except (OSError, Unavailable):
            self._cut()
        except CancelledError:
            # The client has left.
            raise
        except Exception:
            self.log.failure("sending {name} failed", name=file.name)
            self._cut()
        finally:
            request.unregisterProducer()

    async def _send(self) -> None:
        """Send all.

        :raises OSError: it can't be read
        :raises Unavailable: too much is read at once
        """
        request = self._request
        offset, stop = self._part.start, self._part.stop
        while offset < stop and not request._disconnected:
            if self._paused:
                await self._room()
                continue
            part = await self._file.part(offset, min(PART_BYTES, stop - offset))
            if not part:
                self._cut()
                return
            offset += len(part)
            if not request._disconnected:
                request.write(part)

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


def _argument(request: Request, name: bytes) -> str:
    values = request.args.get(name, [b""])
    return str(values[0].decode("utf-8", "replace"))


def below(clock: Clock, desk: RecordingServicePort, keys: Idempotency, api: Api, robot: str) -> IResource:
    """What serves the addresses below a robot's ``recordings``.

    :param keys: requests that were sent with a key
    """
    resource: IResource = RecordingResource(clock, desk, keys, api, robot).app.resource()
    return resource
