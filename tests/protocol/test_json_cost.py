"""The CPU time of large client messages: none delays other clients."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable

import pytest

from relay_protocol import json_cost, jsontext, limits, nonfinite, rosbridge
from relay_protocol.errors import Invalid, MalformedMessage, SwitchboardError
from relay_protocol.limits import KIB
from relay_protocol.ros_types import TypeRegistry
from tests.worlds.growth import grows_linearly, ratio_stays_below

LARGEST = limits.CLIENT_MESSAGE
TYPES = TypeRegistry()
POINT = "MSG: a/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
for kind in ("float64", "float32", "int8", "uint8", "string", "wstring", "a/Point"):
    name = f"a/msg/Of{kind.rpartition('/')[2].capitalize()}"
    TYPES.add(name, f"{kind}[] data\n" + ("=" * 80 + "\n" + POINT if "/" in kind else ""))
TYPES.add("a/msg/Text", "string data\n")
TYPES.add("a/msg/Wide", "wstring data\n")
TYPES.add("a/msg/OfUint64", "uint64[] data\n")


def message_of(data: bytes) -> bytes:
    """A message to a topic."""
    return b'{"op":"publish","topic":"/a","msg":{"data":' + data + b"}}"


def listed(element: bytes) -> Callable[[int], bytes]:
    """A list of repeated items with this many bytes."""
    return lambda size: message_of(
        b"[" + element * ((size - 60) // len(element)) + element.rstrip(b",") + b"]"
    )


def text(element: bytes, after: bytes = b"") -> Callable[[int], bytes]:
    """A string of repeated text."""
    return lambda size: message_of(b'"' + element * ((size - 60) // len(element)) + b'"' + after)


def with_nan(made: Callable[[int], bytes]) -> Callable[[int], bytes]:
    """The same with NaN at the end."""
    return lambda size: made(size - 4).replace(b"]}}", b",NaN]}}")


def many_keys(size: int) -> bytes:
    """An object with as many fields as fit."""
    return message_of(b"{" + b",".join(b'"k%07d":1' % number for number in range((size - 60) // 13)) + b"}")


SHAPES: dict[str, tuple[Callable[[int], bytes], str]] = {
    "base64": (text(b"A"), "a/msg/OfUint8"),
    "text": (text(b"A"), "a/msg/Text"),
    "escapes": (text(b"\\\\"), "a/msg/Text"),
    "escaped quotation marks": (text(b'\\"'), "a/msg/Text"),
    "unicode escapes": (text(b"\\u0041"), "a/msg/Text"),
    "escaped colons": (text(b"\\u003a"), "a/msg/Text"),
    "two bytes each": (text("ä".encode()), "a/msg/Text"),
    "brackets in a string": (text(b"[{"), "a/msg/Text"),
    "NaN in a string": (text(b"NaN"), "a/msg/Text"),
    "NaN beside a string": (text(b'\\"', b',"x":NaN'), "a/msg/Text"),
    "strings": (listed(b'"",'), "a/msg/OfString"),
    "short strings": (listed(b'"ab",'), "a/msg/OfString"),
    "strings and NaN": (with_nan(listed(b'"",')), "a/msg/OfString"),
    "commas in strings and NaN": (with_nan(listed(b'",",')), "a/msg/OfString"),
    "escaped ends": (with_nan(listed(b'"\\\\",')), "a/msg/OfString"),
    "NaN": (listed(b"NaN,"), "a/msg/OfFloat64"),
    "infinity": (listed(b"-Infinity,"), "a/msg/OfFloat32"),
    "null": (listed(b"null,"), "a/msg/OfFloat64"),
    "bytes": (listed(b"1,"), "a/msg/OfInt8"),
    "bytes with a point": (listed(b"1.0,"), "a/msg/OfInt8"),
    "long numbers": (listed(b"0.1234567890123456,"), "a/msg/OfFloat64"),
    "numbers of 4000 digits": (listed(b"1" * 4000 + b","), "a/msg/OfUint64"),
    "floats of 4000 digits": (listed(b"1" * 4000 + b","), "a/msg/OfFloat64"),
    "numbers of 300 digits": (listed(b"1" * 300 + b","), "a/msg/OfUint64"),
    "wide text": (text(b"A"), "a/msg/Wide"),
    "wide text, two bytes each": (text("ä".encode()), "a/msg/Wide"),
    "wide text of surrogate pairs": (text("😀".encode()), "a/msg/Wide"),
    "base64 with a line break at each character": (text(b"A\\n"), "a/msg/OfUint8"),
    "line breaks for base64": (text(b"\\r\\n"), "a/msg/OfUint8"),
    "other text for base64": (text("ä\\n".encode()), "a/msg/OfUint8"),
    "short numbers": (listed(b"1,"), "a/msg/OfFloat64"),
    "a long number": (lambda size: message_of(b"1" * size), "a/msg/Text"),
    "objects": (listed(b'{"x":1,"y":2},'), "a/msg/OfPoint"),
    "empty objects": (listed(b"{},"), "a/msg/OfPoint"),
    "objects with null": (listed(b'{"x":null},'), "a/msg/OfPoint"),
    "objects with NaN": (listed(b'{"x":NaN},'), "a/msg/OfPoint"),
    "empty lists": (listed(b"[],"), "a/msg/OfFloat64"),
    "nested": (lambda size: message_of(b"[" * size), "a/msg/OfFloat64"),
    "many keys": (many_keys, "a/msg/OfFloat64"),
    "spaces": (lambda size: message_of(b" " * size + b"1"), "a/msg/OfFloat64"),
    "not ended": (lambda size: message_of(b'"' + b"a" * size), "a/msg/Text"),
    "a fragment": (
        lambda size: b'{"op":"fragment","id":"f","num":0,"total":2,"data":"' + b'\\"' * (size // 2) + b'"}',
        "a/msg/Text",
    ),
    "a list for an id": (
        lambda size: b'{"op":"publish","topic":7,"id":[' + b"[]," * (size // 3) + b"1]}",
        "a/msg/Text",
    ),
}


def handle(data: bytes, type_name: str) -> str:
    """Handles a message as the relay does before sending it to the robot; returns the error of a refused one."""
    try:
        operation = rosbridge.decode(data)
    except SwitchboardError as error:
        rosbridge.unreadable(data)
        return str(error)
    if isinstance(operation, rosbridge.Publish):
        try:
            TYPES.writer(type_name, checked=True)(bytes(operation.msg), 0)
        except SwitchboardError as error:
            return str(error)
    return ""


REFERENCE = b"[" + b"1," * 125_000 + b"1]"
"""Another parser reads this. The largest message costs 15 times as much; a former parser took 80 to 160 times."""


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("size", [json_cost.COUNTED * 2, json_cost.LARGE, LARGEST - 1000])
def test_no_shape_of_a_large_message_takes_long(shape: str, size: int) -> None:
    """Compared with another parser on 250 kB."""
    make, type_name = SHAPES[shape]
    data = make(size)
    assert ratio_stays_below(50, lambda: handle(data, type_name), lambda: json.loads(REFERENCE))


@pytest.mark.parametrize("shape", SHAPES)
def test_the_cost_of_a_large_message_grows_linearly(shape: str) -> None:
    """At sizes that are both accepted or both refused."""
    make, type_name = SHAPES[shape]
    assert grows_linearly(lambda data: handle(data, type_name), make, LARGEST // 2)


@pytest.mark.parametrize(
    ("element", "words"),
    [
        (b"{},", "may have 4096 objects and arrays, not "),
        (b'"",', "may have 16384 strings and names of fields, not "),
        (b"1,", "may have 1050000 values (commas), not "),
    ],
)
def test_too_much_in_a_large_message_is_refused_with_a_reason(element: bytes, words: str) -> None:
    """With the count, the limit, and advice."""
    with pytest.raises(json_cost.TooCostly, match="send bulk as base64, or less") as caught:
        rosbridge.decode(listed(element)(LARGEST - 1000))
    assert words in str(caught.value)


def test_large_message_of_an_allowed_kind_is_accepted() -> None:
    """Pictures, clouds and maps, a million numbers, long texts with escapes, and a path of 1 MB."""
    pose = (
        b'{"header":{"stamp":{"sec":1,"nanosec":2},"frame_id":"map"},"pose":{"position":{"x":1.0,"y":2.0,"z":3.0},'
        b'"orientation":{"x":0,"y":0,"z":0,"w":1}}},'
    )
    rosbridge.decode(listed(pose)(1_000_000))
    for element in (b"100,", b"0.1234567890123456,"):
        assert handle(listed(element)(4_000_000), "a/msg/OfFloat64") == ""
    for plain in (b"A", b'\\"', b"\\\\"):
        assert handle(text(plain)(LARGEST - 1000), "a/msg/Text") == ""
    raw = base64.b64encode(bytes(7_000_000))
    assert handle(message_of(b'"' + raw + b'"'), "a/msg/OfUint8") == ""


def test_long_numbers_of_a_large_message_are_refused_unread() -> None:
    """Also where no type says that they are numbers, and not where they stand in a string."""
    long = b"1" * json_cost.LONG_NUMBER
    many = listed(long + b",")(json_cost.LARGE)
    with pytest.raises(json_cost.TooCostly, match="no number of 320 digits or more"):
        rosbridge.decode(many)
    for read in (jsontext.decode_any, jsontext.recode):
        with pytest.raises(MalformedMessage, match="a number is out of range"):
            read(many)
    beside = message_of(b'"' + long * 1000 + b'","x":["\\"' + long + b'\\\\",' + b"1," * 1000 + b"1]")
    assert isinstance(rosbridge.decode(beside), rosbridge.Publish)
    assert isinstance(rosbridge.decode(listed(b"1" * 319 + b",")(json_cost.LARGE)), rosbridge.Publish)


def test_a_wide_text_that_is_too_long_is_refused_by_its_length() -> None:
    for letter in ("a", "ä", "😀"):
        for name in ("Wide", "OfWstring"):
            value = letter * (limits.RELAY_FRAME // (8 if letter == "😀" else 4))
            data = {"data": value if name == "Wide" else [value]}
            with pytest.raises(Invalid, match="bytes") as refused:
                TYPES.from_json(f"a/msg/{name}", data, 0)
            assert "16777" in str(refused.value)


def test_a_large_message_may_hold_nan() -> None:
    """As roslibpy writes it, beside a picture or a cloud in base64."""
    raw = b'"' + base64.b64encode(bytes(7_000_000)) + b'"'
    operation = rosbridge.decode(message_of(b"[NaN,-Infinity,1]").replace(b"}}", b',"raw":' + raw + b"}}"))
    assert isinstance(operation, rosbridge.Publish)
    assert nonfinite.marks_to_null(bytes(operation.msg)).startswith(b'{"data":[null,null,1]')
    assert (
        handle(listed(b"1,")(250_000).replace(b"[1", b"[NaN" + b" " * json_cost.LARGE), "a/msg/OfFloat64")
        == ""
    )


def test_nan_beside_many_escapes_is_refused_with_a_reason() -> None:
    """It is searched for outside strings."""
    with pytest.raises(json_cost.TooCostly, match="with NaN or infinity may have 131072 backslashes"):
        rosbridge.decode(SHAPES["NaN beside a string"][0](LARGEST - 1000))


def test_small_messages_are_not_counted() -> None:
    """They may consist of structure only."""
    rosbridge.decode(listed(b"{},")(60 * KIB))
