"""Passwords, tokens and codes."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from relay_protocol.errors import Invalid
from relay_server.auth import passwords

PASSWORD = "correct horse"


@pytest.fixture(scope="module")
def hashed() -> str:
    """The hash of the test password."""
    return passwords.hash_password(PASSWORD)


def test_a_hash_is_argon2id_with_the_settings_promised(hashed: str) -> None:
    """19 MiB, two passes, one lane, and a random salt."""
    assert hashed.startswith("$argon2id$v=19$m=19456,t=2,p=1$")
    assert passwords.hash_password(PASSWORD) != hashed


def test_only_the_right_password_verifies(hashed: str) -> None:
    """Other, longer and shorter ones do not."""
    assert passwords.verify_password(PASSWORD, hashed)
    for wrong in ("", "correct hors", PASSWORD + " ", PASSWORD.upper()):
        assert not passwords.verify_password(wrong, hashed)


@pytest.mark.parametrize("text", ["", "x" * 100_000, "\ud800 half", "a\x00b"])
def test_any_text_can_be_tried(hashed: str, text: str) -> None:
    """A text that cannot be a password is wrong, not an error."""
    assert not passwords.verify_password(text, hashed)


@pytest.mark.parametrize("stored", [None, "", "no hash", "$argon2id$v=19$broken", "plain:correct horse"])
def test_without_a_usable_hash_nothing_verifies(stored: str | None) -> None:
    """Unknown users, users without a password and damaged rows verify as false, without an error."""
    assert not passwords.verify_password(PASSWORD, stored)


def test_an_unknown_user_costs_one_verification(monkeypatch: pytest.MonkeyPatch, hashed: str) -> None:
    """The work is the same for known and unknown users; it is counted, not timed."""
    passwords.prepare()
    scheme = passwords._argon2()
    work: list[str] = []

    class Counting:
        @staticmethod
        def verify(text: str, stored: str) -> bool:
            work.append(stored.rsplit("$", 2)[0])
            return bool(scheme.verify(text, stored))

    monkeypatch.setattr(passwords, "_argon2", lambda: Counting)
    for text, stored in ((PASSWORD, hashed), ("wrong", hashed), ("wrong", None), ("x" * 5000, None)):
        passwords.verify_password(text, stored)
    assert work == ["$argon2id$v=19$m=19456,t=2,p=1"] * 4


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("seven c", "at least 8 characters"),
        ("", "at least 8 characters"),
        ("x" * 1025, "at most 1024 bytes"),
        ("ü" * 513, "at most 1024 bytes"),
        ("\ud800 half a character", "Unicode text"),
    ],
)
def test_a_password_against_the_rules_is_refused(text: str, words: str) -> None:
    with pytest.raises(Invalid, match=words):
        passwords.hash_password(text)


def test_passwords_at_the_limits_are_taken() -> None:
    """Eight characters and 1024 bytes are allowed."""
    for text in ("12345678", "ü" * 512):
        assert passwords.verify_password(text, passwords.hash_password(text))


def test_the_keyboard_does_not_matter() -> None:
    """A composed and a decomposed letter are the same."""
    assert passwords.verify_password("cafe\u0301 cafe\u0301", passwords.hash_password("caf\u00e9 caf\u00e9"))


def test_tokens_are_long_random_and_recognisable() -> None:
    """256 bits after the prefix, in URL-safe characters."""
    tokens = {passwords.new_token() for _ in range(100)}
    assert len(tokens) == 100
    for token in tokens:
        assert token.startswith("swb_")
        assert len(token) == 4 + 43
        assert token.replace("-", "").replace("_", "").isalnum()


def test_a_token_hash_is_sha256() -> None:
    assert passwords.token_hash("abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert len(passwords.token_hash("\ud800")) == 64


def test_codes_have_80_bit_without_look_alikes() -> None:
    """Sixteen of 32 characters, in groups of four."""
    assert len(set(passwords.CODE_ALPHABET)) == 32
    assert not set("01IO") & set(passwords.CODE_ALPHABET)
    codes = {passwords.new_enrolment_code() for _ in range(100)}
    assert len(codes) == 100
    for code in codes:
        assert [len(group) for group in code.split("-")] == [4, 4, 4, 4]
        assert set(code) <= {*passwords.CODE_ALPHABET, "-"}


@pytest.mark.parametrize("typed", ["K7QF-92MB-X4TC-HW6P", "k7qf92mbx4tchw6p", " k7qf 92mb-X4TC\thw6p\n"])
def test_a_code_is_taken_however_it_is_typed(typed: str) -> None:
    """Case, dashes and blanks do not matter."""
    assert passwords.normalise_code(typed) == "K7QF92MBX4TCHW6P"
    assert passwords.code_hash(typed) == passwords.token_hash("K7QF92MBX4TCHW6P")


AT_ONCE = """
import sys, threading
from relay_server.auth import passwords
sys.setswitchinterval(1e-6)
together = threading.Barrier(8)
def first():
    together.wait()
    passwords.verify_password("correct horse", None)
    verified.append(1)
verified = []
threads = [threading.Thread(target=first) for _ in range(8)]
for each in threads:
    each.start()
for each in threads:
    each.join()
print(len(verified))
"""


def test_many_may_be_the_first_to_log_in() -> None:
    """Several logins begin at once in a process that has loaded no library yet."""
    environment = {"PYTHONPATH": os.pathsep.join(sys.path)}
    ran = subprocess.run(
        [sys.executable, "-c", AT_ONCE], env=environment, capture_output=True, text=True, check=True
    )
    assert (ran.stdout, ran.stderr) == ("8\n", "")
