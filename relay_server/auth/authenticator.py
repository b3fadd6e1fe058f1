"""Passwords, access tokens, one-time login codes and tickets become a principal."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from sqlalchemy.orm import Session
from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorThreads
from twisted.logger import Logger

from relay_db import queries
from relay_db.models import NAME
from relay_db.names import normalise
from relay_protocol.errors import Refused, Unavailable
from relay_protocol.limits import TICKET_SECONDS
from relay_protocol.realms import split_name
from relay_server.access import BadCredentials, Principal
from relay_server.auth import passwords
from relay_server.auth.account_limit import AccountLimit
from relay_server.auth.login_limiter import LoginLimiter, TooManyTries, network_of
from relay_server.auth.origins import Origins
from relay_server.common.database import AsyncDatabase, BoundedThreadPool

__all__ = ["Authenticator", "BadCredentials", "TooManyTries", "named_realm", "session_token"]

SESSION_SECONDS = 12 * 3600.0
HASHING_THREADS = 2
TICKETS = 10_000
"""Most open tickets of all users. A further one replaces the oldest ticket of the user with most tickets."""

TICKETS_OF_ONE = 100
"""Most open tickets of one user. A further one replaces the oldest."""

NAMED = 2 * NAME + 1
"""Characters of a user's name and realm that enter the record of a failed login."""

LOGINS_WAITING = 64
"""Most logins that wait for their password to be hashed; further ones are rejected."""


@dataclass(frozen=True)
class TicketPurpose:
    """The purpose of a ticket.

    :param video: cameras of the robot instead of its websocket
    :param camera: with ``video``, only this camera; empty for any
    """

    robot: str
    video: bool = False
    camera: str = ""

    def covers(self, other: TicketPurpose) -> bool:
        """Whether a ticket for this purpose is good for another one."""
        return (self.robot, self.video) == (other.robot, other.video) and self.camera in ("", other.camera)


@dataclass(frozen=True)
class _Ticket:
    principal: Principal
    opens: TicketPurpose
    until: float


@dataclass(frozen=True)
class LoginResult(Principal):
    """A user who has just logged in, for whom a session may be opened.

    :param password_hash: as it was stored then; the session is opened only if it still is
    """

    password_hash: str | None = field(default=None, repr=False)


class Authenticator:
    """Turns credentials into a :class:`Principal`, or raises.

    :param seconds: a monotonic clock
    :param wall: Unix time in seconds
    """

    log = Logger()

    def __init__(
        self,
        reactor: IReactorThreads,
        store: AsyncDatabase,
        seconds: Callable[[], float],
        wall: Callable[[], float],
    ) -> None:
        self._store = store
        self._seconds = seconds
        self._wall = wall
        self._limiter = LoginLimiter(seconds)
        self._account_limit = AccountLimit(store, wall)
        self._hashing = BoundedThreadPool(
            reactor,
            "passwords",
            HASHING_THREADS,
            LOGINS_WAITING,
            "too many users are logging in now; try again",
            only_reads=True,
        )
        self._tickets: dict[str, _Ticket] = {}

    def start(self) -> None:
        """Start the threads that hash passwords, and prepare for the first unknown user."""
        self._hashing.start()
        Deferred.fromCoroutine(self._hashing.run(passwords.prepare)).addErrback(
            lambda failure: self.log.failure("passwords cannot be hashed now", failure)
        )

    def stop(self) -> None:
        """Wait for hashing in progress, and end the threads."""
        self._hashing.stop()

    async def password(self, user: str, password: str, address: str) -> LoginResult:
        """Check a password. Unknown users take as long as known ones.

        :param user: ``toad@lab1``; a name without a realm belongs to the default realm. Blanks around it do not count
        :param address: of the client, for the limit on failures
        :raises BadCredentials: unknown user, wrong password or disabled account, with the same message
        :raises TooManyTries: decided before the password is hashed
        :raises Unavailable: the database does not answer, or too many users log in at once
        """
        user = user.strip()
        wait = self._limiter.wait(user, address)
        if wait > 0:
            raise TooManyTries(wait)
        self._limiter.failed(user, address)
        try:
            return await self._password(user, password, address)
        except (Unavailable, TooManyTries):
            # No password was tried.
            self._limiter.forgive(user, address)
            raise

    async def _password(self, user: str, password: str, address: str) -> LoginResult:
        record = await self._store.read(queries.find_user, *split_name(user))
        failure = await self._account_limit.count(user, None if record is None else record.id, address)
        stored = record.password_hash if record is not None and not record.disabled else None
        try:
            right = await self._hashing.run(passwords.verify_password, password, stored)
        except Unavailable:
            await self._account_limit.forgive(failure)
            raise
        if record is None or not right:
            raise BadCredentials("user or password is wrong")
        await self._account_limit.succeeded(failure, record.id, address)
        self._limiter.succeeded(user, address)
        return LoginResult(record.id, record.name, record.realm, record.admin, 0, None, password_hash=stored)

    async def new_hash(self, password: str) -> str:
        """The hash to store for a new password.

        :raises Invalid: it breaks the rules
        :raises Unavailable: too many passwords are being hashed
        """
        return await self._hashing.run(passwords.hash_password, password)

    async def token(self, token: str) -> Principal:
        """The principal of an access token or a portal session.

        :raises BadCredentials: unknown, expired or revoked
        """
        record = await self._store.read(
            queries.principal_by_token, passwords.token_hash(token), self._wall(), ("access", "session")
        )
        if record is None:
            raise BadCredentials("the access token is unknown, expired or revoked")
        return Principal.of(record)

    async def login_code(self, code: str, address: str) -> LoginResult:
        """The principal of a one-time login link; the code is used up.

        :raises BadCredentials: unknown, expired or used
        :raises TooManyTries: as for passwords
        """
        wait = self._limiter.wait(None, address)
        if wait > 0:
            raise TooManyTries(wait)
        login = await self._store.write(_consume, passwords.token_hash(code), self._wall())
        if login is None:
            self._limiter.failed(None, address)
            raise BadCredentials("the login link is unknown, expired or already used; ask for a new one")
        return login

    async def open_session(self, login: LoginResult, address: str, how: str) -> str:
        """Open a portal session, with an audit entry; returns the token for the cookie.

        :param how: ``password`` or ``link``, for the audit log
        :raises BadCredentials: the password was changed or the account disabled meanwhile
        :raises Unavailable: the audit entry cannot be written
        """
        token = passwords.new_token()
        try:
            await self._store.write(
                _open_session, login, passwords.token_hash(token), address, how, self._wall()
            )
        except Refused as error:
            raise BadCredentials(str(error)) from None
        return token

    def issue_ticket(self, principal: Principal, opens: TicketPurpose) -> str:
        """A ticket that works once within :data:`TICKET_SECONDS`. Where too many are open, it replaces
        another one."""
        now = self._seconds()
        for key in [key for key, ticket in self._tickets.items() if ticket.until <= now]:
            del self._tickets[key]
        own = [key for key, ticket in self._tickets.items() if ticket.principal.user_id == principal.user_id]
        if len(own) >= TICKETS_OF_ONE:
            del self._tickets[own[0]]
        if len(self._tickets) >= TICKETS:
            del self._tickets[self._most_dispensable()]
        ticket = passwords.new_token()
        self._tickets[passwords.token_hash(ticket)] = _Ticket(principal, opens, now + TICKET_SECONDS)
        return ticket

    def _most_dispensable(self) -> str:
        """The oldest ticket of the user with most tickets."""
        [(greedy, _)] = Counter(each.principal.user_id for each in self._tickets.values()).most_common(1)
        return next(key for key, each in self._tickets.items() if each.principal.user_id == greedy)

    async def ticket(self, ticket: str, purpose: TicketPurpose, *, spend: bool = True) -> Principal:
        """The principal of a ticket.

        :param purpose: the purpose that the request needs
        :param spend: use the ticket up, even if the request fails later; otherwise it is only checked
        :raises BadCredentials: unknown, used, expired, for another purpose, or its user's session has ended
        """
        key = passwords.token_hash(ticket)
        found = self._tickets.pop(key, None) if spend else self._tickets.get(key)
        if found is None or found.until <= self._seconds() or not found.opens.covers(purpose):
            raise BadCredentials(
                "the ticket is unknown, used, expired or for something else; ask for a new one"
            )
        live = await self._store.read(queries.token_is_live, found.principal.token_id, self._wall())
        if not live:
            raise BadCredentials("the session that asked for this ticket has ended; log in again")
        return found.principal


def named_realm(user: str) -> str:
    """The realm in a login name, whether it exists or not; empty if it is not valid."""
    return normalise(split_name(user)[1])


def session_token(origins: Origins, name: str, header: str, origin: str | None, host: str) -> str | None:
    """The token of a session cookie in a websocket's handshake; ``None`` without such a cookie.

    :param name: of the cookie
    :param header: ``Cookie``
    :raises Refused: a cookie without a listed Origin
    :raises BadCredentials: the relay's own page sent none
    """
    given = (_cookie(header, each) for each in origins.cookie_names(name, host))
    token = next((each for each in given if each is not None), None)
    if token is None:
        if origin is not None and origin == f"{'https' if origins.tls else 'http'}://{host}":
            raise BadCredentials("your session has ended; log in again")
        return None
    origins.check(origin, host)
    return token


def _cookie(header: str, name: str) -> str | None:
    """The value of a cookie, by splitting as Twisted does for requests: ``http.cookies`` takes quadratic
    time."""
    found = None
    for each in header.split(";"):
        key, equals, value = each.lstrip().partition("=")
        if equals and key == name:
            found = value
    return found


def _consume(s: Session, code_hash: str, now: float) -> LoginResult | None:
    """Mark a login link as used."""
    found = queries.consume_login(s, code_hash, now)
    user = None if found is None else queries.get_user(s, found.user_id)
    if user is None:
        return None
    return LoginResult(user.id, user.name, user.realm, user.admin, 0, None, password_hash=user.password_hash)


def _open_session(s: Session, login: LoginResult, token_hash: str, origin: str, how: str, now: float) -> None:
    """The session, its audit entry and, for a login link, the network it was opened from, all or nothing."""
    if how == "link":  # the check of a password has stored it already
        queries.remember_login_network(s, login.user_id, network_of(origin), now)
    queries.open_session(
        s,
        login.user_id,
        token_hash,
        password_hash=login.password_hash,
        expires=now + SESSION_SECONDS,
        now=now,
    )
    queries.append_audit(
        s,
        at=now,
        actor=f"user:{login.full}",
        action="login",
        target=login.full,
        origin=origin,
        data={"how": how},
    )
