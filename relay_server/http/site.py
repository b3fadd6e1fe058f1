"""The HTTP site: connections with deadlines and size limits, security headers, the root of all URLs."""

from __future__ import annotations

import errno
import re
from collections import deque
from collections.abc import Callable, Iterable
from traceback import walk_tb
from typing import Any, cast

from twisted.logger import Logger
from twisted.protocols.policies import ProtocolWrapper
from twisted.python.failure import Failure
from twisted.web.http import HTTPChannel
from twisted.web.resource import IResource, Resource
from twisted.web.server import Request, Site

from relay_protocol import jsontext, limits
from relay_protocol.errors import SwitchboardError
from relay_server.cluster.admin import FORWARDED_PATHS, LOCAL_PATH
from relay_server.cluster.forwarding import (
    CLIENT_HEADER,
    CLUSTER_HEADER,
    ForwardedClient,
    check_secret,
    client_address,
)
from relay_server.cluster.shared_connection import ACCEPTED, UPGRADE, SharedConnection
from relay_server.common.clock import Timer, cancel
from relay_server.common.socket_writer import FlushScheduler
from relay_server.common.tcp import keep_little, tcp_of
from relay_server.http import request_fields
from relay_server.http.cross_origin import CrossOrigin
from relay_server.http.limits import (
    ConnectionLimits,
    LargeBodyLimits,
    RequestLimits,
    SharedBytes,
    TooManyRequests,
    Unsent,
)
from relay_server.http.openapi.operation import ApiOperation, Credential, Response, ServerInfo, described
from relay_server.http.problems import problem, problem_body, problem_of

UNSENT_BYTES = 128 * limits.KIB
"""Most bytes of an answer that the kernel holds unsent. Without a limit it holds megabytes, so news would be late."""

CHUNKS = 1024
"""Most chunks of one body: a small one costs as much as a large one."""

_TOO_LARGE = b"413 Content Too Large"
IDLE_SECONDS = 60.0
CLOSE_SECONDS = 2.0
"""Seconds in which a refused client can read its answer."""

PIECE_BYTES = 16 * limits.KIB
"""An answer is copied to the transport in pieces of this size, as the client accepts them."""

AHEAD_BYTES = 8 * limits.KIB
"""Most bytes of pipelined requests that are read ahead of an answer, apart from the last piece read."""

STALL_SECONDS = 30.0
"""Seconds without any byte accepted after which a client is cut."""

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

LARGE_BODIES = (
    (b"POST", re.compile(rb"/api/v1/functions/"), limits.FUNCTION_BODY),
    (b"PUT", re.compile(rb"/api/v1/robots/[^/]+/files/"), limits.FILE_BODY),
)
"""Methods and beginnings of paths that take larger bodies than others, and their most bytes."""

ROUTED = (b"api", b"oauth", b"healthz", b"readyz", b"livez", b"metrics", b".well-known")
"""First path segments that do not belong to the portal."""


class DeadlineChannel(HTTPChannel):
    """HTTP/1.1 with an absolute deadline for the arrival of each request, and for the client to accept its answer.

    Twisted's own timeout starts again with each byte, so a slow trickle would keep a connection for ever.

    Twisted also answers pipelined requests as fast as it reads them, whether or not the client accepts the answers.
    Here the next request begins only when the transport has passed the previous answer to the kernel. Bodies reach the
    transport in pieces, so a body that many connections get is held once.
    """

    log = Logger()
    maxHeaders = request_fields.FIELDS
    _path: bytes
    _deadline: Timer | None = None
    _address = ""
    _refused = False
    _known = False
    _finished: Request | None = None
    """A request whose answer is complete, but not accepted by the client yet."""

    def __init__(self) -> None:
        super().__init__()
        self._pieces: deque[memoryview] = deque()
        """Parts of the answer that were not given to the transport yet."""
        self._stalled: Timer | None = None
        self._pouring: Timer | None = None
        self._resumed = False
        """Whether the transport accepts bytes again, before producers are notified."""
        self._next: Timer | None = None

    def connectionMade(self) -> None:
        tcp = tcp_of(self.transport)
        if tcp is not None:
            # The size of reads, and of unsent data before producers are paused.
            tcp.bufferSize = PIECE_BYTES
            keep_little(tcp, UNSENT_BYTES)
        super().connectionMade()
        self._address = getattr(self.transport.getPeer(), "host", "local")
        if not self.site.connection_limits.enter(self._address):
            self.refuse(
                b"429 Too Many Requests", "too many connections from your address", b"Retry-After: 10\r\n"
            )
            return
        self._start_deadline(limits.UNAUTHENTICATED_SECONDS, self._too_late)

    def dataReceived(self, data: bytes) -> None:
        """Read bytes of a head or body.

        Errors of Twisted's parsers are answered with 400, and errors of the disk that holds large bodies with 507 or
        503. Errors of the relay's own code are logged with their traceback, and answered with 500.
        """
        if self._refused:
            return
        try:
            super().dataReceived(data)
        except request_fields.BadHead as error:
            self.refuse(error.status, str(error))
        except Exception as error:
            if not _in_parser(error):
                self.log.failure("a request from {address} failed", address=self._address, limited="failed")
                self.refuse(b"500 Internal Server Error", "the relay failed on this request; see its log")
                return
            if isinstance(error, OSError):
                self._refuse_for_disk(error)
                return
            self.log.info(
                "a request from {address} can't be read: {error!r}",
                address=self._address,
                error=error,
                limited="unreadable",
            )
            self._respondToBadRequestAndDisconnect()

    def lineReceived(self, line: bytes) -> None:
        """Read one line of a head."""
        request_fields.check_line(line)
        super().lineReceived(line)

    def lineLengthExceeded(self, line: bytes) -> None:
        """Refuse a line that is longer than the limit for a whole head."""
        raise request_fields.BadHead(
            b"431 Request Header Fields Too Large",
            f"request line and header may have at most {self.totalHeadersSize} bytes together",
        )

    def headerReceived(self, line: bytes) -> bool:
        """Read one whole field."""
        request_fields.check_field(line)
        return bool(super().headerReceived(line))

    def allHeadersReceived(self) -> None:
        """Check the complete head before parsers read it."""
        request_fields.check_target(self._path)
        headers = self.requests[-1].requestHeaders
        absolute = request_fields.split_absolute(self._path)
        if absolute is not None:
            # It replaces the field (RFC 9112 section 3.2.2).
            host, self._path = absolute
            headers.setRawHeaders(b"host", [host])
        request_fields.check_fields(headers)
        super().allHeadersReceived()

    def allContentReceived(self) -> None:
        self._stop_deadline()
        super().allContentReceived()

    def rawDataReceived(self, data: bytes) -> None:
        super().rawDataReceived(data)
        # While an answer waits for the transport, Twisted would read without a limit.
        if self._handlingRequest and sum(map(len, self._dataBuffer)) > AHEAD_BYTES:
            self._networkProducer.pauseProducing()

    def requestDone(self, request: Request) -> None:
        self._finished = request
        # In a reactor turn of its own, so that a client that pipelines does not delay others.
        self._next = self.site.reactor.callLater(0, self._answered)

    def connectionLost(self, reason: Any) -> None:
        # Not called for a websocket, which takes over the transport; its protocol calls leave() itself.
        self.site.connection_limits.leave(self._address)
        self._stop_deadline()
        self._pieces.clear()
        self._unstall()
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
        """Give pieces to the transport until it is full or has all."""
        cancel(self._pouring)
        while self._pieces and not self._waitingForTransport:
            whole = self._pieces[0]
            piece, self._pieces[0] = whole[:PIECE_BYTES], whole[PIECE_BYTES:]
            if not self._pieces[0]:
                self._pieces.popleft()
            self.transport.write(bytes(piece))
            if self._pieces and self.isSecure():
                # Twisted's TLS reports one reactor turn late that the connection below it is full.
                self._pouring = self.site.reactor.callLater(0, self._pour)
                return
        if self._waitingForTransport:
            return
        if self._resumed:
            self._resumed = False
            self._unstall()
            super().resumeProducing()
        self._answered()

    def _answered(self) -> None:
        """Begin the next request if the last answer is complete and accepted."""
        request = self._finished
        if request is None:
            return
        if self._pieces or self._waitingForTransport:
            if self._stalled is None:
                self._stall()
            return
        self._finished = None
        self._unstall()
        # The deadline of the next request begins now, even if the request has already arrived.
        self._known = self._known or request.known
        self._start_deadline(IDLE_SECONDS if self._known else limits.UNAUTHENTICATED_SECONDS, self._idle)
        super().requestDone(request)

    def _stall(self) -> None:
        """Cut the client if it accepts nothing for :data:`STALL_SECONDS`. Streams have limits of their own."""
        self._unstall()
        if self._requestProducer is None:
            self._stalled = self.site.reactor.callLater(STALL_SECONDS, self._idle)
            self.site.unsent.add(self._address, self, sum(map(_held, self._pieces)))

    def _unstall(self) -> None:
        cancel(self._stalled)
        self._stalled = None
        self.site.unsent.remove(self._address, self)

    # --- refusing -----------------------------------------------------------------------------------------

    def expect_large_body(self, request: Request, length: int) -> None:
        """Count a large body while its request lasts, and give it more time.

        :raises BadHead: too many bytes of such bodies are under way
        """
        known = self.site.remembers(request)
        release = self.site.large_bodies.enter(self._address, length, known=known)
        if release is None:
            more = "" if known else ", or send a small request with your token before"
            raise request_fields.BadHead(
                b"503 Service Unavailable",
                f"too many large requests are under way; try again in a moment{more}",
            )
        request.notifyFinish().addBoth(lambda _: release())
        self._start_deadline(IDLE_SECONDS, self._too_late)

    def refuse(self, status: bytes, reason: str, headers: bytes = b"") -> None:
        """Answer with a status and a reason, and close the connection."""
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

    def _refuse_for_disk(self, error: OSError) -> None:
        """Answer a request whose body can't be held in a temporary file."""
        self.log.error(
            "the body of a request can't be held on the disk: {error}", error=error, limited="disk"
        )
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            self.refuse(
                b"507 Insufficient Storage", "the relay's disk is full; its administrator must make room"
            )
        else:
            self.refuse(
                b"503 Service Unavailable", "the relay can't hold this request on its disk; see its log"
            )

    def _respondToBadRequestAndDisconnect(self) -> None:
        # Twisted would send a status without a body.
        self.refuse(b"400 Bad Request", "this is not a valid HTTP/1.1 request (RFC 9112)")

    def _start_deadline(self, seconds: float, late: Callable[[], None]) -> None:
        self._stop_deadline()
        self._deadline = self.site.reactor.callLater(seconds, late)

    def _stop_deadline(self) -> None:
        cancel(self._deadline)
        self._deadline = None

    def _too_late(self) -> None:
        self._deadline = None
        seconds = limits.UNAUTHENTICATED_SECONDS
        self.refuse(b"408 Request Timeout", f"the whole request must arrive within {seconds:g} s")

    def _idle(self) -> None:
        self._deadline = None
        if self.transport is not None:
            self.transport.abortConnection()


def _held(piece: memoryview) -> int:
    """Bytes of memory that a waiting part of an answer costs: the whole body of which it is a part."""
    return 0 if isinstance(piece.obj, SharedBytes) else len(cast(bytes, piece.obj))


def _in_parser(error: Exception) -> bool:
    """Whether an error was raised by Twisted, or below it, while it parsed bytes that the relay had passed to it."""
    modules = [str(frame.f_globals.get("__name__", "")) for frame, _ in walk_tb(error.__traceback__)]
    ours = max(number for number, name in enumerate(modules) if name.startswith("relay_"))
    return modules[ours + 1 : ours + 2] != [] and modules[ours + 1].startswith("twisted.")


def _most_bytes(method: bytes, path: bytes) -> int:
    """Most bytes of a request's body."""
    large = (most for each, begin, most in LARGE_BODIES if each == method and begin.match(path))
    return next(large, limits.HTTP_BODY)


class BoundedRequest(Request):
    """A request whose body has at most :data:`~relay_protocol.limits.HTTP_BODY` bytes, with or without a length.

    Those of :data:`LARGE_BODIES` may have more, with a length.
    """

    log = Logger()
    forwarded_client: ForwardedClient | None = None
    """The client of a request that another relay of the cluster has forwarded; it has authenticated the client."""
    from_listed_page = False
    """Whether a page of a listed origin sent this request, by its ``Origin``."""
    known = False
    """Whether this request carried valid credentials of a user or an OAuth client."""
    _chunks: int | None = None
    _most = limits.HTTP_BODY

    def unregisterProducer(self) -> None:
        """Do nothing if the client has disconnected: Twisted has removed the channel then."""
        if self.channel is not None:
            super().unregisterProducer()

    def gotLength(self, length: int | None) -> None:
        if length is None:
            self._chunks = 0
        elif length > limits.HTTP_BODY:
            self._expect_large_body(length)
        # Twisted would hold a body in chunks on the disk, however small it is.
        super().gotLength(length or 0)

    def _expect_large_body(self, length: int) -> None:
        """Accept a body of :data:`LARGE_BODIES`; Twisted keeps it on the disk."""
        most = _most_bytes(self.channel._command, self.channel._path)
        if length > most:
            raise request_fields.BadHead(_TOO_LARGE, f"a request may carry at most {most} bytes")
        self._most = length
        self.channel.expect_large_body(self, length)

    def handleContentChunk(self, data: bytes) -> None:
        if self._chunks is not None:
            self._chunks += 1
            if self._chunks > CHUNKS:
                raise request_fields.BadHead(_TOO_LARGE, f"a body may come in at most {CHUNKS} chunks")
        if self.content.tell() + len(data) > self._most:
            raise request_fields.BadHead(_TOO_LARGE, f"a request may carry at most {self._most} bytes")
        super().handleContentChunk(data)

    def process(self) -> None:
        headers = self.requestHeaders
        for name, values in list(headers.getAllRawHeaders()):
            # Twisted fails when a header that is not text is read as text (RFC 9110 section 5.5).
            headers.setRawHeaders(name, [each.decode(errors="replace").encode() for each in values])
        try:
            if self.site.answers_preflight(self):
                return
            super().process()
        except Exception:
            # The request is complete, so this is not the sender's error. Twisted handles errors of resources itself.
            self.processingFailed(Failure())

    def render(self, resource: IResource) -> None:
        # Twisted has set its own name and version.
        self.setHeader(b"server", b"switchboard")
        super().render(resource)

    def processingFailed(self, reason: Failure) -> Failure:
        """Answer an unexpected error with 500, in place of Twisted's own error page."""
        if self.startedWriting or self.channel is None or self.channel.transport is None:
            # The answer has begun, or Autobahn has the connection.
            self.transport.abortConnection()
            return reason
        self.log.failure("{method} {path} failed", reason, method=self.method, path=self.path)
        body = problem(self, 500, "The relay failed on this request; see its log.")
        self.setHeader(b"content-length", b"%d" % len(body))
        self.write(body)
        self.finish()
        return reason


class ForwardedRequest(BoundedRequest):
    """A request that another relay of the cluster has forwarded."""

    def process(self) -> None:
        """Check the secret, then serve the request for its client."""
        try:
            check_secret(self.getHeader(CLUSTER_HEADER), self.site.secret)
            if self.getHeader("upgrade") == UPGRADE:
                self._share()
                return
            self.forwarded_client = ForwardedClient.parse(self.getHeader(CLIENT_HEADER) or "")
        except SwitchboardError as error:
            self.log.warn("{error}", error=error, limited="cluster")
            body = problem_of(self, error)
            self.setHeader(b"content-length", b"%d" % len(body))
            self.write(body)
            self.finish()
            return
        self.requestHeaders.removeHeader(CLUSTER_HEADER)
        super().process()

    def _share(self) -> None:
        """Go on with the connection as a shared one; each of its streams is a connection of this site."""
        transport, self.channel.transport = self.channel.transport, None
        shared: Any = SharedConnection(self.site.reactor, self.site.flushes, self.site.buildProtocol)
        if isinstance(transport, ProtocolWrapper):
            transport.wrappedProtocol = shared
        else:
            transport.protocol = shared
        # It was the HTTP channel's, which reads nothing while a request is served.
        transport.unregisterProducer()
        transport.write(ACCEPTED)
        shared.makeConnection(transport)
        transport.resumeProducing()

    def getClientAddress(self) -> Any:
        """The address of the client."""
        first = self.forwarded_client
        return super().getClientAddress() if first is None else client_address(first)


class RelaySite(Site):
    """The site of a relay, with security headers in each answer and without an access log (URLs may carry tickets).

    :param remembers: whether the sender of a request is known, without asking the database
    :param cross_origin: the rules for pages of listed origins; ``None``: there are none
    """

    requestFactory = BoundedRequest
    request_class: type[BoundedRequest] = BoundedRequest
    noisy = False

    def __init__(
        self,
        root: IResource,
        reactor: Any,
        connection_limits: ConnectionLimits,
        tls: bool,
        request_limits: RequestLimits,
        remembers: Callable[[Request], bool] = lambda request: False,
        cross_origin: CrossOrigin | None = None,
    ) -> None:
        super().__init__(
            root,
            requestFactory=self._request,
            timeout=IDLE_SECONDS,
            reactor=reactor,
            # Handlers read bodies themselves, after their size and their sender are known.
            parsePOSTFormSubmission=False,
        )
        self.connection_limits = connection_limits
        self.limits = request_limits
        self.unsent = Unsent()
        self.remembers = remembers
        self.cross_origin = cross_origin
        self.large_bodies = LargeBodyLimits()
        self._headers = dict(SECURITY_HEADERS)
        # Behind a proxy that ends TLS, too. Browsers ignore it where they do not use TLS.
        if tls or (cross_origin is not None and cross_origin.any_encrypted):
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

    def answers_preflight(self, request: Request) -> bool:
        """Allow what a page of a listed origin may do; returns whether the request is answered by that."""
        of_api = request.path[1:].partition(b"/")[0] in (*ROUTED, b"robots")
        return self.cross_origin is not None and of_api and self.cross_origin.allow(request)

    def log(self, request: Any) -> None:
        """Log nothing. Decisions are logged where they are made, without secrets."""

    def _request(self, *args: Any, **kwargs: Any) -> BoundedRequest:
        request = self.request_class(*args, **kwargs)
        request.site = self
        for name, value in self._headers.items():
            request.setHeader(name, value)
        return request


class ClusterSite(RelaySite):
    """The same site for requests that other relays of the cluster forward.

    :param secret: of the cluster
    """

    request_class = ForwardedRequest

    def __init__(
        self,
        root: IResource,
        reactor: Any,
        connection_limits: ConnectionLimits,
        request_limits: RequestLimits,
        secret: str,
    ) -> None:
        super().__init__(root, reactor, connection_limits, False, request_limits, self._from_relay)
        self.secret = secret
        self.flushes = FlushScheduler(reactor)
        # The relay at which the client is adds them.
        self._headers = {}

    def _from_relay(self, request: Request) -> bool:
        try:
            check_secret(request.getHeader(CLUSTER_HEADER), self.secret)
        except SwitchboardError:
            return False
        return True


class ClusterRoot(Resource):
    """All URLs for other relays: those for clients, and what other relays pass on from their local sockets.

    :param local: the resource of this relay's local socket
    """

    PATHS = frozenset(f"{LOCAL_PATH}{path}".encode() for path in FORWARDED_PATHS)

    def __init__(self, root: Resource, local: IResource) -> None:
        super().__init__()
        self._root = root
        self._local = local

    def getChild(self, path: bytes, request: Request) -> IResource:
        if request.path in self.PATHS:
            return self._local
        return self._root.getChildWithDefault(path, request)


class Root(Resource):
    """All URLs: robots' websockets, live updates, ICPI programs, the API with ``/oauth``, the portal.

    :param pages: live updates over a websocket; the API serves them as server-sent events at the same address
    :param programs: the websocket of ICPI programs
    """

    PAGES = b"/api/v1/robots/stream"

    PROGRAMS = b"/icpi"

    def __init__(
        self,
        robots: IResource,
        api: IResource,
        portal: IResource,
        pages: IResource,
        programs: IResource | None = None,
    ) -> None:
        super().__init__()
        self.putChild(b"robots", robots)
        self._api = api
        self._portal = portal
        self._pages = pages
        self._programs = programs

    def getChild(self, path: bytes, request: Request) -> IResource:
        if request.path == self.PAGES and wants_websocket(request):
            return self._pages
        if request.path == self.PROGRAMS and self._programs is not None:
            return self._programs
        request.postpath.insert(0, request.prepath.pop())
        if path not in ROUTED:
            return self._portal
        if not _is_text(b"/".join(request.postpath)):
            return Missing(400, "The address is not in UTF-8.")
        if not _is_host(request.getRequestHostname()):
            return Missing(400, "The request's Host is not valid: send the relay's name or address.")
        request.postpath = single_slashes(request.postpath)
        return self._api


def single_slashes(segments: list[bytes]) -> list[bytes]:
    """Segments of a path without empty ones, and without escaped slashes at their beginning.

    Names of ROS begin with a slash and mean the same without it. Pasted into an address they give two slashes.
    """
    bare = [each.lstrip(b"/") for each in segments]
    return [*(each for each in bare[:-1] if each), *bare[-1:]]


def _is_host(name: bytes) -> bool:
    """Whether each label of a name has an allowed length (RFC 1035 section 2.3.4)."""
    try:
        name.decode().encode("idna")
    except UnicodeError:
        return False
    return True


def _is_text(path: bytes) -> bool:
    try:
        path.decode()
    except UnicodeDecodeError:
        return False
    return True


class ReadOnly(Resource):
    """A resource that can only be read, without credentials. Requests count for their network."""

    def render(self, request: Request) -> bytes | int:
        if request.method not in (b"GET", b"HEAD"):
            request.setHeader(b"allow", b"GET, HEAD")
            return problem(request, 405, "This address does not support that method; see 'Allow'.")
        try:
            request.site.limits.of_network(request)
        except TooManyRequests as error:
            return problem_of(request, error)
        answer: bytes | int = self.render_GET(request)
        return answer


class RobotAddress(ReadOnly):
    """``/robots/<robot>``: a websocket; a plain GET describes the server, as some websocket clients ask first.

    :param video: the resource below ``/robots/<robot>/video``; it finds the robot in the request's path
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
        # The same address with a slash at the end.
        if request.postpath not in ([], [b""]):
            return Missing()
        return self._websocket if wants_websocket(request) else self

    @described(
        ApiOperation(
            method="GET",
            path="/robots/{robot}",
            tag="relay",
            summary="The server behind a robot's websocket",
            more="The websocket itself speaks rosbridge v2 (SPEC 1).",
            answers={200: Response("the server", ServerInfo)},
            credential=Credential.NONE,
        )
    )
    def render_GET(self, request: Request) -> bytes:
        request.setHeader(b"content-type", b"application/json")
        return self._about


def wants_websocket(request: Request) -> bool:
    """Whether a request asks for a websocket (RFC 6455 section 4.1)."""
    return (request.getHeader(b"upgrade") or b"").lower() == b"websocket"


class Missing(Resource):
    """An error as problem details; 404 by default."""

    isLeaf = True

    def __init__(self, status: int = 404, detail: str = "There is nothing at this address.") -> None:
        super().__init__()
        self._status = status
        self._detail = detail

    def render(self, request: Request) -> bytes:
        return problem(request, self._status, self._detail)
