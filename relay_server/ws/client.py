"""The edge towards clients: one websocket is one client on one robot (``/robots/<robot>``).

This module finds out who is there and hands whole messages to a session. A client proves itself in the handshake
(Bearer header, ``bearer.`` subprotocol, ticket, or cookie with a listed Origin) or by a rosbridge ``auth`` as its first
message.
"""

from __future__ import annotations

from collections.abc import Callable
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
from relay_server.access import Principal
from relay_server.auth.authenticator import TicketPurpose
from relay_server.common import close_codes, websocket_frames
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.pacing import Pacer
from relay_server.common.socket_writer import FlushScheduler
from relay_server.common.tcp import tcp_of
from relay_server.http.connection_limits import ConnectionLimits, Slot
from relay_server.http.rate_limits import RequestLimits, TooManyRequests
from relay_server.sessions.manager import AuthorizedSession
from relay_server.ws.bounded import BoundedProtocol
from relay_server.ws.handshake import (
    HANDSHAKE_STATUS,
    HandshakeAuth,
    WebSocketSession,
    code_of,
    identify,
    status_of,
)

T = TypeVar("T")

UNPROVED_BYTES = limits.UNPROVEN_BYTES + 1024
"""Bytes before the session began, with the heads of frames."""

EARLY_OVERHEAD = 64
"""What a message before the proof counts for beside its bytes; empty ones take memory too."""


class ClientProtocol(BoundedProtocol):
    """One client's websocket."""

    relay_log = Logger()
    """Autobahn warns in ``log``, which is limited as a library's (:mod:`relay_server.logs`)."""
    factory: ClientFactory
    vouches = True
    takes: int | None = None
    """Bytes a message may have once a session has begun; ``None`` for as many as the relay is set to."""

    is_stream = False
    """Whether it counts as one of its user's streams."""

    def __init__(self) -> None:
        super().__init__()
        self._robot = ""
        self._admission: AuthorizedSession | None = None
        self._failure: SwitchboardError | None = None
        self._session: WebSocketSession | None = None
        self._proving = False
        self._early: list[bytes] = []
        self._early_bytes = 0
        self._unproved_bytes = 0
        self._deadline: Timer | None = None
        self._place: Slot | None = None
        self._lost = False
        self._end_stream: Callable[[], None] = lambda: None
        self._asking = False
        self._open = False
        self._opened_ns = 0
        self._begun_ns = 0
        self._pacer: Pacer | None = None

    # --- handshake ----------------------------------------------------------------------------------------

    def connectionMade(self) -> None:
        """The site has handed over a connection that asked to become a websocket."""
        super().connectionMade()
        self.take_at_most(limits.UNPROVEN_BYTES)
        self._place = self.factory.cap.stranger()
        # One for handshake and auth together; a session ends it.
        self._deadline = self.factory.clock.callLater(limits.UNPROVEN_SECONDS, self._nobody)

    def dataReceived(self, data: bytes) -> None:
        """Bytes. Who asked to come in says nothing more before the answer (RFC 6455 section 4.1)."""
        if self._asking:
            # Autobahn would take them for a handshake of their own, and open a second session here.
            self._drop("it sent more before its handshake was answered")
            return
        if self._open and self._session is None:
            # Pings and empty frames, too, are bytes of a client that has proved nothing.
            self._unproved_bytes += len(data)
            if self._unproved_bytes > UNPROVED_BYTES:
                self.close(
                    close_codes.TOO_BIG, f"more than {limits.UNPROVEN_BYTES} bytes before the session began"
                )
                return
        super().dataReceived(data)

    def _drop(self, reason: str) -> None:
        self.relay_log.info(
            "a client at {address} is cut: {reason}", address=self._address(), reason=reason, limited="cut"
        )
        self._stop_deadline()
        self.dropConnection(abort=True)

    def _fail_connection(self, code: int = close_codes.GOING_AWAY, reason: str = "") -> None:
        """Autobahn ends the connection for what the client sent, and warns; those lines are few for all clients."""
        self.relay_log.info(
            "a client at {address} is cut: {reason}",
            address=self._address(),
            reason=reason,
            limited=f"failed {code}",
        )
        super()._fail_connection(code, reason)

    def onConnect(self, request: ConnectionRequest) -> Deferred[str | None]:
        """Find out who it is before the handshake is answered."""
        self._asking = True
        self.transport.pauseProducing()
        return Deferred.fromCoroutine(self._connect(request)).addBoth(self._asked)

    def _asked(self, answer: T) -> T:
        if self.state != self.STATE_CLOSED:
            self.transport.resumeProducing()
        return answer

    async def _connect(self, request: ConnectionRequest) -> str | None:
        chosen = None
        try:
            asked = self._asked_for(request)
            self._robot = asked.robot
            if not self.factory.gate.accepting:
                raise Unavailable("the relay is going down; connect again in a moment")
            if self._place is None:
                raise Unavailable("too many clients connect at the same time; try again in a moment")
            principal, chosen = await self._identify(request, asked)
            if principal is not None:
                self._admission = await self._admit(principal)
        except SwitchboardError as error:
            self._failure = error
        if self.state == self.STATE_CLOSED:
            self._turn_away()
            raise ConnectionDeny(HANDSHAKE_STATUS[close_codes.UNAVAILABLE], "the client has left")
        if self._failure is not None and (not request.origin or isinstance(self._failure, TooManyRequests)):
            # Programs read the status; browsers can't, so they get a close code after the handshake, unless that is
            # what there are too many of.
            reason = str(self._failure)
            self._log_refused(reason, self._failure.code)
            raise ConnectionDeny(status_of(self._failure), reason)
        return chosen

    async def _identify(
        self, request: ConnectionRequest, asked: TicketPurpose
    ) -> tuple[Principal | None, str | None]:
        """Find out who asks, and count the handshake as a request of theirs.

        It counts for the network until then, so a flood of false credentials does not reach the database.

        :raises TooManyRequests: they have sent too many
        """
        known = self.factory.limits.handshake(self._address())
        principal, chosen = await identify(self.factory.gate, request, asked)
        if principal is not None:
            known(principal.user_id)
        return principal, chosen

    def _asked_for(self, request: ConnectionRequest) -> TicketPurpose:
        """What a handshake wants to open.

        :raises SwitchboardError: what it asks for makes no sense
        """
        return TicketPurpose(unquote(request.path.removeprefix("/robots/").removesuffix("/")))

    async def _admit(self, principal: Principal) -> AuthorizedSession:
        """Whether it may come in.

        :raises SwitchboardError: it may not
        """
        if self._lost:
            # It was looked up meanwhile. What is counted now nothing would count out.
            raise Unavailable("the client has left")
        if self.is_stream:
            self._end_stream = self.factory.limits.stream(principal.user_id)
        return await self.factory.gate.admit(principal, self._robot, self._address())

    def _occupant(self, admission: AuthorizedSession) -> WebSocketSession:
        """What begins now that it is in."""
        return self.factory.gate.open(admission, self, self._opened_ns)

    def onOpen(self) -> None:
        """The handshake is done."""
        self._asking = False
        if self.data:
            self._drop("it sent more before its handshake was answered")
            return
        self._open = True
        self._opened_ns = self.factory.clock_ns()
        self.begun()
        if self._failure is not None:
            self.close(code_of(self._failure), str(self._failure))
        elif self._admission is not None:
            self._begin()

    def _nobody(self) -> None:
        self._deadline = None
        if self._open:
            self.close(
                close_codes.UNAUTHENTICATED,
                "log in: no credentials came with the connection, nor an auth message",
            )
        else:
            self._drop(f"no handshake within {limits.UNPROVEN_SECONDS:g} s")

    def _begin(self) -> None:
        assert self._admission is not None
        admission, self._admission = self._admission, None
        self._stop_deadline()
        self._known()
        self.take_at_most(self.factory.largest_message if self.takes is None else self.takes)
        session = self._session = self._occupant(admission)
        # What the session sends goes to the socket without a look at the state; see nothing_more.
        session.outbox.write = self._writer.write
        self._pace(session)
        session.start()
        self.takes_text = session.message
        early, self._early = self._early, []
        for message in early:
            session.message(message)

    def _pace(self, session: WebSocketSession) -> None:
        """Keep little on its way to the client, so that pings and small messages wait for little."""
        tcp = tcp_of(self.transport)
        clock, seconds = self.factory.clock, self.factory.turns.stalls.seconds
        self._pacer = Pacer(
            self._writer, session.outbox, clock, seconds, session.ping, websocket_frames.Fragments, tcp
        )

    def _failed(self, failure: Any) -> None:
        error = failure.value
        if isinstance(error, SwitchboardError):
            self.close(code_of(error), str(error))
        else:
            self.relay_log.failure("a client's session could not be opened", failure)
            self.close(close_codes.INTERNAL, "the relay failed; its log tells more")

    def _address(self) -> str:
        return getattr(self.transport.getPeer(), "host", "")

    # --- messages -----------------------------------------------------------------------------------------

    def onMessageBegin(self, isBinary: bool) -> None:
        """The first frame of a message. Pongs may come before the last one, and say nothing of when this was sent."""
        super().onMessageBegin(isBinary)
        self._begun_ns = self._opened_ns if self._session is None else self._session.not_before

    def onMessage(self, payload: bytes, isBinary: bool) -> None:
        """One whole message."""
        if isBinary:
            (self._session or self).close(
                close_codes.FORBIDDEN, "binary messages are not taken; send rosbridge JSON as text"
            )
        elif self._session is not None:
            self._session.message(payload, since=self._begun_ns)
        elif self._open:
            self._message_early(payload)

    def _message_early(self, payload: bytes) -> None:
        self._early_bytes += len(payload) + EARLY_OVERHEAD
        if self._early_bytes > limits.UNPROVEN_BYTES:
            self.close(
                close_codes.TOO_BIG, f"more than {limits.UNPROVEN_BYTES} bytes before the session began"
            )
        elif self._proving:
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
        self._proving = True
        Deferred.fromCoroutine(self._authenticated(message.mac)).addErrback(self._failed)

    async def _authenticated(self, token: str) -> None:
        principal = await self.factory.gate.bearer(token)
        self._admission = await self._admit(principal)
        if self._open:
            self._begin()
        else:
            self._turn_away()

    def _turn_away(self) -> None:
        admission, self._admission = self._admission, None
        if admission is not None:
            self.factory.gate.turn_away(admission)

    def onPong(self, payload: bytes) -> None:
        """The answer to a ping."""
        if self._pacer is not None:
            self._pacer.answered(bytes(payload))
        if self._session is not None:
            self._session.pong(payload)

    def connectionLost(self, reason: Any = connectionDone) -> None:
        """The connection that began as an HTTP request is gone."""
        self._lost = True
        self.factory.cap.leave(self._address())
        self._end_stream()
        self._known()
        self._stop_deadline()
        super().connectionLost(reason)

    def onClose(self, wasClean: bool, code: int | None, reason: str | None) -> None:
        """The websocket is gone."""
        self._open = False
        self._stop_deadline()
        self._early.clear()
        self._turn_away()
        session, self._session = self._session, None
        self.takes_text = None
        self.nothing_more()
        self._pacer = None
        if session is not None:
            session.end(orderly=wasClean and not self.closedByMe)

    def nothing_more(self) -> None:
        """Hold off what the session sends, which goes to the writer without a look at the state. None begins now."""
        self._open = False
        self._stop_deadline()
        if self._pacer is not None:
            self._pacer.stop()
        if self._session is not None:
            self._session.outbox.close()

    # --- ClientTransport ----------------------------------------------------------------------------------

    def send(self, frames: bytes) -> None:
        """Whole frames. The peer may have begun to close: then nobody reads them."""
        if self.state == self.STATE_OPEN:
            self._writer.write(frames)

    def ping(self, payload: bytes) -> None:
        """A websocket ping. It goes ahead of everything that waits here, also between the frames of a message."""
        if self.state == self.STATE_OPEN:
            if self._pacer is not None:
                self._pacer.probing(payload)
            self._writer.urgent(websocket_frames.ping(payload))

    def close(self, code: int, reason: str) -> None:
        """Close with a code; the peer has a moment to answer, then the connection is dropped."""
        self._stop_deadline()
        if self._open:
            self._open = False
            if self._session is None:
                self._log_refused(reason, code)
            self.say_close(code, reason)

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
        if self._session is not None:
            self._session.pause()

    def resume(self) -> None:
        """The transport takes bytes again."""
        super().resume()
        if self._session is not None:
            self._session.resume()
        if self._pacer is not None:
            self._pacer.go_on()

    def _known(self) -> None:
        if self._place is not None:
            self._place.give_back()

    def _stop_deadline(self) -> None:
        cancel(self._deadline)
        self._deadline = None


class ClientFactory(WebSocketServerFactory):
    """Builds a :class:`ClientProtocol` for each websocket. Autobahn's open defaults are all closed here.

    :param cap: where the site has counted the connections that become websockets
    :param request_limits: handshakes count as requests
    :param largest_message: bytes a message may have once a session has begun
    """

    protocol = ClientProtocol

    def __init__(
        self,
        clock: Clock,
        clock_ns: Callable[[], int],
        gate: HandshakeAuth,
        cap: ConnectionLimits,
        request_limits: RequestLimits,
        largest_message: int = limits.CLIENT_MESSAGE,
    ) -> None:
        super().__init__(reactor=clock)
        self.largest_message = largest_message
        self.cap = cap
        self.limits = request_limits
        self.clock = clock
        self.clock_ns = clock_ns
        self.gate = gate
        self.turns = FlushScheduler(clock)
        self.traffic = TrafficStats()
        self.setProtocolOptions(
            webStatus=False,
            # Text that is not UTF-8 fails the connection with 1007 (RFC 6455 section 8.1).
            utf8validateIncoming=True,
            requireMaskedClientFrames=True,
            failByDrop=False,
            # The protocol's own deadline and limits of size, which change when a session begins.
            openHandshakeTimeout=0,
            # Over a thin connection the close frame needs some of this.
            closeHandshakeTimeout=2,
            tcpNoDelay=True,
            # Pings are the session's: they also tell how old a command can be.
            autoPingInterval=0,
            # The Origin matters where a cookie is the credential, and is checked there (Gate.cookie).
            allowedOrigins=["*"],
            allowNullOrigin=True,
            maxConnections=0,
        )
        # Autobahn copies into each connection what its class does not have: options are the class's here.
        options = {name: getattr(self, name) for name in self.protocol.CONFIG_ATTRS}
        known = {name: staticmethod(each) if callable(each) else each for name, each in options.items()}
        self.protocol = cast(type[ClientProtocol], type(self.protocol.__name__, (self.protocol,), known))
