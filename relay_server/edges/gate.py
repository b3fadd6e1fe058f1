"""Who may come in by websocket: by what credentials of the handshake, and what is said to whom may not."""

from __future__ import annotations

from typing import Protocol

from autobahn.websocket.types import ConnectionRequest

from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_server import closing
from relay_server.access import BadCredentials, Principal
from relay_server.auth import Opening
from relay_server.edges.limiting import TooManyRequests, TooManyStreams
from relay_server.frontdesk import Admission, GoingDown
from relay_server.outbox import Outbox
from relay_server.session import ClientTransport
from relay_server.video import NotMade

HANDSHAKE_STATUS = {
    closing.INVALID: 400,
    closing.UNAUTHENTICATED: 401,
    closing.NOT_FOUND: 403,
    closing.TOO_MANY_ERRORS: 429,
    closing.UNAVAILABLE: 503,
    closing.GOING_AWAY: 503,
}
"""The HTTP status of a handshake that would close with this code."""


class Occupant(Protocol):
    """What goes on over a websocket once somebody is in: a session, or pictures of a camera."""

    outbox: Outbox
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


class Gate(Protocol):
    """Who may come in; the composition root's."""

    accepting: bool

    async def bearer(self, token: str) -> Principal:
        """The principal of an access token."""

    async def ticket(self, ticket: str, asked: Opening) -> Principal:
        """The principal of a single-use ticket."""

    async def cookie(self, header: str, origin: str | None, host: str) -> Principal | None:
        """The principal of a session cookie, ``None`` when there is no such cookie."""

    async def admit(self, principal: Principal, robot: str, address: str) -> Admission:
        """Find out whether the principal has any right on the robot.

        :raises NotFound: it has none, or there is no such robot
        """

    def open(self, admission: Admission, transport: ClientTransport, opened_ns: int) -> Occupant:
        """Begin a session that was admitted."""

    def turn_away(self, admission: Admission) -> None:
        """Somebody who was admitted left before a session began."""


async def identify(
    gate: Gate, request: ConnectionRequest, asked: Opening
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
        return closing.INVALID
    if isinstance(error, BadCredentials):
        return closing.UNAUTHENTICATED
    if isinstance(error, (TooManyRequests, TooManyStreams)):
        return closing.TOO_MANY_ERRORS
    if isinstance(error, NotFound):
        return closing.NOT_FOUND
    if isinstance(error, GoingDown):
        return closing.GOING_AWAY
    if isinstance(error, NotMade):
        return closing.NOT_MADE
    if isinstance(error, Unavailable):
        return closing.UNAVAILABLE
    return closing.FORBIDDEN


def status_of(error: SwitchboardError) -> int:
    """The HTTP status of a handshake that is refused for this reason."""
    return HANDSHAKE_STATUS.get(code_of(error), 403)
