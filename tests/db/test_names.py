"""Names of users and groups, and stored text."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_db.names import checked_label, normal_name, sanitise
from relay_protocol.errors import Invalid


@pytest.mark.parametrize(
    ("written", "name"),
    [("Ann", "ann"), ("ÅSA", "åsa"), ("Straße", "strasse"), ("ﬁn", "fin"), ("a.b", "a.b")],
)
def test_a_name_has_one_form(written: str, name: str) -> None:
    """Case and compatibility forms count as the same name."""
    assert normal_name(written) == name


@pytest.mark.parametrize(
    "name",
    [
        "",
        "a b",
        "a\tb",
        "a\nb",
        "a\x00b",
        "a\x1b[31m",
        "a\u202eb",
        "a\u200bb",
        "\ud800",
        "a\ufffd",
        "@lab",
        "a@b.c",
        "a\uff20b",
        "-x",
        "a" * 64,
        "a" + "\u0316\u0300" * 64,
    ],
)
def test_a_name_that_cannot_be_is_refused(name: str) -> None:
    """Blanks, control and direction characters, surrogates and leading marks are refused with a reason."""
    with pytest.raises(Invalid, match="the name of a user must"):
        normal_name(name, "name of a user")


@given(st.text(max_size=70))
def test_the_form_of_a_name_is_final(text: str) -> None:
    """Normalising again changes nothing, or the name is refused."""
    try:
        name = normal_name(text)
    except Invalid:
        return
    assert normal_name(name) == name


def test_a_label_is_one_printable_line() -> None:
    """Labels are stored unchanged or refused."""
    assert checked_label("Lab 3, left", "label") == "Lab 3, left"
    for bad in ("two\nlines", "\x1b[2J", "a\ufffd", "x" * 256):
        with pytest.raises(Invalid, match="the label must be one printable line"):
            checked_label(bad, "label")


@given(st.text(max_size=600), st.integers(min_value=8, max_value=300))
def test_recorded_text_is_printable_and_fits(text: str, length: int) -> None:
    kept = sanitise(text, length)
    assert kept.isprintable()
    assert len(kept) <= length


def test_sanitised_text_shows_escaped_characters() -> None:
    """Plain text stays; the rest is escaped; cuts are marked."""
    assert sanitise("ann") == "ann"
    assert sanitise("a\x00\ud800\n") == "a\\x00\\ud800\\n"
    assert sanitise("x" * 20, 10) == "x" * 9 + "…"
