"""OAuth clients, and families of tokens that are refreshed (RFC 6749)."""

from __future__ import annotations

from sqlalchemy import Select, delete, insert, literal, null, or_, select, update
from sqlalchemy.orm import Session

from relay_db.models import AccessToken, OAuthClient, Realm, TokenFamily, User
from relay_db.names import checked_label, normalise, normalise_hex
from relay_db.queries.records import IssuedRecord, OAuthClientRecord, fetch_all, fetch_one, record_of
from relay_db.queries.revision import bump
from relay_db.queries.users import check_password_unchanged, live_user
from relay_protocol.errors import Invalid, NotFound

MAX_OAUTH_CLIENTS = 256
"""Most OAuth clients of one user."""

MAX_TOKEN_FAMILIES = 64
"""Most token families of one user; one more ends the oldest."""


def add_oauth_client(
    s: Session, user_id: int, key: str, digest_ha1: str, *, scope: str | None, label: str, now: float
) -> int:
    """Store a new OAuth client; returns its number, which is never reused.

    :param key: random, at most 64 characters
    :param digest_ha1: H(A1) of RFC 7616 section 3.4.2 by SHA-256, in hex
    :param scope: the widest scope of its tokens; ``None`` for no limit
    :raises NotFound: no such user
    :raises Invalid: the label is not valid, or the user has too many
    """
    if s.scalar(select(User.id).where(User.id == user_id)) is None:
        raise NotFound("there is no such user")
    if len(list_oauth_clients(s, user_id)) >= MAX_OAUTH_CLIENTS:
        raise Invalid(f"a user may have {MAX_OAUTH_CLIENTS} OAuth clients; remove some first")
    values = {
        "user_id": user_id,
        "key": key,
        "digest_ha1": digest_ha1,
        "scope": scope,
        "label": checked_label(label, "label of an OAuth client"),
        "created": now,
    }
    return s.scalars(insert(OAuthClient).values(**values).returning(OAuthClient.id)).one()


def find_oauth_client(s: Session, key: str) -> OAuthClientRecord | None:
    """The OAuth client with this key, unless its user is disabled."""
    query = _oauth_clients().where(OAuthClient.key == key, live_user())
    # The key comes from the network: text that the database may fail on must not reach it.
    row = s.execute(query).one_or_none() if key.isascii() and key.isprintable() else None
    return None if row is None else record_of(OAuthClientRecord, row)


def oauth_client_in(s: Session, key: str, realm: str) -> int | None:
    """The number of the OAuth client with this key, if its user belongs to the realm; also of a disabled user."""
    if not (key.isascii() and key.isprintable()):
        return None
    query = (
        select(OAuthClient.id)
        .join(User, User.id == OAuthClient.user_id)
        .join(Realm, Realm.id == User.realm_id)
    )
    return s.scalar(query.where(OAuthClient.key == key, Realm.name == normalise(realm)))


def list_oauth_clients(s: Session, user_id: int | None = None) -> list[OAuthClientRecord]:
    """All OAuth clients, of one user or of all, oldest first."""
    query = _oauth_clients().order_by(OAuthClient.id)
    if user_id is not None:
        query = query.where(OAuthClient.user_id == user_id)
    return fetch_all(s, OAuthClientRecord, query)


def remove_oauth_client(s: Session, oauth_client_id: int) -> bool:
    """Remove an OAuth client and the tokens issued to it; false if there is none of this number."""
    bump(s)
    statement = delete(OAuthClient).where(OAuthClient.id == oauth_client_id).returning(OAuthClient.id)
    return s.scalar(statement) is not None


def oauth_client_label(s: Session, token_id: int) -> str | None:
    """The label of the OAuth client that a token was issued to; ``None`` for other tokens."""
    return s.scalar(
        select(OAuthClient.label)
        .join(AccessToken, AccessToken.oauth_client_id == OAuthClient.id)
        .where(AccessToken.id == token_id)
    )


def open_token_family(
    s: Session,
    user_id: int,
    refresh_hash: str,
    *,
    password_hash: str | None,
    scope: str | None,
    expires: float,
    now: float,
) -> int:
    """Begin a family of tokens for a user who has just logged in; returns its number.

    :param password_hash: the hash that was stored when the password was checked
    :raises Refused: another one is stored now, or the user was disabled or removed
    """
    check_password_unchanged(s, user_id, password_hash)
    oldest = select(TokenFamily.id).where(TokenFamily.user_id == user_id).order_by(TokenFamily.id.desc())
    over = s.scalars(oldest.offset(MAX_TOKEN_FAMILIES - 1)).all()
    if over:
        bump(s)
        s.execute(delete(TokenFamily).where(TokenFamily.id.in_(over)))
    values = {
        "user_id": user_id,
        "scope": scope,
        "refresh_hash": refresh_hash,
        "created": now,
        "expires": expires,
    }
    return s.scalars(insert(TokenFamily).values(**values).returning(TokenFamily.id)).one()


def refresh_token_family(s: Session, refresh_hash: str, new_hash: str, now: float) -> IssuedRecord | None:
    """Replace a refresh token; ``None`` if it is not valid.

    A token that was replaced before is a copy: it ends the whole family (RFC 9700 section 4.14.2).
    """
    found = normalise_hex(refresh_hash)
    copied = s.scalar(delete(TokenFamily).where(TokenFamily.former_hash == found).returning(TokenFamily.id))
    if copied is not None:
        bump(s)
        return None
    live = select(User.id).where(User.id == TokenFamily.user_id, live_user()).exists()
    replaced = (
        update(TokenFamily)
        .where(TokenFamily.refresh_hash == found, TokenFamily.expires > now, live)
        .values(refresh_hash=new_hash, former_hash=found)
        .returning(TokenFamily.id)
    )
    # Of two simultaneous requests only one replaces it.
    family = s.scalar(replaced)
    return None if family is None else issued_token(s, new_hash, now)


def issued_token(s: Session, token_hash: str, now: float) -> IssuedRecord | None:
    """An access or refresh token (RFC 7662).

    ``None`` if it is unknown, expired or revoked, or its user disabled.
    """
    found = normalise_hex(token_hash)
    access = (
        select(
            literal("access").label("kind"),
            AccessToken.user_id,
            User.name.label("user"),
            Realm.name.label("realm"),
            AccessToken.scope,
            OAuthClient.key.label("client_id"),
            AccessToken.created,
            AccessToken.expires,
            AccessToken.family_id,
        )
        .join(User, User.id == AccessToken.user_id)
        .join(Realm, Realm.id == User.realm_id)
        .outerjoin(OAuthClient, OAuthClient.id == AccessToken.oauth_client_id)
        .where(
            AccessToken.token_hash == found,
            AccessToken.kind == "access",
            live_user(),
            or_(AccessToken.expires.is_(None), AccessToken.expires > now),
        )
    )
    refresh = (
        select(
            literal("refresh").label("kind"),
            TokenFamily.user_id,
            User.name.label("user"),
            Realm.name.label("realm"),
            TokenFamily.scope,
            null().label("client_id"),
            TokenFamily.created,
            TokenFamily.expires,
            TokenFamily.id.label("family_id"),
        )
        .join(User, User.id == TokenFamily.user_id)
        .join(Realm, Realm.id == User.realm_id)
        .where(TokenFamily.refresh_hash == found, TokenFamily.expires > now, live_user())
    )
    return fetch_one(s, IssuedRecord, access) or fetch_one(s, IssuedRecord, refresh)


def revoke_issued(s: Session, token_hash: str, realm: str, client_id: str | None = None) -> bool:
    """Revoke a token, with a refresh token its whole family (RFC 7009); false if there was none.

    :param realm: the realm that the token must belong to
    :param client_id: key of an OAuth client, whose own tokens may belong to any realm
    """
    found = normalise_hex(token_hash)
    users = select(User.id).join(Realm, Realm.id == User.realm_id).where(Realm.name == realm)
    token = delete(AccessToken).where(
        AccessToken.token_hash == found,
        AccessToken.kind == "access",
        or_(
            AccessToken.user_id.in_(users),
            AccessToken.oauth_client_id.in_(select(OAuthClient.id).where(OAuthClient.key == client_id)),
        ),
    )
    family = delete(TokenFamily).where(
        or_(TokenFamily.refresh_hash == found, TokenFamily.former_hash == found),
        TokenFamily.user_id.in_(users),
    )
    revoked = [
        s.scalar(token.returning(AccessToken.id)),
        s.scalar(family.returning(TokenFamily.id)),
    ]
    if not any(revoked):
        return False
    bump(s)
    return True


def _oauth_clients() -> Select[int, int, str, str, str, str, str | None, str, float]:
    return (
        select(
            OAuthClient.id,
            OAuthClient.user_id,
            User.name.label("user"),
            Realm.name.label("realm"),
            OAuthClient.key,
            OAuthClient.digest_ha1,
            OAuthClient.scope,
            OAuthClient.label,
            OAuthClient.created,
        )
        .join(User, User.id == OAuthClient.user_id)
        .join(Realm, Realm.id == User.realm_id)
    )
