"""OAuth 2.0: issues, inspects and revokes tokens (RFC 6749, 7009, 7662)."""

from __future__ import annotations

import base64
import binascii
import hmac
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from urllib.parse import unquote_plus

from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.names import normalise
from relay_db.queries import IssuedRecord, OAuthClientRecord
from relay_protocol.errors import Invalid, Refused, SwitchboardError
from relay_protocol.realms import full_name
from relay_protocol.scopes import Scope
from relay_server.access import Access, BadCredentials, Principal
from relay_server.auth import passwords
from relay_server.auth.authenticator import NAMED, Authenticator, LoginResult, TooManyTries, named_realm
from relay_server.auth.login_limiter import LoginLimiter
from relay_server.common.database import AsyncDatabase
from relay_server.events.bus import EventBus
from relay_server.oauth.digest import Digest
from relay_server.oauth.schemas import Introspection, TokenInfo


class OAuthError(Refused):
    """No token was issued; the error codes are those of RFC 6749 section 5.2.

    :param error: such as ``invalid_grant``
    """

    code = "oauth"

    def __init__(self, error: str, words: str) -> None:
        super().__init__(words)
        self.error = error


@dataclass(frozen=True)
class TokenRequest:
    """The body of a token request.

    :param scope: limits the token; ``None`` for all rights of its user
    :param realm: the realm an OAuth client wants to act in, if it is not that of its user
    """

    grant_type: str
    username: str = ""
    password: str = ""
    refresh_token: str = ""
    scope: str | None = None
    realm: str | None = None


@dataclass(frozen=True)
class IssuedToken:
    """A response with a token.

    :param expires_in: seconds
    :param refresh_token: ``None`` for OAuth clients, which have a secret instead
    """

    access_token: str
    expires_in: float
    scope: Scope | None
    refresh_token: str | None = None

    def as_json(self) -> TokenInfo:
        """The JSON object of section 5.1."""
        answer: TokenInfo = {
            "access_token": self.access_token,
            "token_type": "Bearer",
            "expires_in": int(self.expires_in),
        }
        if self.scope is not None:
            answer["scope"] = str(self.scope)
        if self.refresh_token is not None:
            answer["refresh_token"] = self.refresh_token
        return answer


ACCESS_SECONDS = 3600.0
REFRESH_SECONDS = 30 * 86400.0

_NO_HA1 = "0" * 64


class OAuthService:
    """Issues tokens, inspects and revokes them.

    :param seconds: a monotonic clock
    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        store: AsyncDatabase,
        authenticator: Authenticator,
        access: Access,
        bus: EventBus,
        seconds: Callable[[], float],
        wall: Callable[[], float],
    ) -> None:
        self.digest = Digest(seconds)
        self._store = store
        self._auth = authenticator
        self._access = access
        self._bus = bus
        self._wall = wall
        self._limiter = LoginLimiter(seconds)

    # --- clients ------------------------------------------------------------------------------------------

    async def authenticate_client(
        self, header: str, method: str, uri: str, address: str, inside: tuple[str, str] | None = None
    ) -> OAuthClientRecord | None:
        """Authenticate the OAuth client that sent a request; ``None`` if the request has no credentials of one.

        :param header: the value of ``Authorization``: Digest, or Basic (RFC 6749 section 2.3.1)
        :param inside: key and secret from the body, if they came there
        :raises BadCredentials: there is no such OAuth client, or the secret is wrong
        :raises StaleNonce: see :class:`Digest`
        :raises WrongAddress: the same
        :raises TooManyTries: too many failures; decided before anything else
        """
        scheme = header.partition(" ")[0].lower()
        if scheme == "digest":
            proof = self.digest.read(header)
            key = proof.key
        elif scheme == "basic":
            key, secret = _basic(header)
        elif inside is not None:
            key, secret = inside
        else:
            return None
        wait = self._limiter.wait(key, address)
        if wait > 0:
            raise TooManyTries(wait)
        self._limiter.failed(key, address)
        try:
            found = await self._store.read(queries.find_oauth_client, key)
        except SwitchboardError:
            self._limiter.forgive(key, address)
            raise
        known = _NO_HA1 if found is None else found.digest_ha1
        try:
            if scheme == "digest":
                self.digest.check(proof, known, method, uri)
            elif not hmac.compare_digest(passwords.digest_ha1(key, secret), known):
                raise BadCredentials("the key is unknown or the secret is wrong")
        except BadCredentials as error:
            if error.code == BadCredentials.code:
                self._publish_refused(key, found, address)
            else:  # right, but late or for another address: no guess
                self._limiter.forgive(key, address)
            raise
        self._limiter.succeeded(key, address)
        return found

    def _publish_refused(self, key: str, found: OAuthClientRecord | None, address: str) -> None:
        self._bus.publish(
            "login.refused",
            client_id=key[:64],
            realm=None if found is None else found.realm,
            address=address,
            reason=BadCredentials.code,
        )

    # --- tokens -------------------------------------------------------------------------------------------

    async def token(
        self, request: TokenRequest, client: OAuthClientRecord | None, address: str
    ) -> IssuedToken:
        """Issue a token, by the kind of grant (sections 4.3, 4.4, 6).

        :raises OAuthError: no token is issued
        :raises TooManyTries: too many wrong passwords recently
        :raises Unavailable: the database does not answer
        """
        if request.grant_type == "password":
            return await self._by_password(request, address)
        if request.grant_type == "client_credentials":
            return await self._by_client_secret(request, client, address)
        if request.grant_type == "refresh_token":
            return await self._by_refresh(request)
        raise OAuthError(
            "unsupported_grant_type", "grant_type must be password, client_credentials or refresh_token"
        )

    async def _by_password(self, request: TokenRequest, address: str) -> IssuedToken:
        if not request.username or not request.password:
            raise OAuthError("invalid_request", "username and password are missing")
        scope = _scope(request.scope, None)
        try:
            login = await self._auth.password(request.username, request.password, address)
            granted = _new_token(scope, passwords.new_token())
            await self._store.write(_open_family, login, granted, address, self._wall())
        except BadCredentials as error:
            self._bus.publish(
                "login.refused",
                user=request.username[:NAMED],
                realm=named_realm(request.username),
                address=address,
                reason=error.code,
            )
            raise OAuthError("invalid_grant", str(error)) from None
        except Refused as error:
            raise OAuthError("invalid_grant", str(error)) from None
        return granted

    async def _by_client_secret(
        self, request: TokenRequest, client: OAuthClientRecord | None, address: str
    ) -> IssuedToken:
        if client is None:
            raise BadCredentials("send the OAuth client's key and secret: by Digest, or by Basic over TLS")
        scope = _scope(request.scope, client.scope)
        another = request.realm is not None and normalise(request.realm) != client.realm
        if another and scope is not None and not scope.realm_independent:
            raise OAuthError(
                "invalid_scope",
                "in another realm the scope must name no robots and must not have 'admin': these belong to "
                "the OAuth client's own realm",
            )
        granted = _new_token(scope, None)
        await self._store.write(_issue_to_client, client, request.realm, granted, address, self._wall())
        return granted

    async def _by_refresh(self, request: TokenRequest) -> IssuedToken:
        if not request.refresh_token:
            raise OAuthError("invalid_request", "send refresh_token")
        # An invalid scope must not use up the refresh token.
        scope = _scope(request.scope, None)
        refresh = passwords.new_token()
        family = await self._store.write(_refresh, request.refresh_token, refresh, scope, self._wall())
        if isinstance(family, OAuthError):
            await self._access.refresh()
            raise family
        return family

    # --- inspection and revocation -------------------------------------------------------------------------

    async def introspect(self, token: str, realm: str, client_id: str | None = None) -> Introspection:
        """The state of a token: its user, scope and expiry (RFC 7662 section 2.2).

        :param realm: of the caller; tokens of other realms count as inactive
        :param client_id: key of the calling OAuth client; its own tokens count in any realm
        """
        now = self._wall()
        record = await self._store.read(queries.issued_token, passwords.token_hash(token), now)
        if record is None or (record.realm != realm and (client_id is None or record.client_id != client_id)):
            return {"active": False}
        claims: Introspection = {
            "active": True,
            "token_type": "Bearer" if record.kind == "access" else "refresh_token",
            "username": record.user,
            "sub": f"{record.user}@{record.realm}",
            "realm": record.realm,
            "iat": int(record.created),
        }
        if record.scope is not None:
            claims["scope"] = record.scope
        if record.client_id is not None:
            claims["client_id"] = record.client_id
        if record.expires is not None:
            claims["exp"] = int(record.expires)
            claims["expires_in"] = int(record.expires - now)
        return claims

    async def revoke(self, token: str, realm: str, client_id: str | None = None) -> None:
        """Revoke a token, and cut the connections that use it. An unknown token is not an error.

        :param realm: of the caller
        :param client_id: key of the calling OAuth client
        """
        gone = await self._store.write(queries.revoke_issued, passwords.token_hash(token), realm, client_id)
        if gone:
            await self._access.refresh()

    async def principal(self, token: str) -> Principal:
        """The caller that inspects tokens with a token of its own.

        :raises BadCredentials: unknown, expired or revoked
        """
        return await self._auth.token(token)


def _scope(asked: str | None, most: str | None) -> Scope | None:
    """The scope of a new token.

    :raises OAuthError: it cannot be parsed, or is wider than allowed
    """
    given = None if most is None else Scope(most)
    if asked is None:
        return given
    try:
        scope = Scope(asked)
    except Invalid as error:
        raise OAuthError("invalid_scope", str(error)) from None
    if given is not None and not scope.within(given):
        raise OAuthError("invalid_scope", f"the scope may be at most '{given}'")
    return scope


def _new_token(scope: Scope | None, refresh: str | None) -> IssuedToken:
    return IssuedToken(passwords.new_token(), ACCESS_SECONDS, scope, refresh)


def _scope_text(scope: Scope | None) -> str | None:
    return None if scope is None else str(scope)


def _open_family(s: Session, login: LoginResult, granted: IssuedToken, address: str, now: float) -> None:
    """Store a token family, its first access token and the audit entry, all or nothing."""
    assert granted.refresh_token is not None
    family = queries.open_token_family(
        s,
        login.user_id,
        passwords.token_hash(granted.refresh_token),
        password_hash=login.password_hash,
        scope=_scope_text(granted.scope),
        expires=now + REFRESH_SECONDS,
        now=now,
    )
    _store_token(s, login.user_id, granted, now, family_id=family)
    _audit(s, login.full, "password", granted, address, now)


def _issue_to_client(
    s: Session, client: OAuthClientRecord, realm: str | None, granted: IssuedToken, address: str, now: float
) -> None:
    """Store an access token for an OAuth client that still exists, and the audit entry.

    :param realm: the realm to act in, where its user needs an account
    """
    if queries.find_oauth_client(s, client.key) is None:
        raise BadCredentials("the key is unknown or the secret is wrong")
    user_id, full = client.user_id, full_name(client.user, client.realm)
    if realm is not None:
        account = queries.linked_account_in(s, client.user_id, realm)
        if account is None or account.disabled:
            raise OAuthError("invalid_target", "the OAuth client's user has no account in that realm")
        user_id, full = account.id, account.full
    _store_token(s, user_id, granted, now, oauth_client_id=client.id)
    _audit(s, full, "oauth_client", granted, address, now, client_id=client.key)


def _refresh(s: Session, old: str, new: str, scope: Scope | None, now: float) -> IssuedToken | OAuthError:
    """The next tokens of a family. An error is returned and not raised, so that the end of the family is committed."""
    before = queries.issued_token(s, passwords.token_hash(old), now)
    if before is not None and before.kind == "refresh":
        error = _scope_error(before, scope)
        if error is not None:
            return error
    family = queries.refresh_token_family(s, passwords.token_hash(old), passwords.token_hash(new), now)
    if family is None or family.family_id is None:
        return OAuthError(
            "invalid_grant", "the refresh token is unknown, expired, revoked or was used before; log in again"
        )
    own = None if family.scope is None else Scope(family.scope)
    granted = _new_token(scope or own, new)
    _store_token(s, family.user_id, granted, now, family_id=family.family_id)
    return granted


def _scope_error(before: IssuedRecord, scope: Scope | None) -> OAuthError | None:
    if scope is None or before.scope is None or scope.within(Scope(before.scope)):
        return None
    return OAuthError("invalid_scope", f"the scope may be at most '{before.scope}'")


def _store_token(s: Session, user_id: int, granted: IssuedToken, now: float, **belongs: int) -> None:
    queries.create_token(
        s,
        user_id,
        passwords.token_hash(granted.access_token),
        kind="access",
        label="oauth",
        expires=now + granted.expires_in,
        now=now,
        scope=_scope_text(granted.scope),
        **belongs,
    )


def _audit(
    s: Session, user: str, how: str, granted: IssuedToken, address: str, now: float, **data: Any
) -> None:
    data = {"how": how, "scope": _scope_text(granted.scope), **data}
    queries.append_audit(
        s, at=now, actor=f"user:{user}", action="token.issue", target=user, origin=address, data=data
    )


def _basic(header: str) -> tuple[str, str]:
    """Key and secret of ``Authorization: Basic`` (RFC 7617), form-encoded as in RFC 6749 section 2.3.1.

    :raises BadCredentials: it cannot be parsed
    """
    try:
        text = base64.b64decode(header.partition(" ")[2].strip(), validate=True).decode()
    except (binascii.Error, UnicodeDecodeError):
        text = ""
    key, colon, secret = text.partition(":")
    if not colon:
        raise BadCredentials("the Authorization header is not valid Basic")
    return unquote_plus(key), unquote_plus(secret)
