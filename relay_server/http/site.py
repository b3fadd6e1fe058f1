"""HTTP as such: absolute deadlines, size limits, security headers, the portal's files, the root of all URLs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from traceback import walk_tb
from typing import Any, cast

from twisted.logger import Logger
from twisted.python.failure import Failure
from twisted.web.http import HTTPChannel
from twisted.web.resource import IResource, Resource
from twisted.web.server import Request, Site
from werkzeug.exceptions import HTTPException

from relay_protocol import jsontext, limits
from relay_server.common.clock import Timer, cancel
from relay_server.common.tcp import keep_little, tcp_of
from relay_server.http import request_head
from relay_server.http.connection_limits import ConnectionLimits, SharedBytes, Unsent
from relay_server.http.openapi.operation import ApiOperation, Credential, Response, described
from relay_server.http.openapi.schemas import ServerInfo
from relay_server.http.problems import problem, problem_body, problem_of
from relay_server.http.rate_limits import RequestLimits, TooManyRequests

BODY_BYTES = limits.UNPROVEN_BYTES
UNSENT_BYTES = 128 * limits.KIB
"""What the kernel may hold unsent of an answer; without a limit it takes megabytes, which a slow reader gets late."""

CHUNKS = 1024
"""Chunks of one body, and pieces they come in: each costs as much as a large one."""

_TOO_LARGE = b"413 Content Too Large"
IDLE_SECONDS = 60.0
CLOSE_SECONDS = 2.0
"""What a refused client has to take the answer."""

PIECE_BYTES = 16 * limits.KIB
"""An answer is copied to the transport in pieces of this size, as the client takes them."""

AHEAD_BYTES = 8 * limits.KIB
"""Pipelined requests that are read while one before them is answered; up to another piece may come with the last."""

STALL_SECONDS = 30.0
"""A client that takes nothing of an answer for so long is cut."""

POLICY = b"content-security-policy"
SECURITY_HEADERS = {
    POLICY: (
        b"default-src 'self'; img-src 'self' data: blob:; style-src 'self'; "
        b"connect-src 'self' ws: wss:; object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    ),
    b"x-content-type-options": b"nosniff",
    b"x-frame-options": b"DENY",
    b"referrer-policy": b"no-referrer",
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
}
HSTS = b"max-age=31536000"

DOCUMENTS = (b"/api/openapi.json", b"/api/docs")
ROUTED = (b"api", b"oauth", b"healthz", b"metrics")
"""First parts of addresses that klein has routes for."""


class DeadlineChannel(HTTPChannel):
    """HTTP/1.1 whose requests must arrive whole within an absolute time, and whose answers must be taken.

    Twisted's own timeout starts again with each byte, so a slow trickle would hold a connection for ever.

    Twisted also answers pipelined requests as fast as it reads them, whether or not the client takes the answers. Here
    the next request is looked at only when the transport has passed the answer before it on to the kernel. Bodies reach
    the transport in pieces, so what many connections are sent alike is held once for all of them.
    """

    log = Logger()
    maxHeaders = request_head.FIELDS
    _deadline: Timer | None = None
    _address = ""
    _refused = False
    _known = False
    _finished: Request | None = None
    """A request that is answered, and whose answer is not taken yet."""

    def __init__(self) -> None:
        super().__init__()
        self._pieces: deque[memoryview] = deque()
        """Parts of the answer that the transport does not have yet."""
        self._stalled: Timer | None = None
        self._pouring: Timer | None = None
        self._resumed = False
        """Whether the transport takes bytes again, and producers do not know yet."""
        self._next: Timer | None = None

    def connectionMade(self) -> None:
        tcp = tcp_of(self.transport)
        if tcp is not None:
            # Both what is read at a time, and what may wait to be sent before producers are paused.
            tcp.bufferSize = PIECE_BYTES
            keep_little(tcp, UNSENT_BYTES)
        super().connectionMade()
        self._address = getattr(self.transport.getPeer(), "host", "local")
        if not self.site.cap.enter(self._address):
            self.refuse(
                b"429 Too Many Requests", "too many connections from your address", b"Retry-After: 10\r\n"
            )
            return
        self._start_deadline(limits.UNPROVEN_SECONDS, self._too_late)

    def dataReceived(self, data: bytes) -> None:
        """Bytes of a head or body. Errors of Twisted's parsers are the sender's fault, and answered with 400; errors of
        the relay's own code are logged with their traceback, and answered with 500.
        """
        if self._refused:
            return
        try:
            super().dataReceived(data)
        except request_head.BadHead as error:
            self.refuse(error.status, str(error))
        except Exception as error:
            if not _in_parser(error):
                self.log.failure("a request from {address} failed", address=self._address, limited="failed")
                self.refuse(
                    b"500 Internal Server Error", "the relay failed on this request; its log tells more"
                )
                return
            self.log.info(
                "a request from {address} can't be read: {error!r}",
                address=self._address,
                error=error,
                limited="unreadable",
            )
            self._respondToBadRequestAndDisconnect()

    def lineReceived(self, line: bytes) -> None:
        """One line of a head."""
        request_head.check_line(line)
        super().lineReceived(line)

    def lineLengthExceeded(self, line: bytes) -> None:
        """A line longer than all lines of a head together may be."""
        raise request_head.BadHead(
            b"431 Request Header Fields Too Large",
            f"request line and header may have at most {self.totalHeadersSize} bytes together",
        )

    def headerReceived(self, line: bytes) -> bool:
        """One field, whole."""
        request_head.check_field(line)
        return bool(super().headerReceived(line))

    def allHeadersReceived(self) -> None:
        """The head is here; from now on parsers read it."""
        request_head.check_target(self._path)
        request_head.check_fields(self.requests[-1].requestHeaders)
        super().allHeadersReceived()

    def allContentReceived(self) -> None:
        self._stop_deadline()
        super().allContentReceived()

    def rawDataReceived(self, data: bytes) -> None:
        super().rawDataReceived(data)
        # Twisted reads on without a bound while an answer waits for the transport.
        if self._handlingRequest and sum(map(len, self._dataBuffer)) > AHEAD_BYTES:
            self._networkProducer.pauseProducing()

    def requestDone(self, request: Request) -> None:
        self._finished = request
        # In a turn of its own: a client that pipelines must not keep others waiting.
        self._next = self.site.reactor.callLater(0, self._answered)

    def connectionLost(self, reason: Any) -> None:
        # Not called for a websocket, which takes the transport away: its protocol counts itself out.
        self.site.cap.leave(self._address)
        self._stop_deadline()
        self._pieces.clear()
        self._takes()
        cancel(self._pouring)
        cancel(self._next)
        super().connectionLost(reason)

    # --- answers ------------------------------------------------------------------------------------------

    def write(self, data: bytes) -> None:
        if len(data) <= PIECE_BYTES and not self._pieces:
            self.transport.write(data)
        else:
            self._pieces.append(memoryview(data))
            self._pour()

    def writeSequence(self, iovec: Iterable[bytes]) -> None:
        for each in iovec:
            self.write(each)

    def pauseProducing(self) -> None:
        super().pauseProducing()
        self._stall()

    def resumeProducing(self) -> None:
        self._waitingForTransport = False
        self._resumed = True
        self._pour()

    def _pour(self) -> None:
        """Give the transport the next pieces, until it has enough or all."""
        cancel(self._pouring)
        while self._pieces and not self._waitingForTransport:
            whole = self._pieces[0]
            piece, self._pieces[0] = whole[:PIECE_BYTES], whole[PIECE_BYTES:]
            if not self._pieces[0]:
                self._pieces.popleft()
            self.transport.write(bytes(piece))
            if self._pieces and self.isSecure():
                # Twisted's TLS says only a turn later that the connection below it is full.
                self._pouring = self.site.reactor.callLater(0, self._pour)
                return
        if self._waitingForTransport:
            return
        if self._resumed:
            self._resumed = False
            self._takes()
            super().resumeProducing()
        self._answered()

    def _answered(self) -> None:
        """Go on with the next request, if the answer to the last is complete and taken."""
        request = self._finished
        if request is None:
            return
        if self._pieces or self._waitingForTransport:
            if self._stalled is None:
                self._stall()
            return
        self._finished = None
        self._takes()
        # The next request gets the same: its time begins when the last answer is out. It may be here already.
        self._known = self._known or request.known
        self._start_deadline(IDLE_SECONDS if self._known else limits.UNPROVEN_SECONDS, self._idle)
        super().requestDone(request)

    def _stall(self) -> None:
        """The client has that long to take something. Streams have limits of their own, and say why they end."""
        self._takes()
        if self._requestProducer is None:
            self._stalled = self.site.reactor.callLater(STALL_SECONDS, self._idle)
            self.site.unsent.add(self._address, self, sum(map(_held, self._pieces)))

    def _takes(self) -> None:
        cancel(self._stalled)
        self._stalled = None
        self.site.unsent.remove(self._address, self)

    # --- refusing -----------------------------------------------------------------------------------------

    def refuse(self, status: bytes, reason: str, headers: bytes = b"") -> None:
        """Answer whatever is being sent here with a status and words, and end the connection."""
        if self._refused or self.transport is None:
            return
        self._refused = True
        self._stop_deadline()
        number, _, title = status.decode().partition(" ")
        self.log.info(
            "a request from {address} is refused: {reason}",
            address=self._address,
            reason=reason,
            limited=number,
        )
        body = problem_body(int(number), reason, title=title)
        self.transport.write(
            b"HTTP/1.1 %b\r\n%bContent-Type: application/problem+json\r\nContent-Length: %d\r\n"
            b"Connection: close\r\n\r\n%b" % (status, headers, len(body), body)
        )
        self.transport.loseConnection()
        self._deadline = self.site.reactor.callLater(CLOSE_SECONDS, self._idle)

    def _respondToBadRequestAndDisconnect(self) -> None:
        # Twisted would say no word.
        self.refuse(b"400 Bad Request", "this is no request of HTTP/1.1 (RFC 9112)")

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


def _held(piece: memoryview) -> int:
    """Bytes of memory that a connection takes by a part of an answer: all of the body that it is part of."""
    return 0 if isinstance(piece.obj, SharedBytes) else len(cast(bytes, piece.obj))


def _in_parser(error: Exception) -> bool:
    """Whether Twisted, or what it calls, raised an error while it read what the relay had handed to it."""
    modules = [str(frame.f_globals.get("__name__", "")) for frame, _ in walk_tb(error.__traceback__)]
    ours = max(number for number, name in enumerate(modules) if name.startswith("relay_"))
    return modules[ours + 1 : ours + 2] != [] and modules[ours + 1].startswith("twisted.")


class BoundedRequest(Request):
    """A request whose body may not grow beyond :data:`BODY_BYTES`, announced or not."""

    log = Logger()
    known = False
    """Whether a user or an OAuth client proved with this request who they are."""
    _chunks: int | None = None

    def gotLength(self, length: int | None) -> None:
        if length is None:
            self._chunks = 0
        elif length > BODY_BYTES:
            raise request_head.BadHead(_TOO_LARGE, f"a request may carry at most {BODY_BYTES} bytes")
        super().gotLength(length)

    def handleContentChunk(self, data: bytes) -> None:
        if self._chunks is not None:
            self._chunks += 1
            if self._chunks > CHUNKS:
                raise request_head.BadHead(_TOO_LARGE, f"a body may come in at most {CHUNKS} chunks")
        if self.content.tell() + len(data) > BODY_BYTES:
            raise request_head.BadHead(_TOO_LARGE, f"a request may carry at most {BODY_BYTES} bytes")
        super().handleContentChunk(data)

    def process(self) -> None:
        headers = self.requestHeaders
        for name, values in list(headers.getAllRawHeaders()):
            # Twisted fails where somebody reads as text what is none (RFC 9110 section 5.5).
            headers.setRawHeaders(name, [each.decode(errors="replace").encode() for each in values])
        try:
            super().process()
        except Exception:
            # The request is read: from here on no error is the sender's. Those of resources Twisted hands over itself.
            self.processingFailed(Failure())

    def render(self, resource: IResource) -> None:
        # Twisted has named itself and its version by now.
        self.setHeader(b"server", b"switchboard")
        super().render(resource)

    def processingFailed(self, reason: Failure) -> Failure:
        """Something failed before anybody could say why: Twisted would answer with a page of its own."""
        error = reason.value
        if self.startedWriting or self.channel is None or self.channel.transport is None:
            # An answer is under way, or Autobahn has the connection.
            self.transport.abortConnection()
            return reason
        if isinstance(error, HTTPException) and error.code is not None:
            # As of a host that can't be one, before klein looks for a route.
            body = problem(self, error.code, "The request can't be served.")
        else:
            self.log.failure("{method} {path} failed", reason, method=self.method, path=self.path)
            body = problem(self, 500, "The relay failed on this request; its log tells more.")
        self.setHeader(b"content-length", b"%d" % len(body))
        self.write(body)
        self.finish()
        return reason


class RelaySite(Site):
    """The site of a relay: no access log (URLs may carry tickets), headers that close what browsers leave open."""

    requestFactory = BoundedRequest
    noisy = False

    def __init__(
        self, root: IResource, reactor: Any, cap: ConnectionLimits, tls: bool, request_limits: RequestLimits
    ) -> None:
        super().__init__(
            root,
            requestFactory=self._request,
            timeout=IDLE_SECONDS,
            reactor=reactor,
            # Handlers read bodies themselves, after they know how large they are and who sent them.
            parsePOSTFormSubmission=False,
        )
        self.cap = cap
        self.limits = request_limits
        self.unsent = Unsent()
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
    """All URLs: robots' websockets, the API, tokens, the portal.

    :param pages: what pages are told over a websocket; to others the API tells it at the same address
    :param documents: what tells of the API at :data:`DOCUMENTS`
    """

    PAGES = b"/api/v1/robots/stream"

    def __init__(
        self,
        robots: IResource,
        api: IResource,
        oauth: IResource,
        portal: IResource,
        pages: IResource,
        documents: IResource | None = None,
    ) -> None:
        super().__init__()
        self._documents = documents
        self.putChild(b"robots", robots)
        self._api = api
        self._oauth = oauth
        self._portal = portal
        self._pages = pages

    def getChild(self, path: bytes, request: Request) -> IResource:
        if request.path == self.PAGES and wants_websocket(request):
            return self._pages
        request.postpath.insert(0, request.prepath.pop())
        if path not in ROUTED:
            return self._portal
        if not _is_text(b"/".join(request.postpath)):
            return Missing(400, "The address is not in UTF-8.")
        request.postpath = single_slashes(request.postpath)
        if request.path in DOCUMENTS and self._documents is not None:
            return self._documents
        if path == b"oauth":
            return self._oauth
        return self._api


def single_slashes(segments: list[bytes]) -> list[bytes]:
    """Parts of an address without those that are empty, or begin with a slash that came escaped.

    Names of ROS begin with one, and mean the same without it; whoever puts one into an address has two of them there.
    """
    bare = [each.lstrip(b"/") for each in segments]
    return [*(each for each in bare[:-1] if each), *bare[-1:]]


def _is_text(path: bytes) -> bool:
    try:
        path.decode()
    except UnicodeDecodeError:
        return False
    return True


class ReadOnly(Resource):
    """What is there to be read, by anybody; requests count for their network."""

    def render(self, request: Request) -> bytes | int:
        if request.method not in (b"GET", b"HEAD"):
            request.setHeader(b"allow", b"GET, HEAD")
            return problem(request, 405, "This address does not take that method.")
        try:
            request.site.limits.of_network(request)
        except TooManyRequests as error:
            return problem_of(request, error)
        answer: bytes | int = self.render_GET(request)
        return answer


class RobotAddress(ReadOnly):
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
        # A slash at the end makes no other address.
        if request.postpath not in ([], [b""]):
            return Missing()
        return self._websocket if wants_websocket(request) else self

    @described(
        ApiOperation(
            method="GET",
            path="/robots/{robot}",
            tag="relay",
            summary="What speaks at a robot's websocket",
            more="The websocket itself speaks rosbridge v2 (SPEC section 1).",
            answers={200: Response("what speaks here", ServerInfo)},
            credential=Credential.NONE,
        )
    )
    def render_GET(self, request: Request) -> bytes:
        request.setHeader(b"content-type", b"application/json")
        return self._about


def wants_websocket(request: Request) -> bool:
    """Whether the connection is to become a websocket (RFC 6455 section 4.1)."""
    return (request.getHeader(b"upgrade") or b"").lower() == b"websocket"


class Missing(Resource):
    """An error in words; where nothing else is said, 404."""

    isLeaf = True

    def __init__(self, status: int = 404, detail: str = "There is nothing at this address.") -> None:
        super().__init__()
        self._status = status
        self._detail = detail

    def render(self, request: Request) -> bytes:
        return problem(request, self._status, self._detail)
