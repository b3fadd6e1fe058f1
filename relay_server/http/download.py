"""Downloads of files by name: ranges, and bytes as fast as the client reads (RFC 9110 section 14)."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import NamedTuple, Protocol
from urllib.parse import quote

from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import Logger
from twisted.web.server import Request
from werkzeug.http import parse_range_header

from relay_protocol.errors import Invalid, Unavailable
from relay_protocol.limits import KIB
from relay_server.access import Permit
from relay_server.common.clock import Clock, cancel
from relay_server.http.endpoint import ApiRequest, Streamed
from relay_server.http.media_types import MediaType
from relay_server.http.openapi.operation import header

FILE = MediaType("application/octet-stream")

PARAMETERS = (
    header("Range", "one range of bytes"),
    header("If-Range", "the `ETag` that the file must have"),
)
"""Headers of the request that :func:`download` reads."""


class ByteRange(NamedTuple):
    """Bytes from ``start`` to before ``stop``.

    :param ranged: whether the request asked for a range
    """

    start: int
    stop: int
    ranged: bool

    def content_range(self, size: int) -> str:
        """The ``Content-Range`` of this part of a file with ``size`` bytes."""
        return f"bytes {self.start}-{self.stop - 1}/{size}"


class RangeNotSatisfiable(Invalid):
    """The file has no bytes in the requested range."""

    code = "range_not_satisfiable"
    http_status = 416


def range_of(request: Request, size: int, tag: str) -> ByteRange | None:
    """The part of a file that a request asks for; ``None`` if the file has no bytes there.

    A ``Range`` that is not valid or names several ranges is ignored, as RFC 9110 section 14.2 allows.

    :param size: bytes of the file
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
        # The last bytes of the file, or all of a shorter file.
        start = max(0, size + start)
    return ByteRange(start, min(size, size if stop is None else stop), True) if start < size else None


PART_BYTES = 256 * KIB
"""Bytes read from the disk at a time. Only these, and the transport's buffer, are in memory."""

STALL_SECONDS = 30.0
"""Seconds without any byte accepted after which a client is cut."""


class File(Protocol):
    """A file that is being downloaded.

    :ivar tag: entity tag; the content never changes
    :ivar permit: with a change of it, :meth:`allowed` is asked again
    :ivar begin: writes the audit entry, before the file is sent; raises :class:`Unavailable` if it can't
    """

    name: str
    size: int
    tag: str
    permit: Permit
    begin: Callable[[], Awaitable[None]]

    def allowed(self) -> bool:
        """Whether the download may go on."""

    async def part(self, offset: int, size: int) -> bytes:
        """Some bytes of the file."""

    def close(self) -> None:
        """End the download."""


async def download(clock: Clock, request: ApiRequest, file: File) -> Streamed:
    """The answer with a file, or with the part of it that was asked for. The file is closed in any case.

    :raises RangeNotSatisfiable: the file has no bytes there
    :raises Unavailable: the audit entry can't be written
    """
    try:
        part = range_of(request.http, file.size, f'"{file.tag}"')
        if part is None:
            request.http.setHeader("content-range", f"bytes */{file.size}")
            raise RangeNotSatisfiable(f"the file has {file.size} bytes")
        if request.http.method == b"GET":
            await file.begin()
    except BaseException:
        file.close()
        raise

    async def run(http: Request) -> None:
        await _Download(clock, http, file, part).run()

    status = 206 if part.ranged else 200
    headers = _head(file, part)
    return Streamed(FILE.media, run, counted=False, status=status, headers=headers, close=file.close)


def _head(file: File, part: ByteRange) -> dict[str, str]:
    """Headers of an answer with a part of a file."""
    headers = {
        "accept-ranges": "bytes",
        "etag": f'"{file.tag}"',
        "content-length": str(part.stop - part.start),
        "content-disposition": _disposition(file.name),
    }
    return headers | ({"content-range": part.content_range(file.size)} if part.ranged else {})


def _disposition(name: str) -> str:
    """``Content-Disposition`` for a file of any name (RFC 6266 section 4.1)."""
    plain = "".join(each if 32 <= ord(each) < 127 and each not in '"\\%' else "_" for each in name)
    value = f'attachment; filename="{plain}"'
    return value if plain == name else f"{value}; filename*=UTF-8''{quote(name, safe='')}"


class _Download:
    """Sends a file as fast as the client reads: Twisted's push producer.

    If a part cannot be sent, the connection is aborted, so that the client sees that the file is incomplete.
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
        """Send until the end, or until the client disconnects, accepts nothing more, or loses the right."""
        request, file = self._request, self._file
        file.permit.on_revoke = lambda error: self._cut()
        file.permit.on_change = self._check
        self._check()
        request.registerProducer(self, True)
        try:
            await self._send()
        except (OSError, Unavailable):
            self._cut()
        except CancelledError:
            # The client has disconnected.
            raise
        except Exception:
            self.log.failure("sending {name} failed", name=file.name)
            self._cut()
        finally:
            request.unregisterProducer()

    async def _send(self) -> None:
        """Send all parts.

        :raises OSError: the file cannot be read
        :raises Unavailable: too many parts of files are being read
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
        """The transport accepts bytes again."""
        self._paused = False
        wake, self._wake = self._wake, None
        if wake is not None:
            wake.callback(None)

    def stopProducing(self) -> None:
        """The client has disconnected; the request is notified too."""

    async def _room(self) -> None:
        wake = self._wake = Deferred()
        timer = self._clock.callLater(STALL_SECONDS, self._cut)
        try:
            await wake
        finally:
            cancel(timer)

    def _check(self) -> None:
        if not self._file.allowed():
            self._cut()

    def _cut(self) -> None:
        if not self._request._disconnected:
            self._request.transport.abortConnection()
