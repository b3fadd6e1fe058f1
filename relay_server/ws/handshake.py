"""Who may come in by websocket: by what credentials of the handshake, and what is said to whom may not."""

from __future__ import annotations

from typing import Protocol

from autobahn.websocket.types import ConnectionRequest

from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_server.access import BadCredentials, Principal
from relay_server.auth.authenticator import TicketPurpose
from relay_server.common import close_codes
from relay_server.common.send_queue import SendQueue
from relay_server.http.rate_limits import TooManyRequests, TooManyStreams
from relay_server.sessions.manager import AuthorizedSession, ShuttingDown
from relay_server.sessions.ports import ClientTransport
from relay_server.video.ports import EncoderUnavailable

HANDSHAKE_STATUS = {
    close_codes.INVALID: 400,
    close_codes.UNAUTHENTICATED: 401,
    close_codes.NOT_FOUND: 403,
    close_codes.TOO_MANY_ERRORS: 429,
    close_codes.UNAVAILABLE: 503,
    close_codes.GOING_AWAY: 503,
}
"""The HTTP status of a handshake that would close with this code."""


class WebSocketSession(Protocol):
    """What goes on over a websocket once somebody is in: a session, or pictures of a camera."""

    outbox: SendQueue
    """Its ``write`` is set by the websocket."""

    @property
    def not_before(self) -> int:
        """What comes now was not sent before this; monotonic nanoseconds."""

    def start(self) -> None:
        """The client is in."""

    def message(self, payload: bytes, *, since: int | None = None) -> None:
        """One text message.

        :param since: what :attr:`not_before` was when its first frame came
        """

    def ping(self) -> None:
        """Send a ping now, by which what was sent is measured."""

    def pong(self, payload: bytes) -> None:
        """The answer to a ping."""

    def pause(self) -> None:
        """The transport's buffer is full."""

    def resume(self) -> None:
        """The transport takes bytes again."""

    def close(self, code: int, reason: str) -> None:
        """Close the websocket with a code, and end."""

    def end(self, *, orderly: bool = False) -> None:
        """The websocket is gone, or goes.

        :param orderly: the client has closed it
        """


class HandshakeAuth(Protocol):
    """Who may come in; the composition root's."""

    accepting: bool

    async def bearer(self, token: str) -> Principal:
        """The principal of an access token."""

    async def ticket(self, ticket: str, asked: TicketPurpose) -> Principal:
        """The principal of a single-use ticket."""

    async def cookie(self, header: str, origin: str | None, host: str) -> Principal | None:
        """The principal of a session cookie, ``None`` when there is no such cookie."""

    async def admit(self, principal: Principal, robot: str, address: str) -> AuthorizedSession:
        """Find out whether the principal has any right on the robot.

        :raises NotFound: it has none, or there is no such robot
        """

    def open(
        self, admission: AuthorizedSession, transport: ClientTransport, opened_ns: int
    ) -> WebSocketSession:
        """Begin a session that was admitted."""

    def turn_away(self, admission: AuthorizedSession) -> None:
        """Somebody who was admitted left before a session began."""


async def identify(
    gate: HandshakeAuth, request: ConnectionRequest, asked: TicketPurpose
) -> tuple[Principal | None, str | None]:
    """The principal, if the handshake names one, and the subprotocol to answer with.

    :param asked: what a ticket would have to be for
    :raises SwitchboardError: what it names proves nobody, or can't be checked
    """
    scheme, _, token = request.headers.get("authorization", "").partition(" ")
    bearer = next((each for each in request.protocols if each.startswith("bearer.")), None)
    ticket = request.params.get("ticket")
    chosen = bearer or next((each for each in request.protocols if each.startswith("rosbridge")), None)
    if scheme.lower() == "bearer" and token:
        return await gate.bearer(token.strip()), chosen
    if bearer is not None:
        return await gate.bearer(bearer.removeprefix("bearer.")), chosen
    if ticket:
        return await gate.ticket(ticket[0], asked), chosen
    headers = request.headers
    origin = request.origin or None
    return await gate.cookie(headers.get("cookie", ""), origin, headers.get("host", "")), chosen


def code_of(error: SwitchboardError) -> int:
    """The code a websocket closes with for this reason."""
    if isinstance(error, Invalid):
        return close_codes.INVALID
    if isinstance(error, BadCredentials):
        return close_codes.UNAUTHENTICATED
    if isinstance(error, (TooManyRequests, TooManyStreams)):
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
    """The HTTP status of a handshake that is refused for this reason."""
    return HANDSHAKE_STATUS.get(code_of(error), 403)
