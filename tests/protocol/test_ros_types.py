"""CDR to JSON and back, for types made up here; the installed ones are compared with rclpy elsewhere."""

from __future__ import annotations

import base64
import json
import math
import struct
import tracemalloc
from typing import Any

import cbor2
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol.errors import Invalid, NotFound
from relay_protocol.limits import TYPE_DEFINITION
from relay_protocol.ros_types import TypeRegistry

LINE = "=" * 80
VECTOR = "float64 x\nfloat64 y\nfloat64 z"
TWIST = f"Vector3 linear\nVector3 angular\n{LINE}\nMSG: geometry_msgs/Vector3\n{VECTOR}"
HEADER = "builtin_interfaces/Time stamp\nstring frame_id"
STAMPED = f"std_msgs/Header header\nint8 a\n{LINE}\nMSG: std_msgs/Header\n{HEADER}"
TRIGGER = "---\nbool success\nstring message"
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


def registry(**texts: str) -> TypeRegistry:
    """A registry of these texts, under package ``a``."""
    types = TypeRegistry()
    for name, text in texts.items():
        types.add(f"a/msg/{name}", text)
    return types


ALL = registry(B=EVERYTHING)


def signed(bits: int) -> st.SearchStrategy[int]:
    """Integers of so many bits."""
    return st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def unsigned(bits: int) -> st.SearchStrategy[int]:
    """The same without sign."""
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
    """Single precision has several spellings: its bits."""
    return struct.pack("f", value)


@given(MESSAGE)
def test_every_kind_of_field_survives(message: dict[str, Any]) -> None:
    """What was written is read again, in both byte orders' alignment."""
    back = json.loads(ALL.to_json("a/msg/B", ALL.from_json("a/msg/B", message, 0)))
    assert list(map(single, back.pop("singles"))) == list(map(single, message["singles"]))
    assert back == {name: value for name, value in message.items() if name != "singles"}


@given(MESSAGE, st.data())
def test_a_cut_message_is_invalid(message: dict[str, Any], data: st.DataObject) -> None:
    """A message that ends early is an error at every length, because its last field is a number."""
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
    """A length of 2^32-1 is refused without any memory being taken for it."""
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
    """A robot that sends 16 MiB of tiny messages does not cost the relay gigabytes, nested or not."""
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
    """A list of empty objects stands for defaults, whose size is bounded."""
    types = registry(B=f"E[] x\n{LINE}\nMSG: a/E\nfloat64[100000] e", C="float64[] x")
    with pytest.raises(Invalid, match="x makes a message of more than 4194304 bytes"):
        types.from_json("a/msg/B", {"x": [{}] * 300_000}, 0)
    with pytest.raises(Invalid, match="a robot takes at most 4194287"):
        types.from_json("a/msg/C", {"x": [0] * 524_288}, 0)
    assert len(types.from_json("a/msg/C", {"x": [0] * 524_284}, 0)) < 4 * 1024 * 1024


def test_big_endian_is_read() -> None:
    """Robots of the other byte order are understood, numbers, arrays and lengths alike."""
    types = registry(B="int16 a\nfloat64[] b\nwstring c\nuint8[] d\nint64[2] e")
    body = struct.pack(">h2xI d II I3sx 2q", -2, 1, 1.5, 1, 0xDF, 3, b"abc", 5, -6)
    value = json.loads(types.to_json("a/msg/B", b"\0\0\0\0" + body))
    assert value == {"a": -2, "b": [1.5], "c": "ß", "d": "YWJj", "e": [5, -6]}


def test_numbers_json_lacks_become_null_and_null_becomes_nan() -> None:
    """NaN and infinity have no JSON; a null in a float is NaN."""
    types = registry(B="float64 a\nfloat32[] b\nfloat64[2] c")
    cdr = b"\0\1\0\0" + struct.pack("<dI2f4x2d", math.nan, 2, math.inf, 1, -math.inf, 2)
    assert types.to_json("a/msg/B", cdr) == b'{"a":null,"b":[null,1.0],"c":[null,2.0]}'
    back = types.from_json("a/msg/B", b'{"a":null,"b":[null,1.0],"c":[null,2.0]}', 0)
    numbers = struct.unpack("<dI2f4x2d", back[4:])
    assert [math.isnan(number) for number in numbers] == [True, False, True, False, True, False]


def test_strings_that_are_no_utf8_are_shown_with_marks() -> None:
    """One careless node does not hide a whole message."""
    types = registry(B="string a\nstring b")
    cdr = b"\0\1\0\0" + struct.pack("<I3sxI", 3, b"\xffa\0", 0)
    assert json.loads(types.to_json("a/msg/B", cdr)) == {"a": "\ufffda", "b": ""}


@pytest.mark.parametrize("head", [b"", b"\0", b"\0\1\0", b"\0\3\0\0", b"\1\0\0\0", b"\0\x0a\0\0"])
def test_other_encodings_are_refused(head: bytes) -> None:
    """Parameter lists and XCDR2 are not plain CDR."""
    with pytest.raises(Invalid, match="a/msg/B: "):
        registry(B="int8 a").to_json("a/msg/B", head)


def test_defaults_of_the_definition_are_used() -> None:
    """A field nobody sets has the value its text gives it."""
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
def test_what_does_not_fit_is_named(field: str, value: str, problem: str) -> None:
    """The error gives the type, the path and what is wrong, and is one short sentence."""
    with pytest.raises(Invalid) as caught:
        ALL.from_json("a/msg/B", f'{{"{field}": {value}}}'.encode(), 0)
    assert str(caught.value).startswith("a/msg/B: ")
    assert problem in str(caught.value)
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("body", [b"[]", b"1", b"null", b'"x"', b"", b"{", b"\xff"])
def test_a_message_is_an_object(body: bytes) -> None:
    """Anything else is refused."""
    with pytest.raises(Invalid, match="a/msg/B"):
        ALL.from_json("a/msg/B", body, 0)


@given(
    st.recursive(
        st.none() | st.integers() | st.floats() | st.text(max_size=3),
        lambda inner: st.lists(inner, max_size=3),
    )
)
def test_any_value_in_any_field_raises_nothing_but_invalid(value: Any) -> None:
    """Clients can put what they like where they like."""
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
    """So clients need no clock."""
    types = registry(B=STAMPED)
    value = json.loads(types.to_json("a/msg/B", types.from_json("a/msg/B", body, NOW)))
    assert value["header"]["stamp"] == {"sec": 1_700_000_000, "nanosec": 123_456_789}


@pytest.mark.parametrize(
    "stamp", [{"sec": 5, "nanosec": 6}, {"secs": 5, "nsecs": 6}, {"secs": 5, "nanosec": 6}]
)
def test_a_stamp_that_is_given_stays(stamp: dict[str, int]) -> None:
    """In the words of ROS 2 or of ROS 1."""
    types = registry(B=STAMPED)
    value = json.loads(
        types.to_json("a/msg/B", types.from_json("a/msg/B", {"header": {"stamp": stamp}}, NOW))
    )
    assert value["header"]["stamp"] == {"sec": 5, "nanosec": 6}


def test_zero_has_no_time() -> None:
    """The all-default message does not depend on the clock."""
    assert registry(B=STAMPED).zero("a/msg/B") == b"\0\1\0\0" + bytes(8) + b"\1\0\0\0\0" + b"\0"


def test_service_arguments_come_by_name_by_order_or_not_at_all() -> None:
    """A request is an object, a list, null or nothing."""
    types = TypeRegistry()
    types.add("a/srv/Add", "int32 a\nint32 b\n---\nint32 sum")
    wanted = b"\0\1\0\0" + struct.pack("<ii", 3, 4)
    for name in ("a/srv/Add", "a/Add", "a/srv/Add_Request"):
        assert types.args_from_json(name, b"[3,4]", 0) == wanted
        assert types.args_from_json(name, b'{"b":4,"a":3}', 0) == wanted
        assert types.args_from_json(name, [3, 4], 0) == wanted
        assert (
            types.args_from_json(name, None, 0)
            == types.args_from_json(name, b"null", 0)
            == bytes([0, 1]) + bytes(10)
        )
    with pytest.raises(Invalid, match="a/srv/Add_Request has 2 arguments, not 3"):
        types.args_from_json("a/srv/Add", b"[1,2,3]", 0)
    for body in (b"0", b'""', b"false"):
        with pytest.raises(Invalid, match="a/srv/Add_Request must be an object"):
            types.args_from_json("a/srv/Add", body, 0)
    with pytest.raises(Invalid, match="b must be an integer"):
        types.args_from_json("a/srv/Add", b'[1,"2"]', 0)


ACTION = "int32 order\nInner[] inners\n---\nint32[] sequence\nstring OK=yes\n---\nfloat32 done 0.5\n"
ACTION += f"{LINE}\nMSG: a/Inner\nfloat64 x\n"


def test_the_parts_of_an_action_are_messages() -> None:
    """Goal, result and feedback are converted both ways under names of their own."""
    types = TypeRegistry()
    types.add("a/action/Count", ACTION)
    goal = b'{"order":5,"inners":[{"x":1.5}]}'
    for name, text in (("Goal", goal), ("Result", b'{"sequence":[0,1]}'), ("Feedback", b'{"done":0.25}')):
        part = f"a/action/Count_{name}"
        assert types.knows(part)
        assert types.to_json(part, types.from_json(part, text, 0)) == text
        assert cbor2.loads(types.to_cbor(part, types.zero(part))).keys() == json.loads(text).keys()
    assert types.knows("a/action/Count")
    assert types.to_json("a/action/Count_Feedback", types.zero("a/action/Count_Feedback")) == b'{"done":0.5}'
    assert types.definition("a/action/Count") == ACTION
    with pytest.raises(NotFound):
        types.to_json("a/action/Count", b"")


def test_goals_come_by_name_by_order_or_not_at_all() -> None:
    """The arguments of an action are given like those of a service."""
    types = TypeRegistry()
    types.add("a/action/Count", ACTION)
    wanted = types.from_json("a/action/Count_Goal", {"order": 5, "inners": [{"x": 2.0}]}, 0)
    for name in ("a/action/Count", "a/Count", "a/action/Count_Goal"):
        assert types.args_from_json(name, b'{"inners":[{"x":2}],"order":5}', 0) == wanted
        assert types.args_from_json(name, b'[5,[{"x":2}]]', 0) == wanted
        assert types.args_from_json(name, [5, [{"x": 2}]], 0) == wanted
        assert types.args_from_json(name, None, 0) == types.zero("a/action/Count_Goal")
    with pytest.raises(Invalid, match="a/action/Count_Goal has 2 arguments, not 3"):
        types.args_from_json("a/action/Count", [1, [], 3], 0)


def test_typedefs_of_the_parts_of_actions_and_services() -> None:
    """Each part is a type of its own to rosapi, with what it contains behind it."""
    types = TypeRegistry()
    types.add("a/action/Count", ACTION)
    types.add("std_srvs/srv/Trigger", TRIGGER)
    goal, inner = types.typedefs("a/action/Count_Goal")
    assert goal == {
        "type": "a/Count_Goal",
        "fieldnames": ["order", "inners"],
        "fieldtypes": ["int32", "a/Inner"],
        "fieldarraylen": [-1, 0],
        "examples": ["0", "[]"],
        "constnames": [],
        "constvalues": [],
    }
    assert inner["type"] == "a/Inner"
    (result,) = types.typedefs("a/action/Count_Result")
    assert (result["constnames"], result["constvalues"]) == (["OK"], ["yes"])
    (feedback,) = types.typedefs("a/action/Count_Feedback")
    assert feedback["examples"] == ["0.5"]
    (response,) = types.typedefs("std_srvs/srv/Trigger_Response")
    assert response["fieldnames"] == ["success", "message"]


def test_readers_and_writers_are_kept_until_the_type_changes() -> None:
    """They are made once, for like robots together; another definition brings others, the old stay what they were."""
    types, other = registry(B="int8 a"), registry(B="int8 a")
    read, write = types.reader("a/msg/B", "json"), types.writer("a/B", checked=True)
    assert types.reader("a/B", "json") is read is other.reader("a/msg/B", "json")
    assert types.writer("a/msg/B", checked=True) is write
    types.add("a/msg/B", "int16 b")
    assert types.reader("a/msg/B", "json")(types.writer("a/msg/B")(b'{"b":300}', 0)) == b'{"b":300}'
    assert read(write(b'{"a":3}', 0)) == b'{"a":3}'


@pytest.mark.parametrize(
    "ask", [lambda types: types.reader("a/msg/X", "cbor"), lambda types: types.writer("a/msg/X")]
)
def test_there_is_no_reader_or_writer_of_an_unknown_type(ask: Any) -> None:
    """Asking for one is NotFound, not the first message."""
    with pytest.raises(NotFound, match="the definition of a/msg/X is not known"):
        ask(registry(B="int8 a"))


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
def test_a_writer_raises_invalid_for_whatever_is_no_message(checked: bool, body: Any) -> None:
    """Texts and values, checked before or not."""
    with pytest.raises(Invalid, match="a/msg/B"):
        registry(B="string a").writer("a/msg/B", checked)(body, 0)


def test_a_writer_is_strict_unless_the_text_was_checked() -> None:
    """Where the closures decode, an unchecked text is looked at as a whole."""
    types = registry(B="string a", C="\n".join(f"string f{number}" for number in range(1000)))
    deep = b'{"a":' + b"[" * 70 + b"]" * 70 + b"}"
    for name in ("a/msg/B", "a/msg/C"):
        with pytest.raises(Invalid, match="deeper than 64"):
            types.writer(name)(deep, 0)
    with pytest.raises(Invalid, match="a must be a string, not an array"):
        types.writer("a/msg/B", checked=True)(deep, 0)


def test_an_empty_request_is_one_byte() -> None:
    """IDL has no empty structures."""
    types = TypeRegistry()
    types.add("std_srvs/srv/Trigger", TRIGGER)
    assert types.args_from_json("std_srvs/srv/Trigger", b"{}", 0) == b"\0\1\0\0\0"
    assert types.to_json("std_srvs/srv/Trigger_Request", b"\0\1\0\0\0") == b"{}"
    assert types.knows("std_srvs/srv/Trigger")
    assert types.knows("std_srvs/srv/Trigger_Response")


def test_names_may_be_short() -> None:
    """``pkg/Name`` means ``pkg/msg/Name`` everywhere."""
    types = TypeRegistry()
    types.add("geometry_msgs/Twist", TWIST)
    assert types.knows("geometry_msgs/msg/Twist")
    assert types.knows("geometry_msgs/Twist")
    assert types.zero("geometry_msgs/Twist") == types.zero("geometry_msgs/msg/Twist")
    assert types.definition("geometry_msgs/Twist") == TWIST


def test_contained_types_are_known_too() -> None:
    """A text teaches all the types in it."""
    types = TypeRegistry()
    types.add("geometry_msgs/msg/Twist", TWIST)
    assert types.knows("geometry_msgs/msg/Vector3")
    assert (
        types.to_json("geometry_msgs/msg/Vector3", types.zero("geometry_msgs/Vector3"))
        == b'{"x":0.0,"y":0.0,"z":0.0}'
    )


def test_unknown_types_are_told() -> None:
    """Asking for one is NotFound; whether it is known is a plain no, even for nonsense."""
    types = TypeRegistry()
    assert not types.knows("a/msg/B")
    assert not types.knows("nonsense")
    for ask in (types.zero, types.typedefs, types.definition):
        with pytest.raises(NotFound, match="the definition of a/msg/B is not known"):
            ask("a/msg/B")


def test_a_new_text_replaces_the_former_and_the_same_changes_nothing() -> None:
    """A robot that was updated sends another text; registries don't disturb each other."""
    types, other = registry(B="int8 a"), registry(B="int8 a")
    types.add("a/msg/B", "int8 a")
    types.add("a/msg/B", "int16 b")
    assert types.to_json("a/msg/B", types.zero("a/msg/B")) == b'{"b":0}'
    assert other.to_json("a/msg/B", other.zero("a/msg/B")) == b'{"a":0}'


def test_a_bad_text_leaves_what_was_known() -> None:
    """An error registers nothing and takes nothing away."""
    types = registry(B="int8 a")
    with pytest.raises(Invalid):
        types.add("a/msg/B", "nonsense")
    assert types.knows("a/msg/B")


def test_the_number_of_types_is_bounded() -> None:
    """A robot can't fill the relay's memory with types."""
    types = TypeRegistry()
    for number in range(4096):
        types.add(f"a/msg/T{number}", "int8 a")
    with pytest.raises(Invalid, match="has sent 4096 types already"):
        types.add("a/msg/More", "int8 a")
    types.add("a/msg/T0", "int8 b")


def test_the_texts_of_all_types_together_are_bounded() -> None:
    """A robot can't fill the relay's memory with comments; a text that replaces another takes its place."""
    types = TypeRegistry()
    comment = "#" * (TYPE_DEFINITION - 10)
    for number in range(64):
        types.add(f"a/msg/T{number}", f"int8 a{comment}")
    with pytest.raises(Invalid, match="has sent definitions of 16 MiB already"):
        types.add("a/msg/More", f"int8 a{comment}")
    types.add("a/msg/T0", f"int8 b{comment}")
    types.add("a/msg/T0", "int8 b")
    types.add("a/msg/More", f"int8 a{comment}")


def test_typedefs_list_every_type_once() -> None:
    """rosapi's form: the type asked for first, then all it contains."""
    text = "Vector3[2] a\nVector3[] b\nint8 A=1\nuint8[<=5] c\nstring d 'x'\n"
    text += f"{LINE}\nMSG: geometry_msgs/Vector3\n{VECTOR}"
    types = TypeRegistry()
    types.add("geometry_msgs/msg/Thing", text)
    first, second = types.typedefs("geometry_msgs/Thing")
    assert first == {
        "type": "geometry_msgs/Thing",
        "fieldnames": ["a", "b", "c", "d"],
        "fieldtypes": ["geometry_msgs/Vector3", "geometry_msgs/Vector3", "uint8", "string"],
        "fieldarraylen": [2, 0, 0, -1],
        "examples": ["[]", "[]", "[]", "x"],
        "constnames": ["A"],
        "constvalues": ["1"],
    }
    assert second["type"] == "geometry_msgs/Vector3"
