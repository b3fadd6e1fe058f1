"""Programs with key and secret, and families of tokens that are refreshed (RFC 6749)."""

from __future__ import annotations

from sqlalchemy import Select, delete, insert, literal, null, or_, select, update
from sqlalchemy.orm import Session

from relay_db.models import AccessToken, OAuthClient, Realm, TokenFamily, User
from relay_db.names import findable_hex, normalise
from relay_db.names import label as checked_label
from relay_db.queries.records import IssuedRecord, OAuthClientRecord
from relay_db.queries.state import bump
from relay_db.queries.users import check_unchanged, live_user
from relay_protocol.errors import Invalid, NotFound

PROGRAMS_OF_ONE = 256
"""Programs one user may have."""

FAMILIES_OF_ONE = 64
"""Families of one user at a time; the oldest ends when there is one more."""


def add_program(
    s: Session, user_id: int, key: str, verifier: str, *, scope: str | None, label: str, now: float
) -> int:
    """Keep a new program and return its number, which is never given out again.

    :param key: 64 characters or fewer that nobody can guess or choose
    :param verifier: H(A1) of RFC 7616 section 3.4.2 by SHA-256, in hex
    :param scope: what its tokens may be used for at most; ``None`` for all that its user may
    :raises NotFound: no such user
    :raises Invalid: the label can't be kept, or the user has too many
    """
    if s.scalar(select(User.id).where(User.id == user_id)) is None:
        raise NotFound("there is no such user")
    if len(list_programs(s, user_id)) >= PROGRAMS_OF_ONE:
        raise Invalid(f"a user may have {PROGRAMS_OF_ONE} programs; remove some first")
    values = {
        "user_id": user_id,
        "key": key,
        "verifier": verifier,
        "scope": scope,
        "label": checked_label(label, "label of a program"),
        "created": now,
    }
    return s.scalars(insert(OAuthClient).values(**values).returning(OAuthClient.id)).one()


def find_program(s: Session, key: str) -> OAuthClientRecord | None:
    """The program of that key, unless its user is disabled."""
    query = _programs().where(OAuthClient.key == key, live_user())
    # Text from anyone: what can't be a key must not reach the database.
    row = s.execute(query).one_or_none() if key.isascii() and key.isprintable() else None
    return None if row is None else OAuthClientRecord(*row)


def program_in(s: Session, key: str, realm: str) -> int | None:
    """The number of the program of that key, if its user is of the realm; also while he is disabled."""
    if not (key.isascii() and key.isprintable()):
        return None
    query = (
        select(OAuthClient.id)
        .join(User, User.id == OAuthClient.user_id)
        .join(Realm, Realm.id == User.realm_id)
    )
    return s.scalar(query.where(OAuthClient.key == key, Realm.name == normalise(realm)))


def list_programs(s: Session, user_id: int | None = None) -> list[OAuthClientRecord]:
    """All programs, of one user or of all, oldest first."""
    query = _programs().order_by(OAuthClient.id)
    if user_id is not None:
        query = query.where(OAuthClient.user_id == user_id)
    return [OAuthClientRecord(*row) for row in s.execute(query)]


def remove_program(s: Session, program_id: int) -> bool:
    """Remove a program; the tokens it was given end with it. False if there is none of that number."""
    bump(s)
    gone = delete(OAuthClient).where(OAuthClient.id == program_id).returning(OAuthClient.id)
    return s.scalar(gone) is not None


def program_label(s: Session, token_id: int) -> str | None:
    """What the program is called that a token was given to; ``None`` for a token of no program."""
    return s.scalar(
        select(OAuthClient.label)
        .join(AccessToken, AccessToken.program_id == OAuthClient.id)
        .where(AccessToken.id == token_id)
    )


def open_family(
    s: Session,
    user_id: int,
    refresh_hash: str,
    *,
    password_hash: str | None,
    scope: str | None,
    expires: float,
    now: float,
) -> int:
    """Begin a family of tokens for a user who has just proved the password; its number.

    :param password_hash: what was stored when the user was proved
    :raises Refused: another is stored now, or the user was disabled or removed
    """
    check_unchanged(s, user_id, password_hash)
    oldest = select(TokenFamily.id).where(TokenFamily.user_id == user_id).order_by(TokenFamily.id.desc())
    over = s.scalars(oldest.offset(FAMILIES_OF_ONE - 1)).all()
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


def refresh_family(s: Session, refresh_hash: str, new_hash: str, now: float) -> IssuedRecord | None:
    """Replace a refresh token; what it stands for, or ``None`` if it is good for nothing.

    One that was replaced before is a copy: then the whole family ends.
    """
    found = findable_hex(refresh_hash)
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
    # Of two that come at once, only one replaces it.
    family = s.scalar(replaced)
    return None if family is None else issued(s, new_hash, now)


def issued(s: Session, token_hash: str, now: float) -> IssuedRecord | None:
    """What an access or a refresh token stands for (RFC 7662).

    ``None`` if it is unknown, expired or revoked, or its user disabled.
    """
    found = findable_hex(token_hash)
    access = (
        select(
            literal("access"),
            User.id,
            User.name,
            Realm.name,
            AccessToken.scope,
            OAuthClient.key,
            AccessToken.created,
            AccessToken.expires,
            AccessToken.family_id,
        )
        .join(User, User.id == AccessToken.user_id)
        .join(Realm, Realm.id == User.realm_id)
        .outerjoin(OAuthClient, OAuthClient.id == AccessToken.program_id)
        .where(
            AccessToken.token_hash == found,
            AccessToken.kind == "access",
            live_user(),
            or_(AccessToken.expires.is_(None), AccessToken.expires > now),
        )
    )
    refresh = (
        select(
            literal("refresh"),
            User.id,
            User.name,
            Realm.name,
            TokenFamily.scope,
            null(),
            TokenFamily.created,
            TokenFamily.expires,
            TokenFamily.id,
        )
        .join(User, User.id == TokenFamily.user_id)
        .join(Realm, Realm.id == User.realm_id)
        .where(TokenFamily.refresh_hash == found, TokenFamily.expires > now, live_user())
    )
    row = s.execute(access).one_or_none() or s.execute(refresh).one_or_none()
    return None if row is None else IssuedRecord(*row)


def revoke_issued(s: Session, token_hash: str, realm: str, program: str | None = None) -> bool:
    """Make a token worthless, with a refresh token all of its family (RFC 7009); false if there was none.

    :param realm: whose token it has to be
    :param program: key of the program to which it may have been given instead, in whatever realm
    """
    found = findable_hex(token_hash)
    users = select(User.id).join(Realm, Realm.id == User.realm_id).where(Realm.name == realm)
    token = delete(AccessToken).where(
        AccessToken.token_hash == found,
        AccessToken.kind == "access",
        or_(
            AccessToken.user_id.in_(users),
            AccessToken.program_id.in_(select(OAuthClient.id).where(OAuthClient.key == program)),
        ),
    )
    family = delete(TokenFamily).where(
        or_(TokenFamily.refresh_hash == found, TokenFamily.former_hash == found),
        TokenFamily.user_id.in_(users),
    )
    gone = [
        s.scalar(token.returning(AccessToken.id)),
        s.scalar(family.returning(TokenFamily.id)),
    ]
    if not any(gone):
        return False
    bump(s)
    return True


def _programs() -> Select[int, int, str, str, str, str, str | None, str, float]:
    return (
        select(
            OAuthClient.id,
            User.id,
            User.name,
            Realm.name,
            OAuthClient.key,
            OAuthClient.verifier,
            OAuthClient.scope,
            OAuthClient.label,
            OAuthClient.created,
        )
        .join(User, User.id == OAuthClient.user_id)
        .join(Realm, Realm.id == User.realm_id)
    )
