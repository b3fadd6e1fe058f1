"""Websockets of clients: each is one session with one robot (``/robots/<robot>``).

:class:`ClientConnection` authenticates the client and passes whole messages to what it opens, a
:class:`~relay_server.ws.handshake.WebSocketHandler`. A client sends its credentials in the handshake (Bearer header,
``bearer.`` subprotocol, ticket, or cookie with a listed Origin) or in a rosbridge ``auth`` as its first message.

The subprotocol decides the dialect: a client that offers one of Foxglove's speaks that protocol, all others rosbridge.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any, TypeVar, cast
from urllib.parse import unquote

from autobahn.twisted.websocket import WebSocketServerFactory
from autobahn.websocket.protocol import TrafficStats
from autobahn.websocket.types import ConnectionDeny, ConnectionRequest
from twisted.internet.defer import Deferred
from twisted.internet.protocol import connectionDone
from twisted.logger import Logger

from relay_protocol import limits, rosbridge
from relay_protocol.errors import PeerError, SwitchboardError, Unavailable
from relay_protocol.nonfinite import NotFinite
from relay_server.access import LOOKUP_SECONDS, NOT_LOOKED_UP, BadCredentials, Principal
from relay_server.auth.authenticator import TicketPurpose, TooManyTries
from relay_server.cluster.forwarding import ForwardedClient, RequestForwarding
from relay_server.cluster.websockets import ForwardedHandshake, ForwardedWebSocket
from relay_server.common import close_codes, websocket_frames
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.concurrency import with_timeout
from relay_server.common.pacing import Pacer
from relay_server.common.socket_writer import FlushScheduler
from relay_server.common.tcp import keep_little, tcp_of
from relay_server.control.service import StopResult
from relay_server.foxglove import messages
from relay_server.foxglove.options import NO_OPTIONS, stream_options
from relay_server.http.limits import ConnectionLimits, RequestLimits, Slot, TooManyRequests
from relay_server.sessions.manager import Admission
from relay_server.ws.bounded import BoundedProtocol
from relay_server.ws.forwarded_stops import ForwardedStops
from relay_server.ws.handshake import (
    HANDSHAKE_STATUS,
    BinaryHandler,
    DialectSessions,
    HandshakeAuth,
    HandshakeSessions,
    WebSocketHandler,
    code_of,
    foxglove_subprotocol,
    identify,
    status_of,
    subprotocol,
)

T = TypeVar("T")

UNAUTHENTICATED_FRAME_BYTES = limits.UNAUTHENTICATED_BYTES + 1024
"""Most bytes that a client may send before its session begins, including the headers of frames."""

UNSENT_BYTES = 512 * limits.KIB
"""Most bytes that the kernel may hold unsent for a session.

A connection that is not authenticated has less. A large message would leave in pieces then, each in a reactor turn of
its own.
"""

NO_CREDENTIALS = "log in: no credentials came with the connection"

REFUSED_AT_ONCE = (TooManyRequests, TooManyTries)
"""Errors that refuse the handshake of a browser too, though it cannot read the reason."""

RELAY_FAILED = "the relay failed; see its log"

EARLY_NS = 5_000_000_000
"""Nanoseconds by which first messages are taken to be older that a client has sent to another relay of the cluster
before this one knew of it: more than the greatest age of a command."""

EARLY_OVERHEAD = 64
"""Bytes that a message before authentication counts for beside its own; empty messages take memory too."""


def _no_stream() -> None:
    """The connection counts as no stream."""


class ClientConnection(BoundedProtocol):
    """One client's websocket."""

    relay_log = Logger()
    """Autobahn logs to ``log``, which is rate-limited as a library's (:mod:`relay_server.logs`)."""
    factory: ClientFactory
    message_limit: int | None = None
    """Most bytes of a message once the session has begun; ``None``: the relay's setting."""

    has_dialects = True
    """Whether a subprotocol of Foxglove counts here; the sessions are :class:`DialectSessions` then."""

    is_stream = False
    """Whether the connection counts as one of its user's streams."""

    def __init__(self) -> None:
        super().__init__()
        self._robot = ""
        self._forwarded: ForwardedClient | None = None
        """The client, if another relay of the cluster has forwarded it."""
        self._handshake: ForwardedHandshake | None = None
        """Held until the session begins where it may have to be forwarded."""
        self._elsewhere: ForwardedWebSocket | None = None
        """The open websocket to the robot's home, until the session begins."""
        self._admission: Admission | None = None
        self._failure: SwitchboardError | None = None
        self._handler: WebSocketHandler | None = None
        self._foxglove = False
        """Whether the client speaks the Foxglove protocol."""
        self._options = NO_OPTIONS
        self._binary_handler: BinaryHandler | None = None
        self._authenticating = False
        self._early: list[bytes] = []
        self._early_bytes = 0
        self._unauthenticated_bytes = 0
        self._deadline: Timer | None = None
        self._slot: Slot | None = None
        self._lost = False
        self._end_stream: Callable[[], None] = _no_stream
        self._handshaking = False
        self._open = False
        self._opened_ns = 0
        self._begun_earliest_sent = 0
        self._pacer: Pacer | None = None

    # --- handshake ----------------------------------------------------------------------------------------

    def connectionMade(self) -> None:
        """The site has passed on a connection that requested a websocket."""
        super().connectionMade()
        self._forwarded = self.factory.forwarded_client
        self.limit_message_size(limits.UNAUTHENTICATED_BYTES)
        self._slot = self.factory.connection_limits.unauthenticated()
        # One deadline for handshake and authentication together; a session ends it.
        self._deadline = self.factory.clock.callLater(limits.UNAUTHENTICATED_SECONDS, self._not_authenticated)

    def dataReceived(self, data: bytes) -> None:
        """A client may send nothing between its handshake and the answer (RFC 6455 section 4.1)."""
        if self._handshaking:
            # Autobahn would read the bytes as another handshake, and open a second session here.
            self._drop("it sent more before its handshake was answered")
            return
        if self._open and self._handler is None:
            # Pings and empty frames count too: the client is not authenticated.
            self._unauthenticated_bytes += len(data)
            if self._unauthenticated_bytes > UNAUTHENTICATED_FRAME_BYTES:
                self.close(
                    close_codes.TOO_BIG,
                    f"more than {limits.UNAUTHENTICATED_BYTES} bytes before the session began",
                )
                return
        try:
            super().dataReceived(data)
        except Exception:
            self.handling_failed()

    def handling_failed(self) -> None:
        """Close the websocket with a reason after an unexpected error, which is being handled."""
        if not self._open:
            super().handling_failed()
            return
        self.relay_log.failure("bytes of a client could not be handled; its connection is closed")
        try:
            (self._handler or self).close(close_codes.INTERNAL, RELAY_FAILED)
        except Exception:
            super().handling_failed()

    def _drop(self, reason: str) -> None:
        self.relay_log.info(
            "a client at {address} is cut: {reason}", address=self._address(), reason=reason, limited="cut"
        )
        self._stop_deadline()
        self.dropConnection(abort=True)

    def _fail_connection(self, code: int = close_codes.GOING_AWAY, reason: str = "") -> None:
        """End the connection because of what the client sent. One limit for all clients bounds the log lines."""
        self.relay_log.info(
            "a client at {address} is cut: {reason}",
            address=self._address(),
            reason=reason,
            limited=f"failed {code}",
        )
        if not self._open:
            super()._fail_connection(code, reason)
            return
        self.failedByMe = True
        if self._handler is not None:
            self._handler.close(code, reason)
        else:
            self._close(code, reason)

    def onConnect(self, request: ConnectionRequest) -> Deferred[str | None]:
        """Authenticate the client before the handshake is answered."""
        self._handshaking = True
        self.transport.pauseProducing()
        return Deferred.fromCoroutine(self._connect(request)).addBoth(self._resume_reading)

    def _resume_reading(self, answer: T) -> T:
        if self.state != self.STATE_CLOSED:
            self.transport.resumeProducing()
        return answer

    async def _connect(self, request: ConnectionRequest) -> str | None:
        foxglove = foxglove_subprotocol(request.protocols) if self.has_dialects else None
        self._foxglove = foxglove is not None
        try:
            if self.factory.forwarding is not None and self._forwarded is None:
                self._handshake = ForwardedHandshake.of(request, self.http_request_uri)
            purpose = self._purpose_of(request)
            self._robot = purpose.robot
            if self._foxglove:
                self._options = stream_options(request.params)
            if not self.factory.sessions.accepting:
                raise Unavailable("the relay is going down; connect again in a moment")
            if self._slot is None:
                raise Unavailable("too many clients connect at the same time; try again in a moment")
            looked_up = self._look_up(request, purpose)
            # The limit for the whole handshake would drop the connection without an answer.
            if await with_timeout(self.factory.clock, LOOKUP_SECONDS, looked_up, NOT_LOOKED_UP):
                await self._open_elsewhere()
            elif self._foxglove:
                raise BadCredentials(NO_CREDENTIALS)
        except SwitchboardError as error:
            self._failure = error
        if self.state == self.STATE_CLOSED:
            self._release()
            raise ConnectionDeny(HANDSHAKE_STATUS[close_codes.UNAVAILABLE], "the client has left")
        if self._failure is not None and (not request.origin or isinstance(self._failure, REFUSED_AT_ONCE)):
            # Programs read the status. Browsers can't, so they get a close code after the handshake, unless there are
            # too many handshakes.
            reason = str(self._failure)
            self._log_refused(reason, self._failure.code)
            raise ConnectionDeny(status_of(self._failure), reason)
        return foxglove or subprotocol(request.protocols)

    async def _look_up(self, request: ConnectionRequest, purpose: TicketPurpose) -> bool:
        """Authenticate and authorize the client.

        :returns: false: the handshake has no credentials
        """
        principal = await self._identify(request, purpose)
        if principal is None:
            return False
        self._admission = await self._admit(principal)
        return True

    async def _identify(self, request: ConnectionRequest, purpose: TicketPurpose) -> Principal | None:
        """Authenticate the client, and count the handshake as a request of its user.

        Until then it counts for the client's network, so a flood of false credentials does not reach the database.

        :raises TooManyRequests: the user, or the network, has sent too many
        """
        if self._forwarded is not None:
            return self._forwarded.principal
        count_for_user = self.factory.request_limits.handshake(self._address())
        principal = await identify(self.factory.auth, request, purpose, self._address())
        if principal is not None:
            count_for_user(principal.user_id)
        return principal

    def _purpose_of(self, request: ConnectionRequest) -> TicketPurpose:
        """The robot, and perhaps the camera, that a handshake requests.

        :raises SwitchboardError: a parameter is wrong
        """
        return TicketPurpose(unquote(request.path.removeprefix("/robots/").removesuffix("/")))

    async def _admit(self, principal: Principal) -> Admission:
        """Authorize the client.

        :raises SwitchboardError: it may not connect, with the reason
        """
        if self._lost:
            # The connection was lost during authentication; a stream counted now would never be released.
            raise Unavailable("the client has left")
        self.unfinished = self.factory.request_limits.unfinished.count(principal.user_id)
        if self.is_stream:
            self._end_stream = self.factory.request_limits.stream(principal.user_id)
        admission = await self.factory.sessions.admit(principal, self._robot, self._address())
        if self._forwarded is not None and admission.robot.elsewhere:
            # The relay that forwards it does not know yet. Nothing would end the session here later.
            self.factory.sessions.release(admission)
            raise Unavailable(f"robot {self._robot} has connected to another relay; connect again")
        return admission

    def _open_handler(self, admission: Admission) -> WebSocketHandler:
        """Begin what this websocket carries; the client is authenticated."""
        if self._foxglove:
            sessions = cast(DialectSessions, self.factory.sessions)
            self._binary_handler = sessions.open_foxglove(admission, self, self._opened_ns, self._options)
            return self._binary_handler
        return self.factory.sessions.open(admission, self, self._opened_ns)

    def onOpen(self) -> None:
        """The handshake is done."""
        self._handshaking = False
        if self.data:
            self._drop("it sent more before its handshake was answered")
            return
        self._open = True
        self._opened_ns = self.factory.clock_ns()
        if self._forwarded is not None and self._forwarded.early:
            # Its first messages are of unknown age until it has answered a ping.
            self._opened_ns -= EARLY_NS
        self.handshake_done()
        if self._failure is not None:
            self.close(code_of(self._failure), str(self._failure))
        elif self._admission is not None:
            self._begin_session()

    def _not_authenticated(self) -> None:
        self._deadline = None
        if self._open and self._authenticating:
            # The message came shortly before the deadline.
            self.close(close_codes.UNAVAILABLE, NOT_LOOKED_UP)
        elif self._open:
            self.close(
                close_codes.UNAUTHENTICATED,
                f"{NO_CREDENTIALS}, nor an auth message",
            )
        else:
            self._drop(f"no handshake within {limits.UNAUTHENTICATED_SECONDS:g} s")

    def _begin_session(self) -> None:
        assert self._admission is not None
        admission, self._admission = self._admission, None
        self._stop_deadline()
        self._release_slot()
        self.limit_message_size(
            self.factory.largest_message if self.message_limit is None else self.message_limit
        )
        forwarded, self._elsewhere = self._elsewhere, None
        if forwarded is not None:
            self.factory.sessions.release(admission)
            self._binary_handler = forwarded
            if self.has_dialects and forwarded.confirms:
                # Given as the client named it; the client may have left when it is called.
                stop = partial(self._stop_here, admission.permit.principal, self._robot, self._address())
                stops = ForwardedStops(forwarded, admission.robot.name, self._foxglove, stop)
                forwarded.on_message = stops.message
        handler = self._handler = forwarded or self._open_handler(admission)
        # The session writes past Autobahn, without a check of its state; see stop_sending.
        handler.send_queue.write = self._writer.write
        if forwarded is None:
            # A forwarded one is paced by the robot's home.
            self._pace(handler)
        handler.start()
        self.on_text = handler.message
        early, self._early = self._early, []
        for message in early:
            handler.message(message)

    async def _stop_here(
        self, principal: Principal, robot: str, address: str, why: str, stop_id: str
    ) -> StopResult:
        """Stop a robot of another relay by way of this one."""
        return await self.factory.stop(principal, robot, why, address, stop_id)

    async def _open_elsewhere(self, *, early: bool = False) -> None:
        """Connect to the robot's home if that is another relay.

        :param early: whether the client may have sent messages already
        :raises Unavailable: that relay can't be reached, or refuses
        """
        forwarding, handshake, self._handshake = self.factory.forwarding, self._handshake, None
        if forwarding is None or handshake is None or self._admission is None:
            return
        relay = forwarding.homes.elsewhere(self._admission.robot.robot_id)
        if relay is None:
            return
        client = ForwardedClient.of(self._admission.permit.principal, self._address(), early=early)
        self._elsewhere = ForwardedWebSocket(
            self.factory.clock,
            forwarding.forwarder,
            relay,
            self._admission.robot.robot_id,
            handshake,
            client,
            self,
            self.factory.clock_ns(),
        )
        try:
            await self._elsewhere.open()
        except BaseException:
            self._elsewhere = None
            self._release()
            raise

    def _pace(self, handler: WebSocketHandler) -> None:
        """Keep few bytes in flight to the client, so that pings and small messages arrive soon."""
        tcp = tcp_of(self.transport)
        if tcp is not None:
            keep_little(tcp, UNSENT_BYTES)
        clock, seconds = self.factory.clock, self.factory.flushes.stalls.seconds
        self._pacer = Pacer(
            self._writer, handler.send_queue, clock, seconds, handler.ping, websocket_frames.Fragments, tcp
        )

    def _failed(self, failure: Any) -> None:
        error = failure.value
        if isinstance(error, SwitchboardError):
            self.close(code_of(error), str(error))
        else:
            self.relay_log.failure("a client's session could not be opened", failure)
            self.close(close_codes.INTERNAL, RELAY_FAILED)

    def _address(self) -> str:
        if self._forwarded is not None:
            return self._forwarded.address
        return getattr(self.transport.getPeer(), "host", "")

    # --- messages -----------------------------------------------------------------------------------------

    def onMessageBegin(self, isBinary: bool) -> None:
        """The first frame of a message. Later pongs, before its last frame, do not date it."""
        super().onMessageBegin(isBinary)
        self._begun_earliest_sent = self._opened_ns if self._handler is None else self._handler.earliest_sent

    def onMessage(self, payload: bytes, isBinary: bool) -> None:
        """A message that does not go to :attr:`on_text`, as most do.

        These are messages before the session has begun, binary ones, and those that Autobahn reads: in several frames,
        or in a frame that is not read fast.
        """
        if isBinary and self._binary_handler is not None:
            self._binary_handler.binary_message(payload, earliest_sent=self._begun_earliest_sent)
        elif isBinary:
            (self._handler or self).close(
                close_codes.FORBIDDEN, "binary messages are not taken; send rosbridge JSON as text"
            )
        elif self._handler is not None:
            self._handler.message(payload, earliest_sent=self._begun_earliest_sent)
        elif self._open:
            self._message_early(payload)

    def _message_early(self, payload: bytes) -> None:
        self._early_bytes += len(payload) + EARLY_OVERHEAD
        if self._early_bytes > limits.UNAUTHENTICATED_BYTES:
            self.close(
                close_codes.TOO_BIG,
                f"more than {limits.UNAUTHENTICATED_BYTES} bytes before the session began",
            )
        elif self._authenticating:
            self._early.append(payload)
        else:
            self._authenticate(payload)

    def _authenticate(self, payload: bytes) -> None:
        try:
            message = rosbridge.decode(payload)
        except (PeerError, NotFinite) as error:
            self.close(close_codes.UNAUTHENTICATED, f"log in first: {error}")
            return
        if not isinstance(message, rosbridge.Auth):
            self.close(
                close_codes.UNAUTHENTICATED, "log in first: send op 'auth' with the access token in 'mac'"
            )
            return
        self._authenticating = True
        Deferred.fromCoroutine(self._open_by_token(message.mac)).addErrback(self._failed)

    async def _open_by_token(self, token: str) -> None:
        looked_up = self._look_up_token(token)
        await with_timeout(self.factory.clock, LOOKUP_SECONDS, looked_up, NOT_LOOKED_UP)
        await self._open_elsewhere(early=True)
        if self._open:
            self._begin_session()
        else:
            self._release()

    async def _look_up_token(self, token: str) -> None:
        principal = await self.factory.auth.bearer(token)
        self._admission = await self._admit(principal)

    def _release(self) -> None:
        admission, self._admission = self._admission, None
        if admission is not None:
            self.factory.sessions.release(admission)
        elsewhere, self._elsewhere = self._elsewhere, None
        if elsewhere is not None:
            elsewhere.end()

    def onPing(self, payload: bytes) -> None:
        """Answer a ping; a forwarded client's goes to the home, as an answer here could divide a frame of the home."""
        if isinstance(self._handler, ForwardedWebSocket):
            self._handler.client_ping(payload)
        else:
            super().onPing(payload)

    def onPong(self, payload: bytes) -> None:
        """The answer to a ping. Autobahn also passes on one that has just failed the connection."""
        if self.failedByMe:
            return
        if self._pacer is not None:
            self._pacer.probe_answered(bytes(payload))
        if self._handler is not None:
            self._handler.pong(payload)

    def connectionLost(self, reason: Any = connectionDone) -> None:
        """The connection that began as an HTTP request is gone."""
        self._lost = True
        if self._forwarded is None:
            # The listener of the cluster counts no connections.
            self.factory.connection_limits.leave(self._address())
        self._end_stream()
        self._release_slot()
        self._stop_deadline()
        super().connectionLost(reason)

    def onClose(self, wasClean: bool, code: int | None, reason: str | None) -> None:
        """The websocket is gone."""
        self._open = False
        self._stop_deadline()
        self._early.clear()
        self._release()
        handler, self._handler = self._handler, None
        self._binary_handler = None
        self.on_text = None
        self.stop_sending()
        self._pacer = None
        if handler is not None:
            handler.end(orderly=wasClean and not self.closedByMe)

    def stop_sending(self) -> None:
        """The session can send nothing more, and none can begin."""
        self._open = False
        self._stop_deadline()
        if self._pacer is not None:
            self._pacer.stop()
        if self._handler is not None:
            self._handler.send_queue.close()

    # --- ClientTransport ----------------------------------------------------------------------------------

    def send(self, frames: bytes) -> None:
        """Send whole frames. They are dropped if the client has begun to close."""
        if self.state == self.STATE_OPEN:
            self._writer.write(frames)

    def ping(self, payload: bytes) -> None:
        """Send a ping, ahead of everything that waits here, also between the frames of a message."""
        if self.state == self.STATE_OPEN:
            if self._pacer is not None:
                self._pacer.probe_sent(payload)
            self._writer.write_beyond_budget(websocket_frames.ping(payload))

    def close(self, code: int, reason: str, farewell: bytes | None = None) -> None:
        """Close with a code. The client has 2 s to answer, a slow one 20 s, then the connection is dropped.

        :param farewell: see :class:`~relay_server.sessions.ports.ClientTransport`
        """
        self._stop_deadline()
        if self._open:
            if self._handler is None:
                self._log_refused(reason, code)
            self._close(code, reason, farewell)

    def _close(self, code: int, reason: str, farewell: bytes | None = None) -> None:
        self._open = False
        if farewell is None and self._foxglove:
            farewell = messages.closing(reason)
        if farewell:
            self._send_farewell(farewell)
        self.send_close(code, reason)

    def _send_farewell(self, frames: bytes) -> None:
        """Send a last message, ahead of all that waits (SPEC 1.4-2).

        A message that is being sent in pieces is completed before, if that takes no longer than the window allows.
        Otherwise the close frame, which may go between the pieces, would come too late.
        """
        if self._pacer is not None:
            pieces = self._pacer.stop()
            if isinstance(pieces, websocket_frames.Fragments) and pieces.begun:
                if pieces.begun > self._pacer.window.size:
                    return
                self._writer.write_beyond_budget(pieces.take(pieces.begun))
        self._writer.write_beyond_budget(frames)

    def _log_refused(self, reason: str, kind: str | int) -> None:
        self.relay_log.info(
            "a client at {address} is refused: {reason}",
            address=self._address(),
            reason=reason,
            limited=kind,
        )

    def pause(self) -> None:
        """The transport's buffer is full."""
        super().pause()
        if self._handler is not None:
            self._handler.pause()

    def resume(self) -> None:
        """The transport takes bytes again."""
        super().resume()
        if self._handler is not None:
            self._handler.resume()
        if self._pacer is not None:
            self._pacer.continue_sending()

    def _release_slot(self) -> None:
        slot, self._slot = self._slot, None
        if slot is not None:
            slot.release()

    def _stop_deadline(self) -> None:
        cancel(self._deadline)
        self._deadline = None


class ClientFactory(WebSocketServerFactory):
    """Builds a :class:`ClientConnection` for each websocket, with strict options of Autobahn.

    :param connection_limits: the site has counted connections there before they become websockets
    :param request_limits: handshakes count as requests
    :param largest_message: most bytes of a message once the session has begun
    """

    protocol = ClientConnection
    forwarding: RequestForwarding | None = None
    """``None``: this is the only relay."""
    stop: Callable[..., Coroutine[Any, Any, StopResult]]
    """See :meth:`~relay_server.control.gateway.ControlGateway.stop`."""
    takes_forwarded = True
    """Whether other relays may forward clients."""
    forwarded_client: ForwardedClient | None = None
    """The client of the request that a protocol is built for, if another relay has forwarded it."""

    def __init__(
        self,
        clock: Clock,
        clock_ns: Callable[[], int],
        auth: HandshakeAuth,
        sessions: HandshakeSessions,
        connection_limits: ConnectionLimits,
        request_limits: RequestLimits,
        largest_message: int = limits.CLIENT_MESSAGE,
    ) -> None:
        super().__init__(reactor=clock)
        self.largest_message = largest_message
        self.connection_limits = connection_limits
        self.request_limits = request_limits
        self.clock = clock
        self.clock_ns = clock_ns
        self.auth = auth
        self.sessions = sessions
        self.flushes = FlushScheduler(clock)
        self.traffic = TrafficStats()
        self.setProtocolOptions(
            webStatus=False,
            # Text that is not UTF-8 fails the connection with 1007 (RFC 6455 section 8.1).
            utf8validateIncoming=True,
            requireMaskedClientFrames=True,
            failByDrop=False,
            # ClientConnection has its own deadline, and limits of size that change when a session begins.
            openHandshakeTimeout=0,
            # Over a thin connection the close frame needs some of this.
            closeHandshakeTimeout=2,
            tcpNoDelay=True,
            # Pings are sent by the session: they also bound the age of commands.
            autoPingInterval=0,
            # The Origin matters where a cookie is the credential, and is checked there (HandshakeAuth.cookie).
            allowedOrigins=["*"],
            allowNullOrigin=True,
            maxConnections=0,
        )
        # Autobahn copies options into each connection unless its class has them; so a class of its own has them here.
        options = {name: getattr(self, name) for name in self.protocol.CONFIG_ATTRS}
        known = {name: staticmethod(each) if callable(each) else each for name, each in options.items()}
        self.protocol = cast(type[ClientConnection], type(self.protocol.__name__, (self.protocol,), known))
