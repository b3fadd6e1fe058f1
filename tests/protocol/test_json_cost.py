"""No message of a client holds up the others: what a large one costs, in time of the processor."""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Callable

import pytest

from relay_protocol import json_cost, limits, rosbridge
from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import KIB
from relay_protocol.ros_types import TypeRegistry

LARGEST = limits.CLIENT_MESSAGE
TYPES = TypeRegistry()
POINT = "MSG: a/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
for kind in ("float64", "float32", "int8", "uint8", "string", "a/Point"):
    name = f"a/msg/Of{kind.rpartition('/')[2].capitalize()}"
    TYPES.add(name, f"{kind}[] data\n" + ("=" * 80 + "\n" + POINT if "/" in kind else ""))
TYPES.add("a/msg/Text", "string data\n")


def message_of(data: bytes) -> bytes:
    """A message to a topic."""
    return b'{"op":"publish","topic":"/a","msg":{"data":' + data + b"}}"


def listed(element: bytes) -> Callable[[int], bytes]:
    """A list of the same again and again, of so many bytes."""
    return lambda size: message_of(
        b"[" + element * ((size - 60) // len(element)) + element.rstrip(b",") + b"]"
    )


def text(element: bytes, after: bytes = b"") -> Callable[[int], bytes]:
    """A string of the same again and again."""
    return lambda size: message_of(b'"' + element * ((size - 60) // len(element)) + b'"' + after)


def with_nan(made: Callable[[int], bytes]) -> Callable[[int], bytes]:
    """The same, and NaN last."""
    return lambda size: made(size - 4).replace(b"]}}", b",NaN]}}")


def many_keys(size: int) -> bytes:
    """An object with as many fields as will fit."""
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
    """All the relay does with a message before it goes to the robot; what it says of one it refuses."""
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


def seconds(data: bytes, type_name: str, times: int = 2) -> float:
    """Of the processor, the least of some."""
    handle(b'{"op":"publish","topic":"/a","msg":{}}', type_name)
    found = []
    for _ in range(times):
        began = time.thread_time()
        handle(data, type_name)
        found.append(time.thread_time() - began)
    return min(found)


def unit() -> float:
    """What this machine takes to parse 1 MB of numbers, measured close to what it is compared with."""
    data, found = b"[" + b"1," * 500_000 + b"1]", []
    for _ in range(3):
        began = time.thread_time()
        json.loads(data)
        found.append(time.thread_time() - began)
    return min(found)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("size", [LARGEST - 1000, json_cost.LARGE, json_cost.COUNTED * 2])
def test_no_shape_of_a_large_message_takes_long(shape: str, size: int) -> None:
    """Measured against another parser at work on 1 MB. The old way took 20 to 40 times as long for some."""
    make, type_name = SHAPES[shape]
    taken = seconds(make(size), type_name)
    assert taken < 6 * unit(), f"{taken * 1000:.0f} ms"


@pytest.mark.parametrize("shape", SHAPES)
def test_twice_the_message_takes_at_most_some_three_times_as_long(shape: str) -> None:
    """At sizes of which both are read, or refused."""
    make, type_name = SHAPES[shape]
    half, whole = make(LARGEST // 2), make(LARGEST - 1000)
    assert seconds(whole, type_name) < 4 * seconds(half, type_name) + unit()


@pytest.mark.parametrize(
    ("element", "words"),
    [
        (b"{},", "may have 4096 objects and arrays, not "),
        (b'"",', "may have 16384 strings and names of fields, not "),
        (b"1,", "may have 1050000 values (commas), not "),
    ],
)
def test_too_much_in_a_large_message_is_refused_in_words(element: bytes, words: str) -> None:
    """With the count, the limit, and what to do."""
    with pytest.raises(json_cost.TooCostly, match="send bulk as base64, or less") as caught:
        rosbridge.decode(listed(element)(LARGEST - 1000))
    assert words in str(caught.value)


def test_what_large_messages_are_for_is_taken() -> None:
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


def test_small_messages_are_not_counted() -> None:
    """They may be all structure."""
    rosbridge.decode(listed(b"{},")(60 * KIB))
