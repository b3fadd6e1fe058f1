"""Which tokens are issued, to whom, for what and for how long (RFC 6749, 7009, 7662)."""

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


class OAuthError(Refused):
    """No token, and why, in the words of RFC 6749 section 5.2.

    :param error: such as ``invalid_grant``
    """

    code = "oauth"

    def __init__(self, error: str, words: str) -> None:
        super().__init__(words)
        self.error = error


@dataclass(frozen=True)
class TokenRequest:
    """The body of a request for a token.

    :param scope: what it is to be used for; ``None`` for all that is possible
    :param realm: in which a program wants to act, where that is not the one of its user
    """

    grant_type: str
    username: str = ""
    password: str = ""
    refresh_token: str = ""
    scope: str | None = None
    realm: str | None = None


@dataclass(frozen=True)
class IssuedToken:
    """What is issued.

    :param expires_in: seconds
    :param refresh_token: ``None`` where there is none: a program has its secret
    """

    access_token: str
    expires_in: float
    scope: Scope | None
    refresh_token: str | None = None

    def told(self) -> dict[str, Any]:
        """As JSON (section 5.1)."""
        told: dict[str, Any] = {
            "access_token": self.access_token,
            "token_type": "Bearer",
            "expires_in": int(self.expires_in),
        }
        if self.scope is not None:
            told["scope"] = str(self.scope)
        if self.refresh_token is not None:
            told["refresh_token"] = self.refresh_token
        return told


ACCESS_SECONDS = 3600.0
REFRESH_SECONDS = 30 * 86400.0

_NOBODY = "0" * 64


class OAuthService:
    """Issues tokens, tells what is left of them, ends them.

    :param seconds: a monotonic clock
    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        store: AsyncDatabase,
        authenticator: Authenticator,
        access: Access,
        journal: EventBus,
        seconds: Callable[[], float],
        wall: Callable[[], float],
    ) -> None:
        self.digest = Digest(seconds)
        self._store = store
        self._auth = authenticator
        self._access = access
        self._journal = journal
        self._wall = wall
        self._limiter = LoginLimiter(seconds)

    # --- who is it ----------------------------------------------------------------------------------------

    async def program(
        self, header: str, method: str, uri: str, address: str, inside: tuple[str, str] | None = None
    ) -> OAuthClientRecord | None:
        """The program that sent a request, by what it says of itself; ``None`` if it says nothing.

        :param header: the value of ``Authorization``: Digest, or Basic (RFC 6749 section 2.3.1)
        :param inside: key and secret that came in the body, where that is how they came
        :raises BadCredentials: there is no such program, or the secret is wrong
        :raises StaleNonce: see :class:`Digest`
        :raises TooManyTries: judged before anything else
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
            found = await self._store.read(queries.find_program, key)
        except SwitchboardError:
            self._limiter.forgive(key, address)
            raise
        known = _NOBODY if found is None else found.verifier
        try:
            if scheme == "digest":
                self.digest.check(proof, known, method, uri)
            elif not hmac.compare_digest(passwords.verifier(key, secret), known):
                raise BadCredentials("the key is unknown or the secret is wrong")
        except BadCredentials as error:
            if error.code == BadCredentials.code:
                self._note_refused(key, found, address)
            else:  # right, but late: no guess
                self._limiter.forgive(key, address)
            raise
        self._limiter.succeeded(key, address)
        return found

    def _note_refused(self, key: str, found: OAuthClientRecord | None, address: str) -> None:
        self._journal.event(
            "login.refused",
            "relay",
            cause=address,
            program=key[:64],
            realm=None if found is None else found.realm,
            address=address,
            reason=BadCredentials.code,
        )

    # --- tokens -------------------------------------------------------------------------------------------

    async def token(self, ask: TokenRequest, program: OAuthClientRecord | None, address: str) -> IssuedToken:
        """A token, by the kind of grant (section 4.3, 4.4, 6).

        :raises OAuthError: none, and why
        :raises TooManyTries: too many wrong passwords of late
        :raises Unavailable: the database does not answer
        """
        if ask.grant_type == "password":
            return await self._by_password(ask, address)
        if ask.grant_type == "client_credentials":
            return await self._by_secret(ask, program, address)
        if ask.grant_type == "refresh_token":
            return await self._by_refresh(ask)
        raise OAuthError(
            "unsupported_grant_type", "grant_type is password, client_credentials or refresh_token"
        )

    async def _by_password(self, ask: TokenRequest, address: str) -> IssuedToken:
        if not ask.username or not ask.password:
            raise OAuthError("invalid_request", "send username and password")
        scope = _scope(ask.scope, None)
        try:
            login = await self._auth.password(ask.username, ask.password, address)
            granted = _new(scope, passwords.new_token())
            await self._store.write(_begin, login, granted, address, self._wall())
        except BadCredentials as error:
            self._journal.event(
                "login.refused",
                "relay",
                cause=address,
                user=ask.username[:NAMED],
                realm=named_realm(ask.username),
                address=address,
                reason=error.code,
            )
            raise OAuthError("invalid_grant", str(error)) from None
        except Refused as error:
            raise OAuthError("invalid_grant", str(error)) from None
        return granted

    async def _by_secret(
        self, ask: TokenRequest, program: OAuthClientRecord | None, address: str
    ) -> IssuedToken:
        if program is None:
            raise BadCredentials("prove the program by its key and secret: Digest, or Basic over TLS")
        scope = _scope(ask.scope, program.scope)
        another = ask.realm is not None and normalise(ask.realm) != program.realm
        if another and scope is not None and not scope.anywhere:
            raise OAuthError(
                "invalid_scope",
                "in another realm a token is for a scope that names no robots and has no 'admin': those meant are of "
                "the program's own",
            )
        granted = _new(scope, None)
        await self._store.write(_to_program, program, ask.realm, granted, address, self._wall())
        return granted

    async def _by_refresh(self, ask: TokenRequest) -> IssuedToken:
        if not ask.refresh_token:
            raise OAuthError("invalid_request", "send refresh_token")
        # What can't be granted must not cost the token.
        wanted = _scope(ask.scope, None)
        refresh = passwords.new_token()
        family = await self._store.write(_refresh, ask.refresh_token, refresh, wanted, self._wall())
        if isinstance(family, OAuthError):
            await self._access.refresh()
            raise family
        return family

    # --- what is left of them ------------------------------------------------------------------------------

    async def introspect(self, token: str, realm: str, program: str | None = None) -> dict[str, Any]:
        """What a token is good for, and for how long (RFC 7662 section 2.2).

        :param realm: of who asks; tokens of others are not active to him
        :param program: the key of the program that asks, whose own tokens are, of whatever realm
        """
        now = self._wall()
        record = await self._store.read(queries.issued, passwords.token_hash(token), now)
        if record is None or (record.realm != realm and (program is None or record.program != program)):
            return {"active": False}
        told: dict[str, Any] = {
            "active": True,
            "token_type": "Bearer" if record.kind == "access" else "refresh_token",
            "username": record.user,
            "sub": f"{record.user}@{record.realm}",
            "realm": record.realm,
            "iat": int(record.created),
        }
        if record.scope is not None:
            told["scope"] = record.scope
        if record.program is not None:
            told["client_id"] = record.program
        if record.expires is not None:
            told["exp"] = int(record.expires)
            told["expires_in"] = int(record.expires - now)
        return told

    async def revoke(self, token: str, realm: str, program: str | None = None) -> None:
        """Make a token worthless, and cut what was opened with it; also says nothing of one that is none.

        :param realm: of who asks
        :param program: the key of the program that asks
        """
        gone = await self._store.write(queries.revoke_issued, passwords.token_hash(token), realm, program)
        if gone:
            await self._access.refresh()

    async def principal(self, token: str) -> Principal:
        """Who asks about tokens with one of his own.

        :raises BadCredentials: unknown, expired or revoked
        """
        return await self._auth.token(token)


def _scope(asked: str | None, most: str | None) -> Scope | None:
    """What a new token is for.

    :raises OAuthError: it can't be read, or is more than what there is to give
    """
    given = None if most is None else Scope(most)
    if asked is None:
        return given
    try:
        scope = Scope(asked)
    except Invalid as error:
        raise OAuthError("invalid_scope", str(error)) from None
    if given is not None and not scope.within(given):
        raise OAuthError("invalid_scope", f"at most '{given}' can be given here")
    return scope


def _new(scope: Scope | None, refresh: str | None) -> IssuedToken:
    return IssuedToken(passwords.new_token(), ACCESS_SECONDS, scope, refresh)


def _text(scope: Scope | None) -> str | None:
    return None if scope is None else str(scope)


def _begin(s: Session, login: LoginResult, granted: IssuedToken, address: str, now: float) -> None:
    """A family, its first access token and the audit entry: all or nothing."""
    assert granted.refresh_token is not None
    family = queries.open_family(
        s,
        login.user_id,
        passwords.token_hash(granted.refresh_token),
        password_hash=login.password_hash,
        scope=_text(granted.scope),
        expires=now + REFRESH_SECONDS,
        now=now,
    )
    _keep(s, login.user_id, granted, now, family_id=family)
    _audit(s, login.full, "password", granted, address, now)


def _to_program(
    s: Session, program: OAuthClientRecord, realm: str | None, granted: IssuedToken, address: str, now: float
) -> None:
    """An access token for a program, if it is still there, and the audit entry.

    :param realm: in which its user has an account too, where it is to be for that one
    """
    if queries.find_program(s, program.key) is None:
        raise BadCredentials("the key is unknown or the secret is wrong")
    user_id, full = program.user_id, full_name(program.user, program.realm)
    if realm is not None:
        account = queries.account_in(s, program.user_id, realm)
        if account is None or account.disabled:
            raise OAuthError("invalid_target", "the program's user has no account in that realm")
        user_id, full = account.id, account.full
    _keep(s, user_id, granted, now, program_id=program.id)
    _audit(s, full, "program", granted, address, now, program=program.key)


def _refresh(s: Session, old: str, new: str, wanted: Scope | None, now: float) -> IssuedToken | OAuthError:
    """The next tokens of a family; an error is returned, so that what it ended stays ended."""
    before = queries.issued(s, passwords.token_hash(old), now)
    if before is not None and before.kind == "refresh":
        error = _too_much(before, wanted)
        if error is not None:
            return error
    family = queries.refresh_family(s, passwords.token_hash(old), passwords.token_hash(new), now)
    if family is None or family.family_id is None:
        return OAuthError(
            "invalid_grant", "the refresh token is unknown, used before, expired or revoked; log in again"
        )
    own = None if family.scope is None else Scope(family.scope)
    granted = _new(wanted or own, new)
    _keep(s, family.user_id, granted, now, family_id=family.family_id)
    return granted


def _too_much(before: IssuedRecord, wanted: Scope | None) -> OAuthError | None:
    if wanted is None or before.scope is None or wanted.within(Scope(before.scope)):
        return None
    return OAuthError("invalid_scope", f"at most '{before.scope}' can be given here")


def _keep(s: Session, user_id: int, granted: IssuedToken, now: float, **belongs: int) -> None:
    queries.create_token(
        s,
        user_id,
        passwords.token_hash(granted.access_token),
        kind="access",
        label="oauth",
        expires=now + granted.expires_in,
        now=now,
        scope=_text(granted.scope),
        **belongs,
    )


def _audit(
    s: Session, user: str, how: str, granted: IssuedToken, address: str, now: float, **data: Any
) -> None:
    told = {"how": how, "scope": _text(granted.scope), **data}
    queries.append_audit(
        s, at=now, actor=f"user:{user}", action="token.issue", target=user, origin=address, data=told
    )


def _basic(header: str) -> tuple[str, str]:
    """Key and secret of ``Authorization: Basic`` (RFC 7617), form-encoded as RFC 6749 section 2.3.1 has it.

    :raises BadCredentials: it can't be read
    """
    try:
        text = base64.b64decode(header.partition(" ")[2].strip(), validate=True).decode()
    except (binascii.Error, UnicodeDecodeError):
        text = ""
    key, colon, secret = text.partition(":")
    if not colon:
        raise BadCredentials("the Authorization header can't be read as Basic")
    return unquote_plus(key), unquote_plus(secret)
