"""Authentication of websockets: credentials in the handshake, and the answers to those that are refused."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Protocol

from autobahn.twisted.resource import WebSocketResource
from autobahn.websocket.types import ConnectionRequest
from twisted.web.server import Request

from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_server.access import BadCredentials, Principal
from relay_server.auth.authenticator import TicketPurpose, TooManyTries
from relay_server.common import close_codes
from relay_server.common.send_queue import SendQueue
from relay_server.foxglove.messages import SUBPROTOCOLS as FOXGLOVE_SUBPROTOCOLS
from relay_server.foxglove.options import StreamOptions
from relay_server.http.limits import TooManyRequests, TooManyStreams
from relay_server.http.problems import problem
from relay_server.sessions.manager import Admission, ShuttingDown
from relay_server.sessions.ports import ClientTransport
from relay_server.video.errors import EncoderUnavailable

HANDSHAKE_STATUS = {
    close_codes.INVALID: 400,
    close_codes.UNAUTHENTICATED: 401,
    close_codes.NOT_FOUND: 403,
    close_codes.TOO_MANY_ERRORS: 429,
    close_codes.UNAVAILABLE: 503,
    close_codes.GOING_AWAY: 503,
}
"""The HTTP status of a handshake that would close with this code."""


class WebSocketHandler(Protocol):
    """Handles the messages of one authenticated websocket.

    It is a :class:`~relay_server.sessions.rosbridge_port.RosbridgePort`, a :class:`BinaryHandler`, a viewer of a
    camera (:mod:`relay_server.video.websocket`), or a page with live updates (:mod:`relay_server.ws.updates`).
    """

    send_queue: SendQueue
    """The websocket sets its ``write``."""

    @property
    def earliest_sent(self) -> int:
        """Earliest time at which a message that comes now can have been sent; monotonic nanoseconds.

        See :class:`relay_server.sessions.message_age.MessageAge`.
        """

    def start(self) -> None:
        """The websocket is open."""

    def message(self, payload: bytes, *, earliest_sent: int | None = None) -> None:
        """One text message.

        :param earliest_sent: what :attr:`earliest_sent` was when its first frame came
        """

    def ping(self) -> None:
        """Send a ping now; its answer shows how fast the connection is."""

    def pong(self, payload: bytes) -> None:
        """The answer to a ping."""

    def pause(self) -> None:
        """The transport's buffer is full."""

    def resume(self) -> None:
        """The transport takes bytes again."""

    def close(self, code: int, reason: str) -> None:
        """Close the websocket with a code, and end."""

    def end(self, *, orderly: bool = False) -> None:
        """The websocket is closed, or is being closed.

        :param orderly: the client has closed it
        """


class BinaryHandler(WebSocketHandler, Protocol):
    """Handles binary messages, too: a :class:`~relay_server.foxglove.port.FoxglovePort`."""

    def binary_message(self, payload: bytes, *, earliest_sent: int) -> None:
        """One binary message.

        :param earliest_sent: what :attr:`earliest_sent` was when its first frame came
        """


class HandshakeAuth(Protocol):
    """Authenticates clients of websockets; see :class:`relay_server.auth.service.AuthService`."""

    async def bearer(self, token: str) -> Principal:
        """The principal of an access token."""

    async def ticket(self, ticket: str, purpose: TicketPurpose) -> Principal:
        """The principal of a single-use ticket."""

    async def url_token(self, token: str, address: str) -> Principal:
        """The principal of a token in the URL of a Foxglove websocket."""

    async def cookie(self, header: str, origin: str | None, host: str) -> Principal | None:
        """The principal of a session cookie; ``None``: there is no such cookie."""


class HandshakeSessions(Protocol):
    """Authorizes clients of websockets, and opens their sessions.

    For robots it is the :class:`~relay_server.sessions.manager.SessionManager`.
    """

    accepting: bool
    """False while the relay shuts down."""

    async def admit(self, principal: Principal, robot: str, address: str) -> Admission:
        """Authorize a principal that has any right on the robot.

        :raises NotFound: it has none, or there is no such robot
        """

    def open(self, admission: Admission, transport: ClientTransport, opened_ns: int) -> WebSocketHandler:
        """Begin an authorized session."""

    def release(self, admission: Admission) -> None:
        """The client left before its authorized session began."""


class DialectSessions(HandshakeSessions, Protocol):
    """Also opens sessions of clients that speak the Foxglove protocol."""

    def open_foxglove(
        self, admission: Admission, transport: ClientTransport, opened_ns: int, options: StreamOptions
    ) -> BinaryHandler:
        """Begin an authorized session."""


def foxglove_subprotocol(protocols: Collection[str]) -> str | None:
    """The Foxglove subprotocol to select of those that a client offers; ``None``: it offers none."""
    return next((each for each in FOXGLOVE_SUBPROTOCOLS if each in protocols), None)


def subprotocol(protocols: Collection[str]) -> str | None:
    """The subprotocol to select of those that a client of rosbridge offers."""
    bearer = _bearer(protocols)
    return bearer or next((each for each in protocols if each.startswith("rosbridge")), None)


def _bearer(protocols: Collection[str]) -> str | None:
    return next((each for each in protocols if each.startswith("bearer.")), None)


async def identify(
    auth: HandshakeAuth, request: ConnectionRequest, purpose: TicketPurpose, address: str
) -> Principal | None:
    """The principal, if the handshake has credentials.

    :param purpose: what a ticket must be for
    :param address: of the client
    :raises SwitchboardError: the credentials are wrong, or can't be checked
    """
    scheme, _, token = request.headers.get("authorization", "").partition(" ")
    bearer = _bearer(request.protocols)
    ticket, token_in_url = request.params.get("ticket"), request.params.get("token")
    if scheme.lower() == "bearer" and token:
        return await auth.bearer(token.strip())
    if bearer is not None:
        return await auth.bearer(bearer.removeprefix("bearer."))
    if ticket:
        return await auth.ticket(ticket[0], purpose)
    if token_in_url:
        if foxglove_subprotocol(request.protocols) is None or purpose.video:
            raise BadCredentials(
                "a token in the URL opens only websockets of Foxglove: offer the subprotocol "
                f"{FOXGLOVE_SUBPROTOCOLS[0]}, or send an access token in the Authorization header"
            )
        return await auth.url_token(token_in_url[0], address)
    headers = request.headers
    origin = request.origin or None
    return await auth.cookie(headers.get("cookie", ""), origin, headers.get("host", ""))


def code_of(error: SwitchboardError) -> int:
    """The close code for an error."""
    if isinstance(error, Invalid):
        return close_codes.INVALID
    if isinstance(error, BadCredentials):
        return close_codes.UNAUTHENTICATED
    if isinstance(error, (TooManyRequests, TooManyStreams, TooManyTries)):
        return close_codes.TOO_MANY_ERRORS
    if isinstance(error, NotFound):
        return close_codes.NOT_FOUND
    if isinstance(error, ShuttingDown):
        return close_codes.GOING_AWAY
    if isinstance(error, EncoderUnavailable):
        return close_codes.NOT_MADE
    if isinstance(error, Unavailable):
        return close_codes.UNAVAILABLE
    return close_codes.FORBIDDEN


def status_of(error: SwitchboardError) -> int:
    """The HTTP status of a handshake that is refused with an error."""
    return HANDSHAKE_STATUS.get(code_of(error), 403)


READ = frozenset(
    {
        b"authorization",
        b"connection",
        b"cookie",
        b"host",
        b"origin",
        b"sec-websocket-extensions",
        b"sec-websocket-key",
        b"sec-websocket-protocol",
        b"sec-websocket-version",
        b"upgrade",
    }
)
"""Header fields that Autobahn or the relay reads in a handshake."""


class WebSocketUpgrade(WebSocketResource):
    """Gives Autobahn only the header fields that are read, in ASCII.

    Autobahn splits the header by ``str.splitlines``, for which more characters end a line than for HTTP (0x85, which
    many letters have in UTF-8). So a value could become a field of its own.
    """

    def render(self, request: Request) -> Any:
        """Pass the connection to Autobahn."""
        headers = request.requestHeaders
        if request.forwarded_client is not None and not self._factory.takes_forwarded:
            return problem(request, 404, "This websocket is not forwarded; connect to the relay itself.")
        for name, values in list(headers.getAllRawHeaders()):
            if name.lower() in READ:
                ascii_only = [each.decode("ascii", "replace").encode("ascii", "replace") for each in values]
                headers.setRawHeaders(name, ascii_only)
            else:
                headers.removeHeader(name)
        # Not in a header: Autobahn could read one out of what the client wrote.
        self._factory.forwarded_client = request.forwarded_client
        try:
            return super().render(request)
        finally:
            self._factory.forwarded_client = None
