"""Authentication of users: logins, logouts and login links, and whose a token, a ticket or a cookie is."""

from __future__ import annotations

import time

from relay_db import queries
from relay_protocol.errors import Invalid, NotFound, SwitchboardError
from relay_protocol.realms import DEFAULT_REALM, split_name
from relay_server.access import LOOKUP_SECONDS, NO_ROBOT, NOT_LOOKED_UP, Access, Principal
from relay_server.auth import passwords
from relay_server.auth.authenticator import (
    NAMED,
    Authenticator,
    TicketPurpose,
    TooManyTries,
    named_realm,
    session_token,
)
from relay_server.auth.origins import Origins
from relay_server.auth.url_tokens import UrlTokens
from relay_server.common.clock import Clock
from relay_server.common.concurrency import with_timeout
from relay_server.common.database import AsyncDatabase
from relay_server.events.bus import EventBus


class AuthService:
    """Authenticates users of HTTP and websockets.

    :param cookie: name of the session cookie
    """

    def __init__(
        self,
        clock: Clock,
        store: AsyncDatabase,
        authenticator: Authenticator,
        access: Access,
        bus: EventBus,
        origins: Origins,
        cookie: str,
        url_tokens: UrlTokens,
    ) -> None:
        self._clock = clock
        self._url_tokens = url_tokens
        self._store = store
        self._authenticator = authenticator
        self._access = access
        self._bus = bus
        self._origins = origins
        self._cookie = cookie

    async def password(self, user: str, password: str, address: str) -> tuple[Principal, str]:
        """Log in by password; returns the principal and the token of a new portal session."""
        try:
            login = await self._authenticator.password(user, password, address)
        except SwitchboardError as error:
            # Attempts over the limit are not published, so a flood cannot reach the database.
            if not isinstance(error, TooManyTries):
                self._bus.publish(
                    "login.refused",
                    user=user[:NAMED],
                    realm=named_realm(user),
                    address=address,
                    reason=error.code,
                )
            raise
        return login, await self._authenticator.open_session(login, address, "password")

    async def login_code(self, code: str, address: str) -> tuple[Principal, str]:
        """Log in by a one-time link."""
        login = await self._authenticator.login_code(code, address)
        return login, await self._authenticator.open_session(login, address, "link")

    async def logout(self, principal: Principal) -> None:
        """End the principal's portal session, and all that was opened with its token."""
        await self._store.write(queries.revoke_token, principal.token_id)
        await self._access.refresh()

    async def token(self, token: str) -> Principal:
        """The principal of an access token or session."""
        token_hash = passwords.token_hash(token)
        known = self._access.recent_principal(token_hash)
        if known is not None:
            return known
        refreshed = self._access.refreshed
        principal = await self._authenticator.token(token)
        self._access.remember(token_hash, principal, refreshed)
        return principal

    bearer = token

    async def token_from_memory(self, token: str) -> Principal:
        """As :meth:`token`, for requests that stop robots: a token that was proved before needs no database.

        :raises Unavailable: the database is needed, and does not answer within :data:`LOOKUP_SECONDS`
        """
        known = self._access.remembered_principal(passwords.token_hash(token))
        if known is not None:
            return known
        return await with_timeout(self._clock, LOOKUP_SECONDS, self.token(token), NOT_LOOKED_UP)

    def remembers(self, token: str) -> bool:
        """Whether a token was proved before; the database is not asked."""
        return self._access.remembered_principal(passwords.token_hash(token)) is not None

    async def ticket(self, ticket: str, purpose: TicketPurpose, *, spend: bool = True) -> Principal:
        """The principal of a single-use ticket."""
        return await self._authenticator.ticket(ticket, purpose, spend=spend)

    async def url_token(self, token: str, address: str) -> Principal:
        """The principal of a token in the URL of a Foxglove websocket, for one robot.

        :param address: of the client, for the limit on guesses
        """
        return await self._url_tokens.principal(token, address)

    async def cookie(self, header: str, origin: str | None, host: str) -> Principal | None:
        """The principal of a session cookie in a websocket's handshake; ``None``: there is no cookie.

        :raises Refused: the Origin is not listed
        """
        token = session_token(self._origins, self._cookie, header, origin, host)
        return None if token is None else await self._authenticator.token(token)

    async def issue_ticket(self, principal: Principal, opens: TicketPurpose) -> str:
        """A ticket for one connection to a robot.

        :raises NotFound: no such robot, or no right on it
        """
        for record, _ in await self._access.robots(principal):
            if record.name == opens.robot:
                return self._authenticator.issue_ticket(principal, opens)
        raise NotFound(NO_ROBOT)


LINK_SECONDS = 3600.0


async def first_login(store: AsyncDatabase, url: str) -> str | None:
    """A link for the administrator of a relay that no user can log in to yet; ``None`` otherwise.

    :param url: of the portal
    """
    users = await store.read(queries.list_users, DEFAULT_REALM)
    if any(user.password_hash is not None or user.name != "admin" for user in users):
        return None
    return await login_link(store, url, "admin", create=True)


async def login_link(store: AsyncDatabase, url: str, user: str, create: bool = False) -> str:
    """A login link for a user.

    :param url: of the portal
    :param user: ``toad@lab1``; a name without a realm belongs to the default realm
    :param create: create the user as an administrator if there is none
    :raises Invalid: no such user
    """
    name, realm = split_name(user)
    record = await store.read(queries.find_user, name, realm)
    if record is None:
        if not create:
            raise Invalid(f"there is no user '{user}'")
        record = await store.write(queries.add_user, name, None, admin=True, realm=realm)
    code = passwords.new_token()
    now = time.time()
    await store.write(
        queries.create_token,
        record.id,
        passwords.token_hash(code),
        kind="login",
        label="login link",
        expires=now + LINK_SECONDS,
        now=now,
    )
    return f"{url}/login#code={code}"
