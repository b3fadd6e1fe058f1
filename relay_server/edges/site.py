"""HTTP as such: absolute deadlines, size limits, security headers, the portal's files, the root of all URLs."""

from __future__ import annotations

import mimetypes
from collections.abc import Callable
from pathlib import Path
from typing import Any

from twisted.logger import Logger
from twisted.web.http import HTTPChannel
from twisted.web.resource import IResource, Resource
from twisted.web.server import Request, Site

from relay_protocol import jsontext, limits
from relay_server.clock import Timer, cancel
from relay_server.edges.caps import AddressCap
from relay_server.edges.problems import problem

BODY_BYTES = limits.UNPROVEN_BYTES
IDLE_SECONDS = 60.0
CLOSE_SECONDS = 2.0
"""What a refused client has to take the answer."""

SECURITY_HEADERS = {
    b"content-security-policy": (
        b"default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; "
        b"connect-src 'self' ws: wss:; object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    ),
    b"x-content-type-options": b"nosniff",
    b"x-frame-options": b"DENY",
    b"referrer-policy": b"no-referrer",
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
}
HSTS = b"max-age=31536000"


class DeadlineChannel(HTTPChannel):
    """HTTP/1.1 whose requests must be here whole within an absolute time.

    Twisted's own timeout starts anew with each byte, so a slow trickle would hold a connection for ever.
    """

    log = Logger()
    _deadline: Timer | None = None
    _address = ""

    def connectionMade(self) -> None:
        super().connectionMade()
        self._address = getattr(self.transport.getPeer(), "host", "local")
        if not self.site.cap.enter(self._address):
            self.refuse(
                b"429 Too Many Requests", "too many connections from your address", b"Retry-After: 10\r\n"
            )
            return
        self._start_deadline(limits.UNPROVEN_SECONDS, self._too_late)

    def allContentReceived(self) -> None:
        self._stop_deadline()
        super().allContentReceived()

    def requestDone(self, request: Request) -> None:
        super().requestDone(request)
        # The next request on this connection gets the same: its time begins when the last answer is out.
        self._start_deadline(IDLE_SECONDS, self._idle)

    def connectionLost(self, reason: Any) -> None:
        # Not called for a websocket, which takes the transport away: its protocol counts itself out.
        self.site.cap.leave(self._address)
        self._stop_deadline()
        super().connectionLost(reason)

    def refuse(self, status: bytes, reason: str, headers: bytes = b"") -> None:
        """Answer whatever is being sent here with a status and words, and end the connection."""
        self._stop_deadline()
        self.log.info("a request from {address} is refused: {reason}", address=self._address, reason=reason)
        body = reason.encode() + b"\n"
        self.transport.write(
            b"HTTP/1.1 %b\r\n%bContent-Type: text/plain; charset=utf-8\r\nContent-Length: %d\r\n"
            b"Connection: close\r\n\r\n%b" % (status, headers, len(body), body)
        )
        self.transport.loseConnection()
        self._deadline = self.site.reactor.callLater(CLOSE_SECONDS, self._idle)

    def _start_deadline(self, seconds: float, late: Callable[[], None]) -> None:
        self._stop_deadline()
        self._deadline = self.site.reactor.callLater(seconds, late)

    def _stop_deadline(self) -> None:
        cancel(self._deadline)
        self._deadline = None

    def _too_late(self) -> None:
        self._deadline = None
        seconds = limits.UNPROVEN_SECONDS
        self.refuse(b"408 Request Timeout", f"the whole request must be here within {seconds:g} s")

    def _idle(self) -> None:
        self._deadline = None
        if self.transport is not None:
            self.transport.abortConnection()


class BoundedRequest(Request):
    """A request whose body may not grow beyond :data:`BODY_BYTES`, announced or not."""

    def gotLength(self, length: int | None) -> None:
        if length is not None and length > BODY_BYTES:
            self._too_big()
            return
        super().gotLength(length)

    def handleContentChunk(self, data: bytes) -> None:
        if self.content.tell() + len(data) > BODY_BYTES:
            self._too_big()
            return
        super().handleContentChunk(data)

    def render(self, resource: IResource) -> None:
        # Twisted has named itself and its version by now.
        self.setHeader(b"server", b"switchboard")
        super().render(resource)

    def _too_big(self) -> None:
        self.channel.refuse(b"413 Content Too Large", f"a request may carry at most {BODY_BYTES} bytes")


class RelaySite(Site):
    """The site of a relay: no access log (URLs may carry tickets), headers that close what browsers leave open."""

    requestFactory = BoundedRequest
    noisy = False

    def __init__(self, root: IResource, reactor: Any, cap: AddressCap, tls: bool) -> None:
        super().__init__(root, requestFactory=self._request, timeout=IDLE_SECONDS, reactor=reactor)
        self.cap = cap
        self._headers = dict(SECURITY_HEADERS)
        if tls:
            self._headers[b"strict-transport-security"] = HSTS
        self.displayTracebacks = False

    def buildProtocol(self, addr: Any) -> DeadlineChannel:
        channel = DeadlineChannel()
        channel.requestFactory = self._request
        channel.site = self
        channel.factory = self
        channel.timeOut = IDLE_SECONDS
        channel.callLater = self.reactor.callLater
        return channel

    def log(self, request: Any) -> None:
        """Nothing: what matters is logged where it is decided, without secrets."""

    def _request(self, *args: Any, **kwargs: Any) -> BoundedRequest:
        request = BoundedRequest(*args, **kwargs)
        request.site = self
        for name, value in self._headers.items():
            request.setHeader(name, value)
        return request


class Root(Resource):
    """All URLs: robots' websockets, the API, the portal."""

    def __init__(self, robots: IResource, api: IResource, portal: IResource) -> None:
        super().__init__()
        self.putChild(b"robots", robots)
        self._api = api
        self._portal = portal

    def getChild(self, path: bytes, request: Request) -> IResource:
        request.postpath.insert(0, request.prepath.pop())
        return self._api if path in (b"api", b"healthz", b"metrics") else self._portal


class Robots(Resource):
    """``/robots/<robot>``: a websocket, or on a plain GET what speaks here (a websocket client's first question).

    :param video: what is below ``/robots/<robot>/video``; a leaf, it finds the robot in the request's path
    """

    def __init__(self, websocket: IResource, video: IResource, version: str) -> None:
        super().__init__()
        self._websocket = websocket
        self._video = video
        self._about = jsontext.encode(
            {
                "product": "switchboard",
                "version": version,
                "protocol": "rosbridge v2",
                "transport": "websocket",
            }
        )

    def getChild(self, path: bytes, request: Request) -> IResource:
        if request.postpath[:1] == [b"video"]:
            return self._video
        if wants_websocket(request) and not request.postpath:
            return self._websocket
        return self if not request.postpath else Missing()

    def render_GET(self, request: Request) -> bytes:
        request.setHeader(b"content-type", b"application/json")
        return self._about


def wants_websocket(request: Request) -> bool:
    """Whether the connection is to become a websocket (RFC 6455 section 4.1)."""
    return (request.getHeader(b"upgrade") or b"").lower() == b"websocket"


class Missing(Resource):
    """404 in words."""

    isLeaf = True

    def render(self, request: Request) -> bytes:
        return problem(request, 404, "There is nothing at this address.")


class Portal(Resource):
    """The built portal: its files, and its page for every address the portal itself routes."""

    isLeaf = True
    PAGES = frozenset({b"", b"login", b"fleet", b"cockpit", b"alerts"})

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder.resolve()

    def render_GET(self, request: Request) -> bytes | int:
        first = request.postpath[0] if request.postpath else b""
        if first in self.PAGES:
            return self._send(request, self._folder / "index.html")
        try:
            path = (self._folder / b"/".join(request.postpath).decode()).resolve()
        except (UnicodeDecodeError, ValueError):
            return problem(request, 404, "There is nothing at this address.")
        if not path.is_relative_to(self._folder) or not path.is_file():
            return problem(request, 404, "There is nothing at this address.")
        return self._send(request, path)

    def _send(self, request: Request, path: Path) -> bytes:
        try:
            content = path.read_bytes()
        except OSError:
            return problem(request, 503, "The portal is not built; run 'make web'.")
        kind = mimetypes.guess_type(path.name)[0] or "application/octet-stream"
        request.setHeader(
            b"content-type", kind.encode() + (b"; charset=utf-8" if kind.startswith("text/") else b"")
        )
        # Names under assets/ carry a hash of their content.
        hashed = path.parent.name == "assets"
        request.setHeader(b"cache-control", b"public, max-age=31536000, immutable" if hashed else b"no-cache")
        return content
