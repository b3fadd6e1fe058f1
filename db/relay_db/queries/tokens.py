"""Access tokens, browser sessions, one-time login links and tokens in URLs for Foxglove. Only hashes are stored."""

from __future__ import annotations

from collections.abc import Collection
from typing import Literal

from sqlalchemy import ColumnElement, Select, delete, insert, or_, select
from sqlalchemy.orm import Session

from relay_db.models import AccessToken, EnrolmentCode, LoginFailure, Realm, TokenFamily, User
from relay_db.names import checked_label, normalise_hex
from relay_db.queries.records import PrincipalRecord, TokenRecord, fetch_all, fetch_one
from relay_db.queries.revision import bump
from relay_db.queries.users import check_password_unchanged, live_user
from relay_protocol.errors import NotFound

TokenKind = Literal["access", "session", "login", "foxglove"]
_LOGIN: tuple[TokenKind, ...] = ("login",)


def create_token(
    s: Session,
    user_id: int,
    token_hash: str,
    *,
    kind: TokenKind,
    label: str = "",
    expires: float | None,
    now: float,
    scope: str | None = None,
    oauth_client_id: int | None = None,
    family_id: int | None = None,
    robot_id: int | None = None,
) -> int:
    """Store a new token; returns its number, which is never reused.

    :param token_hash: SHA-256 in hex
    :param expires: Unix seconds; ``None`` for never
    :param scope: limits the user's rights; ``None`` for no limit
    :param oauth_client_id: the OAuth client that it is issued to; it ends with that
    :param family_id: its token family; it ends with that
    :param robot_id: the only robot that it is for; it ends with that. Only ``foxglove`` has one
    :raises NotFound: no such user
    :raises Invalid: the label is not valid
    """
    if s.scalar(select(User.id).where(User.id == user_id)) is None:
        raise NotFound("there is no such user")
    values = {
        "user_id": user_id,
        "token_hash": token_hash,
        "kind": kind,
        "label": checked_label(label, "label of a token"),
        "created": now,
        "expires": expires,
        "scope": scope,
        "oauth_client_id": oauth_client_id,
        "family_id": family_id,
        "robot_id": robot_id,
    }
    return s.scalars(insert(AccessToken).values(**values).returning(AccessToken.id)).one()


def open_session(
    s: Session, user_id: int, token_hash: str, *, password_hash: str | None, expires: float, now: float
) -> int:
    """Store the token of a browser session, unless the user was changed while logging in.

    :param password_hash: the hash that was stored when the password was checked
    :raises Refused: another one is stored now, or the user was disabled or removed
    """
    check_password_unchanged(s, user_id, password_hash)
    return create_token(s, user_id, token_hash, kind="session", label="portal", expires=expires, now=now)


def principal_by_token(
    s: Session, token_hash: str, now: float, kinds: Collection[TokenKind] = ("access", "session")
) -> PrincipalRecord | None:
    """The user of a token.

    ``None`` if it is unknown, revoked, expired or of another kind, or if its user is disabled.
    """
    query = _principals(now).where(
        AccessToken.token_hash == normalise_hex(token_hash), AccessToken.kind.in_(tuple(kinds))
    )
    return fetch_one(s, PrincipalRecord, query)


def principals_by_ids(s: Session, token_ids: Collection[int], now: float) -> list[PrincipalRecord]:
    """The users of the tokens with these numbers, without tokens that have ended (:func:`token_is_live`)."""
    return fetch_all(s, PrincipalRecord, _principals(now).where(AccessToken.id.in_(token_ids)))


def consume_login(s: Session, token_hash: str, now: float) -> PrincipalRecord | None:
    """Use a login token, once; ``None`` if it is unknown, used or expired, or its user is disabled."""
    principal = principal_by_token(s, token_hash, now, kinds=_LOGIN)
    if principal is None:
        return None
    spent = delete(AccessToken).where(AccessToken.id == principal.token_id).returning(AccessToken.id)
    # Of two simultaneous logins only one deletes it.
    return principal if s.scalar(spent) is not None else None


def revoke_token(s: Session, token_id: int) -> bool:
    """Revoke a token and the refresh token of its family; false if there is none of this number."""
    bump(s)
    family = s.scalar(select(AccessToken.family_id).where(AccessToken.id == token_id))
    statement = delete(AccessToken).where(AccessToken.id == token_id).returning(AccessToken.id)
    found = s.scalar(statement) is not None
    if family is not None:
        s.execute(delete(TokenFamily).where(TokenFamily.id == family))
    return found


def list_tokens(s: Session, user_id: int | None = None) -> list[TokenRecord]:
    """All tokens, of one user or of all, oldest first; also expired ones until they are purged."""
    query = (
        select(
            AccessToken.id,
            AccessToken.user_id,
            User.name.label("user"),
            AccessToken.kind,
            AccessToken.label,
            AccessToken.created,
            AccessToken.expires,
            AccessToken.scope,
            AccessToken.robot_id,
        )
        .join(User, User.id == AccessToken.user_id)
        .order_by(AccessToken.id)
    )
    if user_id is not None:
        query = query.where(AccessToken.user_id == user_id)
    return fetch_all(s, TokenRecord, query)


def foxglove_tokens(
    s: Session, now: float, *, user_id: int | None = None, robot_id: int | None = None
) -> list[TokenRecord]:
    """Tokens in URLs for Foxglove that have not expired, of one user or robot or of all, oldest first."""
    return [
        each
        for each in list_tokens(s, user_id)
        if each.kind == "foxglove"
        and robot_id in (None, each.robot_id)
        and (each.expires is None or each.expires > now)
    ]


def token_is_live(s: Session, token_id: int, now: float) -> bool:
    """Whether a token exists and has not expired, and its user is not disabled."""
    live = (
        select(AccessToken.id)
        .join(User, User.id == AccessToken.user_id)
        .where(AccessToken.id == token_id, live_user(), _unexpired(now))
    )
    return s.scalar(live) is not None


def purge_expired(s: Session, now: float) -> int:
    """Delete expired tokens and failed logins, and expired or used enrolment codes; returns how many."""
    tokens = delete(AccessToken).where(AccessToken.expires <= now).returning(AccessToken.id)
    families = delete(TokenFamily).where(TokenFamily.expires <= now).returning(TokenFamily.id)
    codes = (
        delete(EnrolmentCode)
        .where(or_(EnrolmentCode.expires <= now, EnrolmentCode.used.is_not(None)))
        .returning(EnrolmentCode.id)
    )
    failures = delete(LoginFailure).where(LoginFailure.expires <= now).returning(LoginFailure.id)
    deleted = [len(s.scalars(each).all()) for each in (tokens, families, codes, failures)]
    if deleted[1]:
        # Access tokens that had not expired ended with their families.
        bump(s)
    return sum(deleted)


def _principals(now: float) -> Select[int, str, str, bool, int, float | None, str | None, int | None]:
    return (
        select(
            AccessToken.user_id,
            User.name,
            Realm.name.label("realm"),
            User.admin,
            AccessToken.id.label("token_id"),
            AccessToken.expires,
            AccessToken.scope,
            AccessToken.robot_id,
        )
        .join(User, User.id == AccessToken.user_id)
        .join(Realm, Realm.id == User.realm_id)
        .where(live_user(), _unexpired(now))
    )


def _unexpired(now: float) -> ColumnElement[bool]:
    return or_(AccessToken.expires.is_(None), AccessToken.expires > now)
