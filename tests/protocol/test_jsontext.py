"""Strict JSON."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol import jsontext
from relay_protocol.errors import MalformedMessage
from relay_protocol.limits import JSON_DEPTH

SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text('ab"\\[]{}ß')
)
KEYS = st.text('k"\\[{', max_size=3)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3),
    max_leaves=12,
)


def depth_of(value: Any) -> int:
    """Nesting, counted on the decoded value."""
    if isinstance(value, dict):
        return 1 + max(map(depth_of, value.values()), default=0)
    if isinstance(value, list):
        return 1 + max(map(depth_of, value), default=0)
    return 0


@given(VALUES, st.integers(0, 6), st.booleans())
def test_depth_is_counted_exactly(value: Any, limit: int, ascii_only: bool) -> None:
    """A text is refused just when its value nests deeper than the limit; brackets in strings don't count."""
    text = json.dumps(value, ensure_ascii=ascii_only).encode()
    if depth_of(value) > limit:
        with pytest.raises(MalformedMessage, match="deeper than"):
            jsontext.check_text(text, limit)
    else:
        jsontext.check_text(text, limit)


@given(VALUES)
def test_sane_json_is_decoded(value: Any) -> None:
    """What other writers of JSON make is understood."""
    assert jsontext.decode_any(json.dumps(value).encode()) == value


@given(st.binary(max_size=80) | st.text('{}[]",:0123456789eE.+-truefalsn\\u ', max_size=80).map(str.encode))
def test_junk_raises_nothing_but_malformed(data: bytes) -> None:
    """Any bytes are a value or MalformedMessage."""
    try:
        value = jsontext.decode_any(data)
    except MalformedMessage:
        return
    assert value == json.loads(data)


@pytest.mark.parametrize("bracket", [b"[", b'{"a":'])
def test_a_hundred_thousand_levels_are_refused(bracket: bytes) -> None:
    """Depth can't exhaust the stack."""
    with pytest.raises(MalformedMessage, match=f"deeper than {JSON_DEPTH}"):
        jsontext.decode_any(bracket * 100_000)


def test_invalid_utf8_is_refused_even_where_nobody_looks() -> None:
    """A value that the decoder skips is checked too."""

    class Wanted(msgspec.Struct):
        a: int

    decoder = msgspec.json.Decoder(Wanted)
    assert jsontext.decode(decoder, b'{"a":1,"skipped":"x"}').a == 1
    with pytest.raises(MalformedMessage, match=r"not valid UTF-8 \(byte 19\)"):
        jsontext.decode(decoder, b'{"a":1,"skipped":"x\xff"}')


@pytest.mark.parametrize(
    "text", [b"NaN", b"[Infinity]", b"-Infinity", b'{"a":nan}', b"1 2", b"", b"\xef\xbb\xbf{}"]
)
def test_what_is_no_json_is_refused(text: bytes) -> None:
    """NaN, Infinity, trailing text, nothing at all and a byte order mark are not JSON."""
    with pytest.raises(MalformedMessage):
        jsontext.decode_any(text)


def test_a_number_of_five_thousand_digits_is_refused() -> None:
    """It is told to be out of range."""
    with pytest.raises(MalformedMessage, match="out of range"):
        jsontext.decode_any(b"[" + b"1" * 5000 + b"]")
