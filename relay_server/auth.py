"""Who is it? Passwords, access tokens, one-time login codes and websocket tickets become a principal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorThreads
from twisted.logger import Logger

from relay_db import queries
from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from relay_protocol.limits import TICKET_SECONDS
from relay_server import passwords
from relay_server.access import BadCredentials, Principal
from relay_server.limiter import LoginLimiter
from relay_server.store import Store, Threads

__all__ = ["Authenticator", "BadCredentials", "TooManyTries"]

SESSION_SECONDS = 12 * 3600.0
HASHING_THREADS = 2
TICKETS = 10_000
TICKETS_OF_ONE = 100
"""Tickets one user may have open; a further one takes the place of the oldest."""

LOGINS_WAITING = 64
"""Logins that wait for their password to be hashed; further ones are asked to come back."""


class TooManyTries(SwitchboardError):
    """Further tries are refused for ``retry_after`` seconds."""

    code = "too_many_tries"

    def __init__(self, retry_after: float) -> None:
        super().__init__(f"too many failed logins from your network; try again in {int(retry_after) + 1} s")
        self.retry_after = retry_after


@dataclass(frozen=True)
class _Ticket:
    principal: Principal
    robot: str
    until: float


class Authenticator:
    """Turns credentials into a :class:`Principal`, or raises.

    :param seconds: a monotonic clock
    :param wall: Unix time in seconds
    """

    log = Logger()

    def __init__(
        self,
        reactor: IReactorThreads,
        store: Store,
        seconds: Callable[[], float],
        wall: Callable[[], float],
    ) -> None:
        self._store = store
        self._seconds = seconds
        self._wall = wall
        self._limiter = LoginLimiter(seconds)
        self._hashing = Threads(
            reactor, "passwords", HASHING_THREADS, LOGINS_WAITING, "too many people log in now; try again"
        )
        self._tickets: dict[str, _Ticket] = {}

    def start(self) -> None:
        """Start the threads that hash passwords, and make ready for the first unknown user."""
        self._hashing.start()
        Deferred.fromCoroutine(self._hashing.run(passwords.prepare)).addErrback(
            lambda failure: self.log.failure("passwords can't be hashed", failure)
        )

    def stop(self) -> None:
        """Wait for the hashing under way and end its threads."""
        self._hashing.stop()

    async def password(self, user: str, password: str, address: str) -> Principal:
        """Check a password; unknown users cost the same time as known ones.

        :param address: where the ask comes from, for the limit on failures
        :raises BadCredentials: unknown user, wrong password or disabled account: one and the same answer
        :raises TooManyTries: judged before the password is hashed
        :raises Unavailable: the database does not answer, or too many log in at once
        """
        wait = self._limiter.wait(user, address)
        if wait > 0:
            raise TooManyTries(wait)
        self._limiter.failed(user, address)
        try:
            return await self._password(user, password, address)
        except Unavailable:
            # Nothing was tried.
            self._limiter.forgive(user, address)
            raise

    async def _password(self, user: str, password: str, address: str) -> Principal:
        record = await self._store.read(queries.find_user, user)
        stored = record.password_hash if record is not None and not record.disabled else None
        right = await self._hashing.run(passwords.verify_password, password, stored)
        if record is None or not right:
            raise BadCredentials("user or password is wrong")
        self._limiter.succeeded(user, address)
        return Principal(record.id, record.name, record.realm, record.admin, 0, None)

    async def token(self, token: str) -> Principal:
        """The principal behind an access token or a portal session.

        :raises BadCredentials: unknown, expired or revoked
        """
        record = await self._store.read(
            queries.principal_by_token, passwords.token_hash(token), self._wall(), ("access", "session")
        )
        if record is None:
            raise BadCredentials("the access token is unknown, expired or revoked")
        return Principal.of(record)

    async def login_code(self, code: str, address: str) -> Principal:
        """The principal of a one-time login link; the code is spent by this.

        :raises BadCredentials: unknown, expired or used
        :raises TooManyTries: as for passwords
        """
        wait = self._limiter.wait(None, address)
        if wait > 0:
            raise TooManyTries(wait)
        record = await self._store.write(queries.consume_login, passwords.token_hash(code), self._wall())
        if record is None:
            self._limiter.failed(None, address)
            raise BadCredentials("the login link is unknown, expired or already used; ask for a new one")
        return Principal.of(record)

    async def open_session(self, principal: Principal) -> str:
        """A portal session for a principal just proved; returns the token its cookie carries."""
        token = passwords.new_token()
        now = self._wall()
        await self._store.write(
            queries.create_token,
            principal.user_id,
            passwords.token_hash(token),
            kind="session",
            label="portal",
            expires=now + SESSION_SECONDS,
            now=now,
        )
        return token

    def issue_ticket(self, principal: Principal, robot: str) -> str:
        """A ticket for one websocket to one robot, good once for :data:`TICKET_SECONDS`."""
        now = self._seconds()
        for key in [key for key, ticket in self._tickets.items() if ticket.until <= now]:
            del self._tickets[key]
        own = [key for key, ticket in self._tickets.items() if ticket.principal.user_id == principal.user_id]
        if len(own) >= TICKETS_OF_ONE:
            del self._tickets[own[0]]
        if len(self._tickets) >= TICKETS:
            raise Refused("too many tickets are open; use them or wait a minute")
        ticket = passwords.new_token()
        self._tickets[passwords.token_hash(ticket)] = _Ticket(principal, robot, now + TICKET_SECONDS)
        return ticket

    async def ticket(self, ticket: str, robot: str) -> Principal:
        """The principal of a ticket, which is spent by this.

        :raises BadCredentials: unknown, used, too old, for another robot, or its user's session has ended since
        """
        found = self._tickets.pop(passwords.token_hash(ticket), None)
        if found is None or found.until <= self._seconds() or found.robot != robot:
            raise BadCredentials(
                "the ticket is unknown, used, expired or for another robot; ask for a new one"
            )
        live = await self._store.read(queries.token_is_live, found.principal.token_id, self._wall())
        if not live:
            raise BadCredentials("the session that asked for this ticket has ended; log in again")
        return found.principal
