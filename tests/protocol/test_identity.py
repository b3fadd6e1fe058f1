"""A robot's proof of its identity."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol import identity
from relay_protocol.errors import Invalid

KEY = bytes(range(32))
PUBLIC = identity.public_half(KEY)
NONCE = bytes(32)
NAMES = st.text(max_size=6)


def test_a_proof_is_good_for_its_own_challenge_only() -> None:
    """Another relay, robot, nonce or key makes it invalid."""
    proof = identity.sign(KEY, "relay", "robot", NONCE)
    assert identity.verify(PUBLIC, "relay", "robot", NONCE, proof)
    assert not identity.verify(PUBLIC, "relay2", "robot", NONCE, proof)
    assert not identity.verify(PUBLIC, "relay", "robot2", NONCE, proof)
    assert not identity.verify(PUBLIC, "relay", "robot", b"\1" * 32, proof)
    assert not identity.verify(identity.public_half(b"\1" * 32), "relay", "robot", NONCE, proof)


@given(NAMES, NAMES, st.binary(max_size=4), NAMES, NAMES, st.binary(max_size=4))
def test_no_two_challenges_have_the_same_text(a: str, b: str, c: bytes, d: str, e: str, f: bytes) -> None:
    """The signed text cannot be read as another relay, robot and nonce."""
    assert (identity.proof_text(a, b, c) == identity.proof_text(d, e, f)) == ((a, b, c) == (d, e, f))


@given(st.binary(max_size=80), st.binary(max_size=40))
def test_junk_is_no_proof(signature: bytes, key: bytes) -> None:
    """Signatures and keys of any length are refused without an exception."""
    assert not identity.verify(PUBLIC, "relay", "robot", NONCE, signature)
    assert not identity.verify(key, "relay", "robot", NONCE, bytes(64))


def test_keys_are_32_raw_bytes_and_new_each_time() -> None:
    """Private and public keys have the size in the contract."""
    first, second = identity.generate_key(), identity.generate_key()
    assert first != second
    assert len(first) == len(identity.public_half(first)) == 32


@pytest.mark.parametrize("name", ["a", "r2-d2", "robot_1", "9", "a" * 63])
def test_good_robot_names(name: str) -> None:
    """Lower case, digits, '-' and '_' inside."""
    assert identity.check_robot_name(name) == name


@pytest.mark.parametrize(
    "name", ["", "A", "-a", "a-", "_a", "a b", "a/b", "a\n", "ä", "a" * 64, "a.b", "..", "²"]
)
def test_bad_robot_names(name: str) -> None:
    """Names that could confuse a URL, a path or a log are refused."""
    with pytest.raises(Invalid, match="a robot's name"):
        identity.check_robot_name(name)
