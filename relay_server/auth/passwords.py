"""Passwords, tokens and enrolment codes, and their stored forms.

Passwords are stored as argon2id (RFC 9106; m = 19 MiB, t = 2, p = 1, as OWASP's cheat sheet on password
storage recommends). Tokens and codes are random enough that a plain SHA-256 cannot be searched.
"""

from __future__ import annotations

import hashlib
import secrets
import threading
import unicodedata
from functools import cache
from typing import Any

from relay_protocol.errors import Invalid

MIN_CHARACTERS = 8
MAX_BYTES = 1024

TOKEN_PREFIX = "swb_"  # noqa: S105 - lets people and scanners know a token when they see one
_TOKEN_BYTES = 32

REALM = "switchboard"
"""The protection space of all OAuth clients. It is the same on all relays, since H(A1) depends on it."""

CODE_ALPHABET = "23456789ABCDEFGHJKLMNPQRSTUVWXYZ"
"""32 characters, 5 bits each; without 0, 1, I and O, which are easily confused."""
_CODE_GROUPS = 4
_CODE_GROUP = 4


_loading = threading.Lock()


def hash_password(text: str) -> str:
    """Check a new password against the rules and return its hash. Takes about 30 ms.

    :raises Invalid: shorter than 8 characters, longer than 1024 bytes, or not text
    """
    normal = _normal(text)
    if normal is None:
        raise Invalid(f"the password must be Unicode text of at most {MAX_BYTES} bytes")
    if len(normal) < MIN_CHARACTERS:
        raise Invalid(f"the password must have at least {MIN_CHARACTERS} characters")
    hashed: str = _argon2().hash(normal)
    return hashed


def verify_password(text: str, hashed: str | None) -> bool:
    """Whether a password matches a hash. Takes as long when there is no hash.

    :param hashed: from :func:`hash_password`; ``None`` for a user that is unknown or has no password
    """
    normal = _normal(text)
    if hashed is not None and normal is not None:
        try:
            return bool(_argon2().verify(normal, hashed))
        except ValueError:
            pass  # a damaged hash is like none
    _argon2().verify(normal or "", _dummy_hash())
    return False


def prepare() -> None:
    """Load the library and make the dummy hash now, so that the first login takes no longer than others."""
    _dummy_hash()


def new_token() -> str:
    """A token of 256 random bits, safe for headers and URLs."""
    return TOKEN_PREFIX + secrets.token_urlsafe(_TOKEN_BYTES)


def token_hash(text: str) -> str:
    """The stored form of a token or a normalised code: SHA-256 in hexadecimal."""
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def digest_ha1(key: str, secret: str) -> str:
    """The stored form of an OAuth client's secret, which Digest needs: H(A1) of RFC 7616 section 3.4.2."""
    return token_hash(f"{key}:{REALM}:{secret}")


def new_enrolment_code() -> str:
    """A code of 80 random bits for people to read and type: ``K7QF-92MB-X4TC-HW6P``."""
    groups = ("".join(secrets.choice(CODE_ALPHABET) for _ in range(_CODE_GROUP)) for _ in range(_CODE_GROUPS))
    return "-".join(groups)


def normalise_code(text: str) -> str:
    """A typed code in capitals, without dashes and spaces. This form is hashed."""
    return "".join(character for character in text.upper() if character.isalnum())


def code_hash(text: str) -> str:
    """The stored form of an enrolment code, from any way of typing it."""
    return token_hash(normalise_code(text))


def _normal(text: str) -> str | None:
    """NFC, so that keyboards do not matter (RFC 8265, OpaqueString); ``None`` if it cannot be a password."""
    normal = unicodedata.normalize("NFC", text[: MAX_BYTES + 1])
    try:
        fits = len(text) <= MAX_BYTES and len(normal.encode()) <= MAX_BYTES
    except UnicodeEncodeError:
        return None
    return normal if fits else None


@cache
def _argon2() -> Any:
    # The library loads its parts when first used, and fails when two threads do that at once.
    with _loading:
        from passlib.hash import argon2

        argon2.get_backend()
        return argon2.using(type="ID", memory_cost=19456, time_cost=2, parallelism=1)


@cache
def _dummy_hash() -> str:
    hashed: str = _argon2().hash(secrets.token_urlsafe(_TOKEN_BYTES))
    return hashed
