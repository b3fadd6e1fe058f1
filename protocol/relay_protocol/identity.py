"""A robot's proof of identity: an Ed25519 signature (RFC 8032) over purpose, relay, robot and nonce.

The private key never leaves the robot; the relay keeps the public half. A signature is valid for one nonce
of one connection, so it cannot be replayed.
"""

from __future__ import annotations

import hashlib
import re

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from relay_protocol.errors import Invalid
from relay_protocol.limits import ROBOT_NAME

NONCE_BYTES = 32
PUBLIC_KEY_BYTES = 32
_CONTEXT = b"switchboard robot link 1\x00"
_ROBOT_NAME = re.compile(r"[a-z0-9](?:[a-z0-9_-]*[a-z0-9])?\Z")


def check_robot_name(name: str) -> str:
    """A robot's name is part of URLs and logs: lower-case letters, digits, ``-`` and ``_`` inside.

    :raises Invalid: anything else, or longer than 63 characters
    """
    if len(name) > ROBOT_NAME or not _ROBOT_NAME.match(name):
        raise Invalid(
            "a robot's name has lower-case letters, digits, '-' and '_', begins and ends with a letter or "
            f"digit, and has at most {ROBOT_NAME} characters"
        )
    return name


def fingerprint(public_key: bytes) -> str:
    """Short name of a public key: the first 16 hex digits of its SHA-256."""
    return hashlib.sha256(public_key).hexdigest()[:16]


def proof_text(relay: str, robot: str, nonce: bytes) -> bytes:
    """The signed text. Each part follows its length, so no two triples give the same text."""
    parts = (relay.encode(), robot.encode(), nonce)
    return _CONTEXT + b"".join(len(part).to_bytes(2, "big") + part for part in parts)


def generate_key() -> bytes:
    """A new private key, 32 raw bytes."""
    return Ed25519PrivateKey.generate().private_bytes_raw()


def public_half(private_key: bytes) -> bytes:
    """The public key of a private one, 32 raw bytes each."""
    return Ed25519PrivateKey.from_private_bytes(private_key).public_key().public_bytes_raw()


def sign(private_key: bytes, relay: str, robot: str, nonce: bytes) -> bytes:
    """A robot's signature for a challenge."""
    return Ed25519PrivateKey.from_private_bytes(private_key).sign(proof_text(relay, robot, nonce))


def verify(public_key: bytes, relay: str, robot: str, nonce: bytes, signature: bytes) -> bool:
    """Whether the holder of this key signed this challenge."""
    try:
        Ed25519PublicKey.from_public_bytes(public_key).verify(signature, proof_text(relay, robot, nonce))
    except (InvalidSignature, ValueError):
        return False
    return True
