"""Strict JSON."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import orjson
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relay_protocol import jsontext, rosbridge
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
    """A text is refused exactly if its value nests deeper than the limit; brackets in strings do not count."""
    text = json.dumps(value, ensure_ascii=ascii_only).encode()
    if depth_of(value) > limit:
        with pytest.raises(MalformedMessage, match="deeper than"):
            jsontext.check_text(text, limit)
    else:
        jsontext.check_text(text, limit)


@given(VALUES)
def test_sane_json_is_decoded(value: Any) -> None:
    """Output of other JSON writers is accepted."""
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
    """Depth cannot exhaust the stack."""
    with pytest.raises(MalformedMessage, match=f"deeper than {JSON_DEPTH}"):
        jsontext.decode_any(bracket * 100_000)


def test_invalid_utf8_is_refused_even_in_unused_fields() -> None:
    """Values that the decoder skips are checked too."""

    class Wanted(msgspec.Struct):
        a: int

    decoder = msgspec.json.Decoder(Wanted)
    assert jsontext.decode(decoder, b'{"a":1,"skipped":"x"}').a == 1
    with pytest.raises(MalformedMessage, match=r"not valid UTF-8 \(byte 19\)"):
        jsontext.decode(decoder, b'{"a":1,"skipped":"x\xff"}')


@pytest.mark.parametrize(
    "text", [b"NaN", b"[Infinity]", b"-Infinity", b'{"a":nan}', b"1 2", b"", b"\xef\xbb\xbf{}"]
)
def test_invalid_json_is_refused(text: bytes) -> None:
    """NaN, Infinity, trailing text, empty text and a byte order mark are not JSON."""
    with pytest.raises(MalformedMessage):
        jsontext.decode_any(text)


def test_a_number_of_five_thousand_digits_is_refused() -> None:
    """The error says that it is out of range."""
    with pytest.raises(MalformedMessage, match="out of range"):
        jsontext.decode_any(b"[" + b"1" * 5000 + b"]")


@pytest.mark.parametrize(
    "text", [b"1" * 400, b"-" + b"1" * 400, b"2" * 309, b"1e999", b"[1,%s]" % (b"1" * 400)]
)
def test_a_number_that_no_double_can_hold_is_refused(text: bytes) -> None:
    """In any notation; the longest that fits is accepted."""
    with pytest.raises(MalformedMessage):
        jsontext.decode_any(text)
    for fits in (b"1" * 309, b"1" * 400 + b"e-300", b'"%s"' % (b"1" * 400)):
        jsontext.decode_any(fits)


class Skipping(msgspec.Struct):
    """Reads one field, keeps another undecoded, skips the rest."""

    kept: msgspec.Raw


SKIPPING = msgspec.json.Decoder(Skipping)
PIECES = st.sampled_from(
    [*'{}[]",:0123456789eE.+-', "true", "false", "null", "NaN", "\\", "\\u", "d800", "\\udc00", "\\n", "\n", "\x01",
     '"a"', '"a":', " ", "1e5", "0", "-", "ß", "\\x", "/", "\x7f"]
)  # fmt: skip


@given(
    st.sampled_from([b'{"kept":%s}', b'{"kept":1,"skipped":%s}', b'{"skipped":[%s],"kept":1}']),
    st.lists(PIECES, max_size=12).map("".join) | VALUES.map(json.dumps),
)
@settings(max_examples=150)
def test_undecoded_parts_are_valid_json(around: bytes, inside: str) -> None:
    """Passing on a part of a checked text cannot pass on invalid JSON, except for the size of numbers."""
    data = around % inside.encode()
    try:
        value = json.loads(data, parse_constant=_no)
        sane = "kept" in value
    except ValueError:
        sane = False
    try:
        found: Any = jsontext.decode(SKIPPING, data).kept
        taken = True
    except MalformedMessage:
        taken = False
    if taken:
        assert sane, data
        json.loads(bytes(found), parse_constant=_no)
    elif sane:
        # Python's parser accepts lone surrogates, which are no characters.
        assert "\\u" in inside


def _no(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


DIGITS = st.text("0123456789", min_size=1, max_size=20)
NUMBERS = st.builds(
    "".join,
    st.tuples(
        st.sampled_from(["", "-"]),
        st.one_of(
            st.just("0"), st.builds("{}{}".format, st.integers(1, 9), st.one_of(DIGITS, st.just("9" * 307)))
        ),
        st.one_of(st.just(""), st.builds(".{}".format, DIGITS)),
        st.one_of(
            st.just(""),
            st.builds("{}{}{}".format, st.sampled_from("eE"), st.sampled_from(["", "+", "-"]), DIGITS),
        ),
    ),
)
JSON = st.recursive(
    st.one_of(NUMBERS, st.sampled_from(["true", "null", '"e5"', '"\\ud800"', "1e400", "-1E309", "NaN"])),
    lambda each: st.one_of(
        st.lists(each, max_size=3).map(lambda some: f"[{','.join(some)}]"),
        st.lists(each, max_size=3).map(lambda some: "{" + ",".join(f'"e":{one}' for one in some) + "}"),
    ),
    max_leaves=5,
)


@given(JSON, st.text('0123456789eE+-.,[]{}"', max_size=3), st.integers(0, 1000))
@settings(max_examples=250)
def test_json_without_extremes_takes_the_fast_reader(text: str, junk: str, at: int) -> None:
    """JSON that msgspec has skipped and that seems to have no number too large is accepted by orjson and
    json.
    """
    at %= len(text) + 1
    body = (text[:at] + junk + text[at:]).encode()
    try:
        message = rosbridge.decode(b'{"op":"publish","topic":"/x","msg":' + body + b"}")
    except MalformedMessage:
        return
    assert isinstance(message, rosbridge.Publish)
    body = bytes(message.msg)
    if jsontext.in_range(body):
        orjson.loads(body)
        json.loads(body, parse_float=jsontext._in_range, parse_int=jsontext._in_range)


@pytest.mark.parametrize(
    "usual", [b"0.5", b"-12", b"1e-05", b"1.5e-300", b'{"linear":{"x":0.1}}', b"9" * 308]
)
def test_usual_numbers_are_known_at_a_glance(usual: bytes) -> None:
    """Otherwise every message would be parsed once more."""
    assert jsontext.in_range(usual)


@pytest.mark.parametrize("large", [b"1e5", b"1e+400", b"1E400", b"-1e309", b"9" * 309, b"0.1e999"])
def test_possibly_too_large_numbers_are_read(large: bytes) -> None:
    """The parser decides."""
    assert not jsontext.in_range(large)


@pytest.mark.parametrize("text", [b"}" * 3000, b'{"a":1}}' + b" " * 3000, b'{"a":"' + b"x" * 3000 + b'"}}'])
def test_a_long_text_with_too_many_closing_brackets_is_malformed(text: bytes) -> None:
    with pytest.raises(MalformedMessage, match="not JSON"):
        jsontext.check_keys(text)
