"""Access tokens, browser sessions and one-time login links; of each only the hash."""

from __future__ import annotations

from collections.abc import Collection
from typing import Literal

from sqlalchemy import ColumnElement, Select, delete, insert, or_, select
from sqlalchemy.orm import Session

from relay_db.models import AccessToken, EnrolmentCode, Realm, TokenFamily, User
from relay_db.names import findable_hex
from relay_db.names import label as checked_label
from relay_db.queries.records import PrincipalRecord, TokenRecord
from relay_db.queries.state import bump
from relay_db.queries.users import check_unchanged, live_user
from relay_protocol.errors import NotFound

TokenKind = Literal["access", "session", "login"]
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
    program_id: int | None = None,
    family_id: int | None = None,
) -> int:
    """Keep a new token and return its number, which is never given out again.

    :param token_hash: SHA-256 in hex
    :param expires: Unix seconds, None for never
    :param scope: what it may be used for; ``None`` for all that its user may
    :param program_id: the program it is given to, which it ends with
    :param family_id: the refresh token it comes of, which it ends with
    :raises NotFound: no such user
    :raises Invalid: the label can't be kept
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
        "program_id": program_id,
        "family_id": family_id,
    }
    return s.scalars(insert(AccessToken).values(**values).returning(AccessToken.id)).one()


def open_session(
    s: Session, user_id: int, token_hash: str, *, password_hash: str | None, expires: float, now: float
) -> int:
    """Keep the token of a browser session, unless its user's password was changed since it was looked at.

    :param password_hash: what was stored when the user was proved
    :raises Refused: another is stored now, or the user was disabled or removed
    """
    check_unchanged(s, user_id, password_hash)
    return create_token(s, user_id, token_hash, kind="session", label="portal", expires=expires, now=now)


def principal_by_token(
    s: Session, token_hash: str, now: float, kinds: Collection[TokenKind] = ("access", "session")
) -> PrincipalRecord | None:
    """Whom the token stands for.

    None if it is unknown, revoked, expired or of another kind, or if its user is disabled.
    """
    row = s.execute(
        _principals(now).where(
            AccessToken.token_hash == findable_hex(token_hash), AccessToken.kind.in_(tuple(kinds))
        )
    ).one_or_none()
    return None if row is None else PrincipalRecord(*row)


def principals_by_ids(s: Session, token_ids: Collection[int], now: float) -> list[PrincipalRecord]:
    """Whom tokens of these numbers stand for, of those that :func:`token_is_live` is true of."""
    return [PrincipalRecord(*row) for row in s.execute(_principals(now).where(AccessToken.id.in_(token_ids)))]


def consume_login(s: Session, token_hash: str, now: float) -> PrincipalRecord | None:
    """Use a login token up; None if it is unknown, used, expired, or its user disabled."""
    principal = principal_by_token(s, token_hash, now, kinds=_LOGIN)
    if principal is None:
        return None
    spent = delete(AccessToken).where(AccessToken.id == principal.token_id).returning(AccessToken.id)
    # Of two that found it, only one deletes it.
    return principal if s.scalar(spent) is not None else None


def revoke_token(s: Session, token_id: int) -> bool:
    """Make a token worthless at once; false if there is none of that number.

    With it goes the refresh token by which who has it would get another.
    """
    bump(s)
    family = s.scalar(select(AccessToken.family_id).where(AccessToken.id == token_id))
    gone = delete(AccessToken).where(AccessToken.id == token_id).returning(AccessToken.id)
    found = s.scalar(gone) is not None
    if family is not None:
        s.execute(delete(TokenFamily).where(TokenFamily.id == family))
    return found


def list_tokens(s: Session, user_id: int | None = None) -> list[TokenRecord]:
    """All tokens, of one user or of all, oldest first; expired ones too, until they are purged."""
    query = (
        select(
            AccessToken.id,
            User.id,
            User.name,
            AccessToken.kind,
            AccessToken.label,
            AccessToken.created,
            AccessToken.expires,
            AccessToken.scope,
        )
        .join(User, User.id == AccessToken.user_id)
        .order_by(AccessToken.id)
    )
    if user_id is not None:
        query = query.where(AccessToken.user_id == user_id)
    return [TokenRecord(*row) for row in s.execute(query)]


def token_is_live(s: Session, token_id: int, now: float) -> bool:
    """Whether the token is there, not expired, and its user not disabled."""
    live = (
        select(AccessToken.id)
        .join(User, User.id == AccessToken.user_id)
        .where(AccessToken.id == token_id, live_user(), _unexpired(now))
    )
    return s.scalar(live) is not None


def purge_expired(s: Session, now: float) -> int:
    """Drop tokens and enrolment codes that are of no use any more; how many."""
    tokens = delete(AccessToken).where(AccessToken.expires <= now).returning(AccessToken.id)
    families = delete(TokenFamily).where(TokenFamily.expires <= now).returning(TokenFamily.id)
    codes = (
        delete(EnrolmentCode)
        .where(or_(EnrolmentCode.expires <= now, EnrolmentCode.used.is_not(None)))
        .returning(EnrolmentCode.id)
    )
    gone = [len(s.scalars(each).all()) for each in (tokens, families, codes)]
    if gone[1]:
        # Tokens that had not expired ended with them.
        bump(s)
    return sum(gone)


def _principals(now: float) -> Select[int, str, str, bool, int, float | None, str | None]:
    return (
        select(
            User.id,
            User.name,
            Realm.name,
            User.admin,
            AccessToken.id,
            AccessToken.expires,
            AccessToken.scope,
        )
        .join(User, User.id == AccessToken.user_id)
        .join(Realm, Realm.id == User.realm_id)
        .where(live_user(), _unexpired(now))
    )


def _unexpired(now: float) -> ColumnElement[bool]:
    return or_(AccessToken.expires.is_(None), AccessToken.expires > now)
