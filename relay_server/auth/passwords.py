"""Secrets of people and programs: passwords, tokens, enrolment codes.

Passwords are kept as argon2id (RFC 9106; m = 19 MiB, t = 2, p = 1, as OWASP's cheat sheet on password storage
has it). Tokens and codes are random enough that a plain SHA-256 can't be searched.
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
"""The protection space of all programs' keys. Verifiers are made with it, so it is the same for all relays."""

CODE_ALPHABET = "23456789ABCDEFGHJKLMNPQRSTUVWXYZ"
"""32 characters, 5 bit each; without 0, 1, I and O, which are read for each other."""
_CODE_GROUPS = 4
_CODE_GROUP = 4


_loading = threading.Lock()


def hash_password(text: str) -> str:
    """Check a new password against the rules and return what may be stored of it. Takes some 30 ms.

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
    """Whether the password is the one that was hashed. Takes as long when there is nothing to compare with.

    :param hashed: what :func:`hash_password` returned; None for a user that is unknown or has no password
    """
    normal = _normal(text)
    if hashed is not None and normal is not None:
        try:
            return bool(_argon2().verify(normal, hashed))
        except ValueError:
            pass  # a damaged hash is like none
    _argon2().verify(normal or "", _nobody())
    return False


def prepare() -> None:
    """Load the library and make the dummy hash now, so that the first login takes no longer than others."""
    _nobody()


def new_token() -> str:
    """A token of 256 random bits, fit for a header or a URL."""
    return TOKEN_PREFIX + secrets.token_urlsafe(_TOKEN_BYTES)


def token_hash(text: str) -> str:
    """What is stored of a token, or of a normalised code: SHA-256 in hex."""
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def verifier(key: str, secret: str) -> str:
    """What is stored of a program's secret, by which Digest can be checked: H(A1) of RFC 7616 section 3.4.2."""
    return token_hash(f"{key}:{REALM}:{secret}")


def new_enrolment_code() -> str:
    """A code of 80 random bits to be read and typed: ``K7QF-92MB-X4TC-HW6P``."""
    groups = ("".join(secrets.choice(CODE_ALPHABET) for _ in range(_CODE_GROUP)) for _ in range(_CODE_GROUPS))
    return "-".join(groups)


def normalise_code(text: str) -> str:
    """A code as it was typed, without dashes and blanks, in capitals; hash this, not what was typed."""
    return "".join(character for character in text.upper() if character.isalnum())


def code_hash(text: str) -> str:
    """What is stored of an enrolment code, however it was typed."""
    return token_hash(normalise_code(text))


def _normal(text: str) -> str | None:
    """NFC, so that keyboards don't matter (RFC 8265, OpaqueString); None if it can't be a password."""
    normal = unicodedata.normalize("NFC", text[: MAX_BYTES + 1])
    try:
        fits = len(text) <= MAX_BYTES and len(normal.encode()) <= MAX_BYTES
    except UnicodeEncodeError:
        return None
    return normal if fits else None


@cache
def _argon2() -> Any:
    # The library loads its hashes, and what computes them, when first asked, and breaks when two threads ask at once.
    with _loading:
        from passlib.hash import argon2

        argon2.get_backend()
        return argon2.using(type="ID", memory_cost=19456, time_cost=2, parallelism=1)


@cache
def _nobody() -> str:
    hashed: str = _argon2().hash(secrets.token_urlsafe(_TOKEN_BYTES))
    return hashed
