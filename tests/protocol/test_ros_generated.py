"""Code generated for a type: it agrees with the closures, and contains no text of a definition."""

from __future__ import annotations

import json
import keyword
import math
import re
import struct
import tracemalloc
from typing import Any

import cbor2
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from relay_protocol import jsontext, nonfinite
from relay_protocol.errors import Invalid
from relay_protocol.ros import generated_cdr_to_json, generated_json_to_cdr
from relay_protocol.ros.codegen import MAX_STEPS, FunctionBuilder, TooLarge, quoted
from relay_protocol.ros.compiled import CompiledTypes
from relay_protocol.ros_types import TypeRegistry
from tests.worlds.growth import steps
from tests.worlds.ros_texts import LINE

EVERYTHING = f"""std_msgs/Header header
bool flag
int8 i8
uint16 u16
int64 i64
float32 f32
float64 f64
string text
wstring<=3 wide
string<=4 short
uint8[] bytes
byte[3] octets
bool[] flags
bool[2] two
int16[2] pair
uint64[<=3] longs
float32[] singles
float64[9] nine
string[<=3] texts
wstring[2] wides
Inner[] inners
Inner[2] couple
Inner[6] many
Point[] points
Point[5] five
Empty nothing
Empty[] nothings
int64 last
{LINE}
MSG: a/Inner
uint8 tag
Point[] path
string name
{LINE}
MSG: a/Point
float64 x
float64 y
{LINE}
MSG: a/Empty
{LINE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""
TYPE = "a/msg/B"
COMPILED = CompiledTypes(TYPE, EVERYTHING)
FULL = {
    "header": {"stamp": {"sec": -1, "nanosec": 7}, "frame_id": "map"},
    "flag": True, "i8": -128, "u16": 65535, "i64": -(2**63), "f32": 0.5, "f64": -1e300, "text": "größer 😀",
    "wide": "a😀", "short": "abcd", "bytes": "YWJj", "octets": "AAEC", "flags": [True, False], "two": [False, True],
    "pair": [-1, 32767], "longs": [2**64 - 1, 0], "singles": [1.5, None], "nine": [0.25] * 9, "texts": ["", "x"],
    "wides": ["", "ß"], "inners": [{"tag": 1, "path": [{"x": 1.0, "y": 2.0}], "name": "n"}] * 2,
    "couple": [{"tag": 2, "path": [], "name": ""}] * 2, "many": [{"tag": 3, "path": [], "name": "m"}] * 6,
    "points": [{"x": 3.0, "y": 4.0}] * 3, "five": [{"x": 0.0, "y": 0.1}] * 5, "nothing": {},
    "nothings": [{}, {}], "last": 5,
}  # fmt: skip
TEXT = json.dumps(FULL, ensure_ascii=False).encode()
CDR = COMPILED.writer(TYPE, False)(TEXT, 0)


PLAIN = f"""std_msgs/Header header
string text
wstring wide
string[] texts
Inner[] inners
Inner[5] many
Point[] points
uint8[4] few
float64[2] pair
Empty nothing
int16 last
{EVERYTHING[EVERYTHING.index(LINE) :]}"""
"""A type without long arrays, which is written by way of structs."""


class Passed(Exception):
    """Generated code leaves a message to the closures."""


def passed(*arguments: Any) -> bytes:
    """Replaces the closures."""
    raise Passed


PLAIN_COMPILED = CompiledTypes("a/msg/P", PLAIN)
PLAIN_CDR = PLAIN_COMPILED.writer("a/msg/P", False)(
    json.dumps(
        {name: FULL[name] for name in ("header", "text", "texts", "inners", "points", "last")}
        | {"wide": "a😀", "few": [1, 2, 3, 4], "many": FULL["inners"][:1] * 5, "pair": [1, 2.5]}
    ).encode(),
    0,
)


PLAIN_FAST = generated_cdr_to_json.generate("a/msg/P", PLAIN_COMPILED.definitions, "json", passed)


def outcome(convert: Any, *arguments: Any) -> Any:
    """The result of a conversion: bytes, or the error's text."""
    try:
        return convert(*arguments)
    except Invalid as error:
        return str(error)


FAST = {
    form: generated_cdr_to_json.generate(TYPE, COMPILED.definitions, form, passed)
    for form in ("json", "cbor")
}
FAST_WRITE = generated_json_to_cdr.generate(TYPE, COMPILED.definitions)(passed)
SLOW_WRITE = COMPILED._slow_writer(TYPE, jsontext.decode_any)


def same(one: Any, other: Any) -> bool:
    """Equality in which NaN equals NaN, and single precision is compared by its decimal form."""
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[name], other[name]) for name in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return (
            one == other
            or (one != one and other != other)
            or struct.pack("f", one) == struct.pack("f", other)
        )
    return bool(one == other)


def damaged(data: bytes, draw: Any) -> bytes:
    """Bytes with one part replaced, or cut off."""
    place = draw(st.integers(0, len(data)))
    gone = draw(st.sampled_from([0, 1, 4, 8, len(data)]))
    put = draw(st.binary(max_size=9) | st.sampled_from([b"\0", b"\xff" * 4, b"\1\0\0\0", b"\0\0\0\0"]))
    return data[:place] + put + data[place + gone :]


def read_alike(compiled: CompiledTypes, name: str, form: str, cdr: bytes) -> None:
    """Generated code gives the closures' result, or leaves the message to them."""
    fast = FAST[form] if compiled is COMPILED else PLAIN_FAST
    slow = outcome(compiled._slow_reader(name, form), cdr)
    decode = json.loads if form == "json" else cbor2.loads
    try:
        read = fast(cdr)
    except Passed:
        return
    assert isinstance(slow, bytes)
    assert same(decode(read), decode(slow))


@given(st.data())
def test_damaged_messages_are_read_alike(data: st.DataObject) -> None:
    """Generated code reads exactly what the closures read, or leaves it to them."""
    cdr = damaged(CDR, data.draw)
    read_alike(COMPILED, TYPE, "json", cdr)
    read_alike(COMPILED, TYPE, "cbor", cdr)


@given(st.data())
def test_damaged_messages_are_read_alike_by_way_of_structs(data: st.DataObject) -> None:
    """The same for a type whose JSON is written by msgspec."""
    read_alike(PLAIN_COMPILED, "a/msg/P", "json", damaged(PLAIN_CDR, data.draw))


TOKENS = [
    b"null", b"true", b"1", b"-1", b"2.0", b"1e5", b"1e999", b"300", b'"x"', b'"\\u0000"', b'"\xff"', b'"\\ud800"',
    b"[]", b"{}", b"[1]", b"[null]", b'{"x":1}', b",", b":", b'"', b"\\", b" ", b"NaN", b"1" * 30, b"9" * 5000,
    b'"AAEC"', b'"AA"', b'{"tag":256}', b"[" * 70, b'"a\nb"', b'"\xf0\x9f\x98\x80\xed\xa0\x80"',
]  # fmt: skip


@given(st.data())
def test_damaged_texts_are_written_alike(data: st.DataObject) -> None:
    """Generated code writes exactly what the strict closures write, or leaves it to them."""
    places = [place for place, byte in enumerate(TEXT) if byte in b'{}[]:,"0123456789']
    place, token = (
        data.draw(st.sampled_from(places)),
        data.draw(st.sampled_from(TOKENS) | st.binary(max_size=3)),
    )
    end = data.draw(st.sampled_from([each for each in places if place <= each <= place + 30]))
    text = TEXT[:place] + token + TEXT[end:]
    slow = outcome(SLOW_WRITE, text, 5)
    try:
        fast = FAST_WRITE(text, 5)
    except Passed:
        return
    assert fast == slow


@given(st.data())
def test_values_of_any_type_are_written_alike(data: st.DataObject) -> None:
    """The same with one value replaced by another of any type, and with missing fields."""
    value = data.draw(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
        | st.text(max_size=5) | st.lists(st.integers(0, 300) | st.none() | st.text(max_size=2), max_size=3)
        | st.dictionaries(st.sampled_from(["x", "sec", "secs", "tag"]), st.integers(), max_size=2)
    )  # fmt: skip
    kept = data.draw(st.sets(st.sampled_from(sorted(FULL))))
    message = {name: FULL[name] for name in FULL if name in kept}
    message[data.draw(st.sampled_from(sorted(FULL)))] = value
    text = json.dumps(message).encode()
    slow = outcome(SLOW_WRITE, text, 5)
    for body in (text, json.loads(text)):
        try:
            assert FAST_WRITE(body, 5) == slow
        except Passed:
            continue


def test_usual_values_need_no_closures() -> None:
    """Generated code converts full and partial messages alone."""
    assert same(json.loads(FAST["json"](CDR)), FULL)
    assert PLAIN_FAST(PLAIN_CDR)
    assert FAST_WRITE(TEXT, 0) == CDR
    assert FAST_WRITE(b"{}", 5 * 10**9 + 6)[4:12] == struct.pack("<iI", 5, 6)
    assert FAST_WRITE(b'{"text":"x"}', 0) == SLOW_WRITE(b'{"text":"x"}', 0)


HARMLESS = [
    *keyword.kwlist,
    *keyword.softkwlist,
    "print",
    "exec",
    "len",
    "data",
    "body",
    "now",
    "out",
    "slow",
    "p",
    "e",
]
HARMLESS += [
    "m",
    "K1",
    "v1",
    "f0",
    "f1",
    "UseSlowPath",
    "SLOW_PATH_ERRORS",
    "convert",
    "eval",
    "elements_left",
    "self",
    "globals",
    "class_",
]


@pytest.mark.parametrize("name", sorted(name for name in HARMLESS if name[0] != "_"))
def test_fields_may_have_any_name(name: str) -> None:
    """Keywords, builtins and the names in generated code itself are allowed."""
    types = TypeRegistry()
    types.add(
        TYPE, f"float64 {name}\nstring[] s{name}\nInner[] i{name}\n{LINE}\nMSG: a/Inner\nstring {name}\n"
    )
    value = {name: 1.5, f"s{name}": ["x"], f"i{name}": [{name: "y"}]}
    cdr = types.from_json(TYPE, json.dumps(value).encode(), 0)
    assert json.loads(types.to_json(TYPE, cdr)) == cbor2.loads(types.to_cbor(TYPE, cdr)) == value


@pytest.mark.parametrize(
    "name",
    [
        "__class__", "_x", "a-b", "a.b", "a'", 'a"', "a\\", "a\\n", "a}", "x:1}", "ä", "a\u2028b", "a\0b", "9",
        "a,b", "a(b)", "{a}", "a\x0bb", "ª",
    ],
)  # fmt: skip
def test_other_names_are_refused(name: str) -> None:
    """A name that is no identifier is refused as a field; otherwise no code would be generated."""
    with pytest.raises(Invalid):
        CompiledTypes(TYPE, f"float64 {name}")
    with pytest.raises(TooLarge):
        quoted(name)


@pytest.mark.parametrize(
    "text", ['\'"""\'', '"\\"); import os; (\\""', "'a\\\\'", "\"'''\"", '"{0}%s\\n"', "x\x85y"]
)
def test_texts_of_defaults_and_constants_are_values_only(text: str) -> None:
    """Quotes, backslashes and newlines in them have no effect in generated code."""
    types = TypeRegistry()
    types.add(TYPE, f"string a {text}\nstring A={text}\nstring[] b [{text}, 'x']\nint8 c")
    value = json.loads(types.to_json(TYPE, types.from_json(TYPE, b'{"c":1}', 0)))
    assert value == json.loads(types.to_json(TYPE, types.zero(TYPE))) | {"c": 1}
    assert value["b"] == [value["a"], "x"]
    assert types.typedefs(TYPE)[0]["constvalues"] == [value["a"]]


STEPS_OF_A_STEP = 500
"""Lines of Python that generate one step of code, at most."""


def many_fields(count: int) -> str:
    """A definition with this many strings."""
    return "\n".join(f"string f{index}" for index in range(count))


def nested(depth: int, sequences: bool) -> str:
    """Messages in messages, or in sequences of messages."""
    brackets = "[]" if sequences else ""
    return f"T1{brackets} t\nint8 a\n" + "\n".join(
        f"{LINE}\nMSG: a/T{level}\n"
        + (f"T{level + 1}{brackets} t\n" if level < depth else "")
        + "int8 a\nstring s"
        for level in range(1, depth + 1)
    )


@pytest.mark.parametrize(
    ("text", "large"),
    [
        (many_fields(MAX_STEPS), False),
        (many_fields(MAX_STEPS + 1), True),
        (nested(7, sequences=True), False),
        (nested(9, sequences=True), True),
        (nested(32, sequences=False), False),
        (nested(32, sequences=True), True),
        ("float64[100000] a", False),
        ("\n".join(f"T f{i}" for i in range(300)) + f"\n{LINE}\nMSG: a/T\nint8 x\nint8 y\nint8 z", True),
        ("T[4] a" + "".join(f"\n{LINE}\nMSG: a/T{'T' * i}\nT{'T' * (i + 1)}[4] a" for i in range(5))
         + f"\n{LINE}\nMSG: a/{'T' * 6}\nstring s", True),
    ],
)  # fmt: skip
def test_large_types_are_left_to_the_closures(text: str, large: bool) -> None:
    """No definition makes much code; its messages are still converted."""
    compiled = CompiledTypes(TYPE, text)
    slow = compiled._slow_reader(TYPE, "json")
    made: list[object] = []
    taken = steps(
        lambda: made.append(generated_cdr_to_json.generate(TYPE, compiled.definitions, "json", slow))
    )
    assert (made == [slow]) == large
    assert taken < STEPS_OF_A_STEP * MAX_STEPS
    types = TypeRegistry()
    types.add(TYPE, text)
    zero = types.from_json(TYPE, b"{}", 0)
    assert json.loads(types.to_json(TYPE, zero)) == json.loads(slow(zero))
    assert types.from_json(TYPE, types.to_json(TYPE, zero), 0) == zero
    assert types.to_cbor(TYPE, zero)


def test_deep_texts_are_refused_by_generated_code_too() -> None:
    """JSON nests at most 64 deep, for any type."""
    deepest = 0
    for depth in range(1, 33):
        compiled = CompiledTypes(TYPE, nested(depth, sequences=True))
        if generated_json_to_cdr.generate(TYPE, compiled.definitions)(passed) is not passed:
            deepest = depth
    assert 2 * (deepest + 1) < 64


@pytest.mark.parametrize("fields", [many_fields(300), "float64[100] a"])
def test_short_texts_can_not_become_much_memory(fields: str) -> None:
    """A megabyte of ``{}``, each standing for many fields or numbers, is soon left to the closures."""
    compiled = CompiledTypes(TYPE, f"T[] t\n{LINE}\nMSG: a/T\n{fields}")
    write = generated_json_to_cdr.generate(TYPE, compiled.definitions)(passed)
    assert write(b'{"t":[{},{}]}', 0)
    text = b'{"t":[' + b",".join([b"{}"] * 300_000) + b"]}"
    tracemalloc.start()
    try:
        with pytest.raises(Passed):
            write(text, 0)
        assert tracemalloc.get_traced_memory()[1] < 60_000_000
    finally:
        tracemalloc.stop()


def test_decoded_values_of_repeating_types_are_left_to_the_closures() -> None:
    """Their memory cannot be derived from their length."""
    compiled = CompiledTypes(TYPE, f"T[] t\n{LINE}\nMSG: a/T\nint8 x")
    with pytest.raises(Passed):
        generated_json_to_cdr.generate(TYPE, compiled.definitions)(passed)({"t": [{}]}, 0)


@pytest.mark.parametrize("text", ["Point[5] a", "Point[] a"])
@pytest.mark.parametrize("form", ["json", "cbor"])
def test_elements_that_are_cut_off_are_missed(text: str, form: str) -> None:
    """A message that lacks whole elements at its end is not read as a shorter one."""
    types = TypeRegistry()
    types.add(TYPE, f"{text}\n{LINE}\nMSG: a/Point\nfloat64 x\nfloat64 y")
    cdr = types.from_json(TYPE, {"a": [{}] * 5}, 0)
    assert types.reader(TYPE, form)(cdr)
    for lacking in (16, 32, 48, 4, 1):
        with pytest.raises(Invalid):
            types.reader(TYPE, form)(cdr[:-lacking])


@pytest.mark.parametrize(
    "time",
    [
        "int32 sec\nuint32 nanosec\nint8 more",
        "string sec\nstring nanosec",
        "uint32 nanosec\nint32 sec",
        "T[2] sec",
    ],
)
def test_a_time_of_the_robots_own_making_breaks_nothing(time: str) -> None:
    """The closures write or refuse a header whose stamp has another type."""
    text = f"std_msgs/Header h\n{LINE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\n"
    text += f"{LINE}\nMSG: builtin_interfaces/Time\n{time}\n{LINE}\nMSG: builtin_interfaces/T\nint8 x"
    compiled = CompiledTypes(TYPE, text)
    slow = compiled._slow_writer(TYPE, json.loads)
    assert outcome(compiled.writer(TYPE, False), b"{}", 5) == outcome(slow, b"{}", 5)


def test_lines_of_a_source_are_the_only_code() -> None:
    """Objects are passed by name and never written into the text."""
    source = FunctionBuilder()
    name = source.constant("'); raise SystemExit('")
    source.line(f"return {name}.encode()")
    assert source.function("data")(passed)(b"") == b"'); raise SystemExit('"


def test_numbers_of_cbor_are_exact() -> None:
    """Integers of every width and sign, floats of both precisions, NaN and infinity."""
    types = TypeRegistry()
    types.add(
        TYPE,
        "int8 a\nint16 b\nint32 c\nint64 d\nuint8 e\nuint16 f\nuint32 g\nuint64 h\nfloat32 i\nfloat64 j\nbool k",
    )
    for low in (True, False):
        values = [-(2 ** (bits - 1)) if low else 2 ** (bits - 1) - 1 for bits in (8, 16, 32, 64)]
        values += [0 if low else 2**bits - 1 for bits in (8, 16, 32, 64)]
        real = math.nan if low else -math.inf
        cdr = b"\0\1\0\0" + struct.pack("<bxhiqBxHIQf4xd?", *values, real, real, low)
        back = list(cbor2.loads(types.to_cbor(TYPE, cdr)).values())
        assert back[:8] == values
        assert same(back[8:], [real, real, low])


CHECKED = f"""std_msgs/Header header
bool flag
int8 small
uint64 large
float32 single
float64 double
string text
string<=4 short
Inner inner
{LINE}
MSG: a/Inner
uint8 tag
string name
{LINE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""
CHECKED_TYPES = CompiledTypes("a/msg/C", CHECKED)
SCALARS = (
    st.integers(-(2**65), 2**65)
    | st.integers(-200, 300)
    | st.floats(allow_nan=False)
    | st.text(max_size=6)
    | st.sampled_from([None, True, "\0", "a\0b", "ä" * 3, 1e39, 3.5e38, 2.0, "\ud800", "\0NaN", [], {}])
)
CHECKED_FIELDS = ["header", "flag", "small", "large", "single", "double", "text", "short", "inner", "other"]


@given(
    st.dictionaries(
        st.sampled_from(CHECKED_FIELDS),
        SCALARS
        | st.dictionaries(st.sampled_from(["tag", "name", "frame_id", "stamp"]), SCALARS, max_size=2)
        | st.fixed_dictionaries({"stamp": st.fixed_dictionaries({"sec": SCALARS, "nanosec": SCALARS})}),
        max_size=4,
    )
)
def test_a_check_takes_what_a_writer_takes(value: dict[str, Any]) -> None:
    """It returns the same message, or the text without marks, and refuses the others with the same error."""
    text = json.dumps(value).encode()
    write = CHECKED_TYPES.writer("a/msg/C", True)
    try:
        written = write(text)
    except Invalid as error:
        with pytest.raises(Invalid, match=f"^{re.escape(str(error))}$"):
            CHECKED_TYPES.check("a/msg/C", False)(text)
    else:
        checked = CHECKED_TYPES.check("a/msg/C", False)(text)
        if checked != nonfinite.marks_to_null(text):
            assert json.loads(checked).keys() == {*CHECKED_FIELDS} - {"other"}
            assert write(checked) == written


FLOATS = CompiledTypes("a/msg/F", "float32[2] pair\nfloat64[] many\nfloat32 one\nstring text")
FLOAT = st.sampled_from([0, 1.5, 1e39, 1e999, -1e999, math.nan, None, "\0NaN", "\0Infinity", "null"])


@given(
    st.dictionaries(
        st.sampled_from(["pair", "many", "one", "text"]), FLOAT | st.lists(FLOAT, min_size=2, max_size=2)
    )
)
@example({"text": "null"})
@example({"many": [None, 1]})
@example({"many": [1, "\0Infinity"]})
def test_a_command_is_what_a_writer_takes_and_finite(value: dict[str, Any]) -> None:
    """Of types with lists and without, as CDR and as JSON: the same bytes, or an error."""
    for types, name in ((FLOATS, "a/msg/F"), (CHECKED_TYPES, "a/msg/C")):
        fields = value if types is FLOATS else {"single": value.get("one", 0), "text": value.get("text", "")}
        text = json.dumps(nonfinite.from_floats(fields)).encode()
        try:
            wanted = types.writer(name, True)(text), types.check(name, False)(text)
            nonfinite.require_finite(text)
        except Invalid as error:
            for convert in (types.command_writer(name), types.check(name, True)):
                with pytest.raises(Invalid, match=f"^{re.escape(str(error))}$"):
                    convert(text)
        else:
            assert (types.command_writer(name)(text), types.check(name, True)(text)) == wanted


def test_types_with_arrays_are_checked_by_writing() -> None:
    check = PLAIN_COMPILED.check("a/msg/P", False)
    check(b'{"pair":[1,2]}')
    with pytest.raises(Invalid, match="pair"):
        check(b'{"pair":[1,2,3]}')
    assert generated_json_to_cdr.generate_check("a/msg/P", PLAIN_COMPILED.definitions) is None


def test_check_without_changes_writes_nothing() -> None:
    make = generated_json_to_cdr.generate_check("a/msg/C", CHECKED_TYPES.definitions)
    assert make is not None
    make(passed)(b'{"small":1,"text":"x","short":"abcd","header":{},"inner":{"tag":255}}')
    for text in (b'{"small":128}', b'{"text":"\\u0000"}', b'{"short":"abcde"}', b'{"single":1e39}'):
        with pytest.raises(Passed):
            make(passed)(text)


def test_only_types_with_a_header_need_the_time() -> None:
    assert CHECKED_TYPES.is_stamped("a/msg/C")
    assert not CHECKED_TYPES.is_stamped("a/msg/Inner")
    assert CHECKED_TYPES.is_stamped("std_msgs/msg/Header")
