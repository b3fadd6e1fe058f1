"""CDR to JSON and back, for invented types; other files compare the installed ones with rclpy."""

from __future__ import annotations

import base64
import json
import math
import struct
import tracemalloc
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol.errors import Invalid
from tests.worlds.ros_texts import LINE, registry

HEADER = "builtin_interfaces/Time stamp\nstring frame_id"
STAMPED = f"std_msgs/Header header\nint8 a\n{LINE}\nMSG: std_msgs/Header\n{HEADER}"
EVERYTHING = f"""bool flag
byte octet
char letter
int8 i8
uint8 u8
int16 i16
uint16 u16
int32 i32
uint32 u32
int64 i64
uint64 u64
float32 f32
float64 f64
string text
wstring wide
string<=4 short
wstring<=3 wshort
uint8[] bytes
byte[3] octets
char[<=4] letters
bool[] flags
int8[2] pair
int16[] shorts
uint64[] longs
float32[] singles
float64[<=3] doubles
string[] texts
string<=2[2] two
wstring[] wides
Inner inner
Inner[2] inners
Inner[<=3] some
Empty nothing
Empty[] nothings
int64 last
{LINE}
MSG: a/Inner
uint8 tag
float64 value
string name
{LINE}
MSG: a/Empty
int32 CONSTANT=3
"""
ALL = registry(B=EVERYTHING)


def signed(bits: int) -> st.SearchStrategy[int]:
    """Integers with this many bits."""
    return st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def unsigned(bits: int) -> st.SearchStrategy[int]:
    """Unsigned integers with this many bits."""
    return st.integers(0, 2**bits - 1)


def encoded(least: int, most: int) -> st.SearchStrategy[str]:
    """Bytes in base64."""
    return st.binary(min_size=least, max_size=most).map(lambda data: base64.b64encode(data).decode())


TEXT = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=6)
FLOAT = st.floats(allow_nan=False, allow_infinity=False)
SINGLE = st.floats(allow_nan=False, allow_infinity=False, width=32)
INNER = st.fixed_dictionaries({"tag": unsigned(8), "value": FLOAT, "name": TEXT})
MESSAGE = st.fixed_dictionaries(
    {
        "flag": st.booleans(), "octet": unsigned(8), "letter": unsigned(8), "i8": signed(8),
        "u8": unsigned(8),
        "i16": signed(16), "u16": unsigned(16), "i32": signed(32), "u32": unsigned(32), "i64": signed(64),
        "u64": unsigned(64), "f32": SINGLE, "f64": FLOAT, "text": TEXT, "wide": TEXT,
        "short": st.text("abcd", max_size=4), "wshort": st.text("aß€", max_size=3), "bytes": encoded(0, 5),
        "octets": encoded(3, 3), "letters": encoded(0, 4), "flags": st.lists(st.booleans(), max_size=3),
        "pair": st.lists(signed(8), min_size=2, max_size=2), "shorts": st.lists(signed(16), max_size=3),
        "longs": st.lists(unsigned(64), max_size=3), "singles": st.lists(SINGLE, max_size=3),
        "doubles": st.lists(FLOAT, max_size=3), "texts": st.lists(TEXT, max_size=3),
        "two": st.lists(st.text("ab", max_size=2), min_size=2, max_size=2),
        "wides": st.lists(TEXT, max_size=3), "inner": INNER,
        "inners": st.lists(INNER, min_size=2, max_size=2), "some": st.lists(INNER, max_size=3),
        "nothing": st.just({}), "nothings": st.lists(st.just({}), max_size=3), "last": signed(64),
    }
)  # fmt: skip


def single(value: float) -> bytes:
    """Single precision has several spellings, so its bits are compared."""
    return struct.pack("f", value)


@given(MESSAGE)
def test_every_kind_of_field_survives(message: dict[str, Any]) -> None:
    """Written values are read unchanged, in both byte orders."""
    back = json.loads(ALL.to_json("a/msg/B", ALL.from_json("a/msg/B", message, 0)))
    assert list(map(single, back.pop("singles"))) == list(map(single, message["singles"]))
    assert back == {name: value for name, value in message.items() if name != "singles"}


@given(MESSAGE, st.data())
def test_a_cut_message_is_invalid(message: dict[str, Any], data: st.DataObject) -> None:
    """A truncated message is an error at every length, because its last field is a number."""
    cdr = ALL.from_json("a/msg/B", message, 0)
    with pytest.raises(Invalid, match="a/msg/B: "):
        ALL.to_json("a/msg/B", cdr[: data.draw(st.integers(0, len(cdr) - 1))])


@given(st.sampled_from([b"\0\0\0\0", b"\0\1\0\0", b""]), st.binary(max_size=400))
def test_junk_raises_nothing_but_invalid(head: bytes, body: bytes) -> None:
    """Any bytes are a message or Invalid, in either byte order."""
    try:
        json.loads(ALL.to_json("a/msg/B", head + body))
    except Invalid as error:
        assert str(error).startswith("a/msg/B: ")


@given(MESSAGE, st.integers(0, 2000), st.integers(0, 255))
def test_a_flipped_byte_raises_nothing_but_invalid(message: dict[str, Any], place: int, value: int) -> None:
    """A message damaged in one place is a message or Invalid."""
    cdr = bytearray(ALL.from_json("a/msg/B", message, 0))
    cdr[place % len(cdr)] = value
    try:
        json.loads(ALL.to_json("a/msg/B", bytes(cdr)))
    except Invalid as error:
        assert str(error).startswith("a/msg/B: ")


@pytest.mark.parametrize(
    "text", ["uint8[] x", "float64[] x", "string[] x", "string x", "wstring x", "Inner[] x", "E[] x"]
)
@pytest.mark.parametrize("head", [b"\0\0\0\0", b"\0\1\0\0"])
def test_a_huge_length_costs_nothing(text: str, head: bytes) -> None:
    """A length of 2^32-1 is refused without allocating memory."""
    types = registry(B=f"{text}\n{LINE}\nMSG: a/Inner\nint64 y\n{LINE}\nMSG: a/E\n")
    types.zero("a/msg/B")
    tracemalloc.start()
    try:
        with pytest.raises(Invalid, match="longer than the message"):
            types.to_json("a/msg/B", head + b"\xff\xff\xff\xff" + bytes(64))
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("text", ["E[] x", "string[] x", "F[] x"])
def test_small_bytes_can_not_become_a_million_objects(text: str) -> None:
    """16 MiB of tiny messages do not cost the relay gigabytes, nested or not."""
    contained = f"{LINE}\nMSG: a/E\n{LINE}\nMSG: a/F\nE[] e"
    types = registry(B=f"{text}\n{contained}")
    one = {"E": struct.pack("<I", 0), "s": struct.pack("<I", 0), "F": struct.pack("<I", 60) + bytes(60)}[
        text[0]
    ]
    cdr = b"\0\1\0\0" + struct.pack("<I", 300_000 if text[0] != "F" else 10_000) + one * 300_000
    tracemalloc.start()
    try:
        with pytest.raises(Invalid, match="more than 250000 messages and strings"):
            types.to_json("a/msg/B", cdr)
        assert tracemalloc.get_traced_memory()[1] < 100_000_000
    finally:
        tracemalloc.stop()


def test_few_bytes_of_json_can_not_become_a_huge_message() -> None:
    """A list of empty objects stands for defaults, whose size is limited."""
    types = registry(B=f"E[] x\n{LINE}\nMSG: a/E\nfloat64[100000] e", C="float64[] x")
    with pytest.raises(Invalid, match="x makes a message of more than 16777216 bytes"):
        types.from_json("a/msg/B", {"x": [{}] * 300_000}, 0)
    with pytest.raises(Invalid, match="a robot takes at most 16777199"):
        types.from_json("a/msg/C", {"x": [0] * 2_097_152}, 0)
    assert len(types.from_json("a/msg/C", {"x": [0] * 2_097_148}, 0)) < 16 * 1024 * 1024


def test_big_endian_is_read() -> None:
    """Numbers, arrays and lengths of robots with the other byte order."""
    types = registry(B="int16 a\nfloat64[] b\nwstring c\nuint8[] d\nint64[2] e")
    body = struct.pack(">h2xI d II I3sx 2q", -2, 1, 1.5, 1, 0xDF, 3, b"abc", 5, -6)
    value = json.loads(types.to_json("a/msg/B", b"\0\0\0\0" + body))
    assert value == {"a": -2, "b": [1.5], "c": "ß", "d": "YWJj", "e": [5, -6]}


def test_numbers_json_lacks_become_null_and_null_becomes_nan() -> None:
    """JSON has no NaN and infinity; a null in a float is NaN."""
    types = registry(B="float64 a\nfloat32[] b\nfloat64[2] c")
    cdr = b"\0\1\0\0" + struct.pack("<dI2f4x2d", math.nan, 2, math.inf, 1, -math.inf, 2)
    assert types.to_json("a/msg/B", cdr) == b'{"a":null,"b":[null,1.0],"c":[null,2.0]}'
    back = types.from_json("a/msg/B", b'{"a":null,"b":[null,1.0],"c":[null,2.0]}', 0)
    numbers = struct.unpack("<dI2f4x2d", back[4:])
    assert [math.isnan(number) for number in numbers] == [True, False, True, False, True, False]


def test_strings_that_are_no_utf8_are_shown_with_marks() -> None:
    """One faulty node does not hide a whole message."""
    types = registry(B="string a\nstring b")
    cdr = b"\0\1\0\0" + struct.pack("<I3sxI", 3, b"\xffa\0", 0)
    assert json.loads(types.to_json("a/msg/B", cdr)) == {"a": "\ufffda", "b": ""}


@pytest.mark.parametrize("head", [b"", b"\0", b"\0\1\0", b"\0\3\0\0", b"\1\0\0\0", b"\0\x0a\0\0"])
def test_other_encodings_are_refused(head: bytes) -> None:
    """Parameter lists and XCDR2 are not plain CDR."""
    with pytest.raises(Invalid, match="a/msg/B: "):
        registry(B="int8 a").to_json("a/msg/B", head)


def test_defaults_of_the_definition_are_used() -> None:
    """A missing field has the default of the definition."""
    text = "float64 w 1.0\nint8[] l [1, 2]\nstring s 'x'\nuint8[2] b [7, 8]\nfloat32[3] z\n"
    text += "wstring u ß\nbool t true"
    value = json.loads(registry(B=text).to_json("a/msg/B", registry(B=text).zero("a/msg/B")))
    assert value == {"w": 1.0, "l": [1, 2], "s": "x", "b": "Bwg=", "z": [0, 0, 0], "u": "ß", "t": True}


@pytest.mark.parametrize(
    ("field", "value", "problem"),
    [
        ("f64", '"1"', "f64 must be a number, not a string"),
        ("f64", "true", "f64 must be a number, not a boolean"),
        ("f64", "1" * 5000, "out of range"),
        ("f64", "1" * 400, "out of range"),
        ("f32", "1e39", "f32 is out of range for float32"),
        ("singles", "[1, 1e39]", "singles[1] is out of range for float32"),
        ("i32", "2147483648", "i32 is out of range for int32"),
        ("u8", "-1", "u8 is out of range for uint8"),
        ("u64", "18446744073709551616", "u64 is out of range for uint64"),
        ("i8", "1.5", "i8 must be an integer, not a fraction"),
        ("i8", "null", "i8 must be an integer, not null"),
        ("flag", "1", "flag must be true or false, not a number"),
        ("flags", "[true, 0]", "flags[1] must be true or false, not a number"),
        ("text", "5", "text must be a string, not a number"),
        ("text", '"a\\u0000b"', "text must not hold a NUL character"),
        ("short", '"12345"', "short must have at most 4 bytes of UTF-8, not 5"),
        ("wshort", '"1234"', "wshort must have at most 3 characters, not 4"),
        ("bytes", '"#"', "bytes is a string that is not base64"),
        ("bytes", "[256]", "bytes[0] is out of range for uint8"),
        ("bytes", "5", "bytes must be an array or a base64 string, not a number"),
        ("octets", '"YQ=="', "octets must have exactly 3 elements, not 1"),
        ("octets", "[1, 2]", "octets must have exactly 3 elements, not 2"),
        ("letters", '"YWJjZGU="', "letters must have at most 4 elements, not 5"),
        ("doubles", "[1, 2, 3, 4]", "doubles must have at most 3 elements, not 4"),
        ("doubles", '[1, "2"]', "doubles[1] must be a number, not a string"),
        ("doubles", '"AAAA"', "doubles must be an array, not a string"),
        ("two", '["a", "bcd"]', "two[1] must have at most 2 bytes"),
        ("inner", "[]", "inner must be an object, not an array"),
        ("inner", '{"value": "x"}', "inner.value must be a number, not a string"),
        ("some", '[{}, {"tag": 300}]', "some[1].tag is out of range for uint8"),
        ("inner", '{"colour": 1}', "inner.colour is no field of a/msg/Inner"),
        ("nothing", '{"x": 1}', "nothing.x is no field of a/msg/Empty, which has none"),
        ("nothing", "null", "nothing must be an object, not null"),
        ("what", "1", "what is no field of a/msg/B"),
        ("x" * 500, "1", "is no field of a/msg/B"),
        ("f64", "NaN", "not JSON"),
    ],
)
def test_mismatched_field_is_named(field: str, value: str, problem: str) -> None:
    """The error has the type, the path and the reason in one short sentence."""
    with pytest.raises(Invalid) as caught:
        ALL.from_json("a/msg/B", f'{{"{field}": {value}}}'.encode(), 0)
    assert str(caught.value).startswith("a/msg/B: ")
    assert problem in str(caught.value)
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("body", [b"[]", b"1", b"null", b'"x"', b"", b"{", b"\xff"])
def test_a_message_is_an_object(body: bytes) -> None:
    """Other values are refused."""
    with pytest.raises(Invalid, match="a/msg/B"):
        ALL.from_json("a/msg/B", body, 0)


@given(
    st.recursive(
        st.none() | st.integers() | st.floats() | st.text(max_size=3),
        lambda inner: st.lists(inner, max_size=3),
    )
)
def test_any_value_in_any_field_raises_nothing_but_invalid(value: Any) -> None:
    """For any value in any place."""
    for field in json.loads(ALL.to_json("a/msg/B", ALL.zero("a/msg/B"))):
        for wrapped in (value, {"value": value}, [{"name": value}]):
            try:
                ALL.to_json("a/msg/B", ALL.from_json("a/msg/B", {field: wrapped}, 0))
            except Invalid as error:
                assert str(error).startswith(f"a/msg/B: {field}")


def test_whole_numbers_may_be_written_with_a_point() -> None:
    """2.0 is an integer in JSON."""
    assert registry(B="int8 a").from_json("a/msg/B", b'{"a":2.0}', 0) == b"\0\1\0\0\x02"


def test_byte_arrays_come_as_base64_or_list() -> None:
    """Both give the same bytes."""
    types = registry(B="uint8[] a")
    assert types.from_json("a/msg/B", b'{"a":"YWI="}', 0) == types.from_json("a/msg/B", b'{"a":[97,98]}', 0)


NOW = 1_700_000_000_123_456_789


@pytest.mark.parametrize("body", [{}, {"header": {}}, {"header": {"frame_id": "map"}}])
def test_a_header_without_stamp_gets_the_present_time(body: dict[str, Any]) -> None:
    """Clients need no clock."""
    types = registry(B=STAMPED)
    value = json.loads(types.to_json("a/msg/B", types.from_json("a/msg/B", body, NOW)))
    assert value["header"]["stamp"] == {"sec": 1_700_000_000, "nanosec": 123_456_789}


@pytest.mark.parametrize(
    "stamp", [{"sec": 5, "nanosec": 6}, {"secs": 5, "nsecs": 6}, {"secs": 5, "nanosec": 6}]
)
def test_a_stamp_that_is_given_stays(stamp: dict[str, int]) -> None:
    """In the form of ROS 2 or of ROS 1."""
    types = registry(B=STAMPED)
    value = json.loads(
        types.to_json("a/msg/B", types.from_json("a/msg/B", {"header": {"stamp": stamp}}, NOW))
    )
    assert value["header"]["stamp"] == {"sec": 5, "nanosec": 6}


def test_zero_has_no_time() -> None:
    """The all-default message does not depend on the clock."""
    assert registry(B=STAMPED).zero("a/msg/B") == b"\0\1\0\0" + bytes(8) + b"\1\0\0\0\0" + b"\0"


@pytest.mark.parametrize("checked", [False, True])
@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b'{"a":1}x',
        b'{"a":"\xff"}',
        b'{"b":1}',
        b'{"a":NaN}',
        b'{"a":1e999}',
        [1],
        5,
    ],
)
def test_a_writer_raises_invalid_for_everything_but_messages(checked: bool, body: Any) -> None:
    """Texts and values, checked before or not."""
    with pytest.raises(Invalid, match="a/msg/B"):
        registry(B="string a").writer("a/msg/B", checked)(body, 0)


def test_a_writer_is_strict_unless_the_text_was_checked() -> None:
    """If the closures decode it, an unchecked text is checked as a whole."""
    types = registry(B="string a", C="\n".join(f"string f{number}" for number in range(1000)))
    deep = b'{"a":' + b"[" * 70 + b"]" * 70 + b"}"
    for name in ("a/msg/B", "a/msg/C"):
        with pytest.raises(Invalid, match="deeper than 64"):
            types.writer(name)(deep, 0)
    with pytest.raises(Invalid, match="a must be a string, not an array"):
        types.writer("a/msg/B", checked=True)(deep, 0)
