"""The websocket of ICPI programs, ``/icpi``: authentication, limits and sessions."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

from autobahn.websocket.types import ConnectionRequest

from relay_protocol.errors import Refused
from relay_server.access import BadCredentials, Principal
from relay_server.auth.authenticator import TicketPurpose, session_token
from relay_server.auth.origins import Origins
from relay_server.auth.service import AuthService
from relay_server.common import close_codes
from relay_server.icpi.messages import MAX_MESSAGE
from relay_server.icpi.session import IcpiServices, IcpiSession
from relay_server.sessions.ports import ClientTransport
from relay_server.ws.connection import ClientConnection, ClientFactory

CONNECTIONS_PER_USER = 64


@dataclass(frozen=True)
class ProgramPrincipal(Principal):
    """A principal with the token that proved it."""

    token: str = field(default="", repr=False)


class ProgramAdmission(NamedTuple):
    """A program that may connect."""

    principal: Any
    address: str


class IcpiConnections:
    """Authenticates programs, and opens the session of each.

    A :class:`relay_server.ws.handshake.HandshakeAuth` and a :class:`relay_server.ws.handshake.HandshakeSessions`.

    :param cookie: name of the session cookie
    """

    def __init__(self, services: IcpiServices, auth: AuthService, origins: Origins, cookie: str) -> None:
        self.accepting = True
        self._services = services
        self._auth = auth
        self._origins = origins
        self._cookie = cookie
        self._open: dict[IcpiSession, int] = {}
        """Sessions with the numbers of their users."""

    async def bearer(self, token: str) -> Principal:
        """The principal of an access token."""
        return ProgramPrincipal(**vars(await self._auth.token(token)), token=token)

    async def ticket(self, ticket: str, purpose: TicketPurpose) -> Principal:
        """Refuse: a ticket is for one robot."""
        raise BadCredentials("a ticket is for one robot; send an access token")

    async def url_token(self, token: str, address: str) -> Principal:
        """Refuse: a token in a URL is for one robot."""
        raise BadCredentials("a token in a URL is for one robot; send an access token")

    async def cookie(self, header: str, origin: str | None, host: str) -> Principal | None:
        """The principal of a session cookie; ``None``: there is no such cookie."""
        token = session_token(self._origins, self._cookie, header, origin, host)
        return None if token is None else await self.bearer(token)

    async def admit(self, principal: Principal, robot: str, address: str) -> Any:
        """Every user may connect programs.

        :raises Refused: the token has a scope, or the user has too many connections
        """
        principal.require_full_scope()
        if list(self._open.values()).count(principal.user_id) >= CONNECTIONS_PER_USER:
            raise Refused(f"you have {CONNECTIONS_PER_USER} ICPI connections, the most one user may have")
        return ProgramAdmission(principal, address)

    def open(self, admission: Any, transport: ClientTransport, opened_ns: int) -> IcpiSession:
        """Begin the session of a program."""
        principal = admission.principal
        session = IcpiSession(
            self._services, transport, principal, principal.token, admission.address, self._ended
        )
        self._open[session] = principal.user_id
        return session

    def release(self, admission: Any) -> None:
        """Nothing to release."""

    def shutdown(self, reason: str) -> None:
        """The relay shuts down: refuse new programs, and close what is open."""
        self.accepting = False
        self.close_all(reason)

    def close_all(self, reason: str) -> None:
        """Close the websockets of all programs, which may connect again."""
        for session in list(self._open):
            session.close(close_codes.GOING_AWAY, reason)

    def _ended(self, session: IcpiSession) -> None:
        self._open.pop(session, None)


class IcpiProtocol(ClientConnection):
    """The websocket of one program."""

    message_limit = MAX_MESSAGE
    has_dialects = False

    def _purpose_of(self, request: ConnectionRequest) -> TicketPurpose:
        # The empty name stands for no robot.
        return TicketPurpose("")


class IcpiFactory(ClientFactory):
    """Builds an :class:`IcpiProtocol` for each websocket; its auth and its sessions are :class:`IcpiConnections`."""

    protocol = IcpiProtocol
    takes_forwarded = False
