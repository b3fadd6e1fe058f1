"""NaN and infinity in the form of Python's ``json``, in clients' messages."""

from __future__ import annotations

import json
import math
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol import nonfinite, rosbridge
from relay_protocol.errors import Invalid, MalformedMessage, SwitchboardError
from relay_protocol.nonfinite import NotFinite
from tests.worlds.growth import grows_linearly
from tests.worlds.ros_texts import LINE, registry

TYPES = registry(
    B="float32 x\nfloat64 y\nint64 whole\nuint8[] raw\nfloat32[] f\nfloat64[2] g\nstring text\nbool on\nN[] n\n"
    f"std_msgs/Header header\n{LINE}\nMSG: a/N\nfloat64 v\n"
    f"{LINE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
)
WORDS = st.text(max_size=4).filter(lambda word: word not in nonfinite.NUMBERS) | st.sampled_from(
    ["NaN", "-Infinity", '"NaN', "NaN\\", '\\"', "\\\\", "Infinity,"]
)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | WORDS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(WORDS, inner, max_size=4),
    max_leaves=12,
)


def message_of(msg: str) -> rosbridge.Publish:
    """The decoded ``publish`` with this body."""
    made = rosbridge.decode(f'{{"op":"publish","id":"q","topic":"/a","msg":{msg}}}'.encode())
    assert isinstance(made, rosbridge.Publish)
    return made


@given(VALUES, st.sampled_from([None, 1]), st.booleans())
def test_output_of_pythons_json_is_read_as_python_reads_it(
    value: Any, indent: int | None, ascii: bool
) -> None:
    """Also with strings that look like these literals."""
    text = json.dumps(value, indent=indent, ensure_ascii=ascii)
    try:
        body = bytes(message_of(text).msg)
    except MalformedMessage as error:
        assert "surrogate" in str(error) or "UTF-8" in str(error) or "range" in str(error)
        return
    assert repr(nonfinite.to_floats(json.loads(body))) == repr(value)


@given(VALUES)
def test_without_them_strict_json_is_left(value: Any) -> None:
    """They become null, and the rest is unchanged to the letter."""
    strict = json.dumps(_nulled(value), allow_nan=False)
    marked = nonfinite.mark(json.dumps(value).encode())
    assert nonfinite.marks_to_null(marked).decode() == strict


def _nulled(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, list):
        return [_nulled(each) for each in value]
    if isinstance(value, dict):
        return {name: _nulled(each) for name, each in value.items()}
    return value


@given(
    st.lists(
        st.sampled_from(['"', "\\", "NaN", "-", "Infinity", "{", "}", "[", "]", ":", ",", "1", " ", "a"])
    )
)
def test_junk_raises_only_protocol_errors(pieces: list[str]) -> None:
    """Accepted texts are JSON."""
    text = "".join(pieces)
    try:
        body = bytes(message_of(text).msg)
    except SwitchboardError:
        return
    json.loads(nonfinite.marks_to_null(body), parse_constant=lambda word: pytest.fail(word))


@pytest.mark.parametrize("piece", ['"",', '"\\"NaN",', "NaN,", '"\\\\', "-Infinity ", '"NaN', " " * 9, '\\"'])
def test_time_is_linear(piece: str) -> None:

    def read(text: bytes) -> None:
        with pytest.raises(MalformedMessage):
            rosbridge.decode(text)

    assert grows_linearly(
        read, lambda count: f'{{"op":"publish","topic":"/a","msg":[NaN,{piece * count}'.encode(), 100_000
    )


@pytest.mark.parametrize(
    ("msg", "reason"),
    [
        ('{"whole":NaN}', "a/msg/B: whole must be an integer, not NaN"),
        ('{"text":NaN}', "a/msg/B: text must be a string, not NaN"),
        ('{"on":Infinity}', "a/msg/B: on must be true or false, not Infinity"),
        ('{"raw":-Infinity}', "a/msg/B: raw must be an array or a base64 string, not -Infinity"),
        ('{"raw":[NaN]}', "a/msg/B: raw[0] must be an integer, not NaN"),
        ('{"n":NaN}', "a/msg/B: n must be an array, not NaN"),
        ('{"n":[{"v":1},NaN]}', "a/msg/B: n[1] must be an object, not NaN"),
        ("NaN", "a/msg/B must be an object, not NaN"),
        ('{"header":{"seq":1}}', "a/msg/B: header.seq is no field of std_msgs/msg/Header in ROS 2; leave it out"),
        ('{"header":{"stamp":"now"}}', 'a/msg/B: header.stamp must be an object, not a string: send '
         '{"sec": ..., "nanosec": ...}, or leave the stamp of a header out for the current time'),
    ],
)  # fmt: skip
def test_mismatched_field_is_refused_with_what_to_send_instead(msg: str, reason: str) -> None:
    """By field, with the client's own value."""
    with pytest.raises(Invalid) as caught:
        TYPES.from_json("a/msg/B", bytes(message_of(msg).msg), 0)
    assert str(caught.value) == reason


@pytest.mark.parametrize("base64", ["AQID", "AQ\\r\\nID", "AQ\\nID\\n", "\\nAQID"])
def test_base64_may_have_line_breaks(base64: str) -> None:
    """As mail encoders write it, RFC 2045 section 6.8."""
    cdr = TYPES.from_json("a/msg/B", bytes(message_of(f'{{"raw":"{base64}"}}').msg), 0)
    assert json.loads(TYPES.to_json("a/msg/B", cdr))["raw"] == "AQID"


@pytest.mark.parametrize(
    ("text", "reason", "id"),
    [
        ('{"op":"subscribe","id":"i","topic":NaN}', "topic: ", "i"),
        ('{"op":"subscribe","id":NaN,"topic":"/a"}', "id: ", None),
        ('{"op":"subscribe","id":7,"topic":"/a","throttle_rate":Infinity}', "throttle_rate: ", 7),
        ('{"op":NaN}', "op: ", None),
        ('{NaN:1,"op":"subscribe","id":"i","topic":"/a"}', "NaN: ", "i"),
        ('{"op":"advertise","topic":"/a","type":"a/B","qos":{"depth":NaN}}', "qos: ", None),
    ],
)  # fmt: skip
def test_outside_of_a_body_they_are_refused_with_a_reason(text: str, reason: str, id: rosbridge.Id) -> None:
    """The id is still found."""
    with pytest.raises(NotFinite) as caught:
        rosbridge.decode(text.encode())
    assert str(caught.value).startswith(f"{reason}NaN and infinity are not JSON")
    assert rosbridge.unreadable(text.encode()).id == id


def test_base64_of_more_than_a_mebibyte_may_hold_the_letters_of_a_literal() -> None:
    text = json.dumps({"data": "NaN" + "A" * 1_100_000}).encode()
    decoded = nonfinite.decode(msgspec.json.Decoder(dict[str, str]), text, ())
    assert decoded["data"].startswith("NaN")
