"""Names of people and groups, and text that is kept."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_db.names import label, normal_name, sanitise
from relay_protocol.errors import Invalid


@pytest.mark.parametrize(
    ("written", "name"),
    [("Ann", "ann"), ("ÅSA", "åsa"), ("Straße", "strasse"), ("ﬁn", "fin"), ("a.b", "a.b")],
)
def test_a_name_has_one_form(written: str, name: str) -> None:
    """Case and compatibility forms of a name are the same name."""
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
    """Blanks, control and direction characters, half characters and leading marks are refused in words."""
    with pytest.raises(Invalid, match="the name of a user must"):
        normal_name(name, "name of a user")


@given(st.text(max_size=70))
def test_the_form_of_a_name_is_final(text: str) -> None:
    """Normalising what was normalised changes nothing, or the name is refused."""
    try:
        name = normal_name(text)
    except Invalid:
        return
    assert normal_name(name) == name


def test_a_label_is_one_printable_line() -> None:
    """Labels are taken as they are or refused."""
    assert label("Lab 3, left", "label") == "Lab 3, left"
    for bad in ("two\nlines", "\x1b[2J", "a\ufffd", "x" * 256):
        with pytest.raises(Invalid, match="the label must be one printable line"):
            label(bad, "label")


@given(st.text(max_size=600), st.integers(min_value=8, max_value=300))
def test_recorded_text_is_printable_and_fits(text: str, length: int) -> None:
    """Whatever comes, what is kept is printable and no longer than its column."""
    kept = sanitise(text, length)
    assert kept.isprintable()
    assert len(kept) <= length


def test_recorded_text_shows_what_was_there() -> None:
    """Plain text stays; the rest is escaped; what was cut is marked."""
    assert sanitise("ann") == "ann"
    assert sanitise("a\x00\ud800\n") == "a\\x00\\ud800\\n"
    assert sanitise("x" * 20, 10) == "x" * 9 + "…"
