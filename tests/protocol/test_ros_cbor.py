"""CBOR on the wire: compared with RFC 8949 and 8746, and read by an unmodified roslib.js."""

from __future__ import annotations

import base64
import json
import math
import subprocess
from pathlib import Path
from typing import Any

import cbor2
import pytest
from hypothesis import given
from rclpy.serialization import serialize_message
from rosidl_parser import definition as idl

from relay_protocol.errors import Invalid
from relay_protocol.ros_types import TypeRegistry
from tests.worlds.ros_messages import bits, class_of, installed, messages, slots, thorough, whole_text
from tests.worlds.ros_texts import registry

ROOT = Path(__file__).resolve().parents[2]
ROSLIB = ROOT / "web_client" / "node_modules" / "roslib" / "dist" / "RosLib.js"
TYPES = {
    name: each
    for name, each in installed().items()
    if name.startswith(("switchboard_test", "sensor_msgs/msg"))
}
ARRAYS = {
    "uint8": "Uint8Array", "octet": "Uint8Array", "uint16": "Uint16Array", "uint32": "Uint32Array",
    "uint64": "BigUint64Array", "int8": "Int8Array", "int16": "Int16Array", "int32": "Int32Array",
    "int64": "BigInt64Array", "float": "Float32Array", "double": "Float64Array",
}  # fmt: skip


def sample(cbor: bytes) -> bytes:
    """A message as the relay publishes it."""
    parts = [cbor2.dumps(each) for each in ("op", "publish", "topic", "/t", "msg")]
    return b"\xa3" + b"".join(parts) + cbor


def as_roslib_says(kind: Any, value: Any) -> Any:
    """The script's output for a value of rclpy, numbers as bits."""
    if isinstance(kind, idl.NamespacedType):
        return message_as_roslib_says(value)
    if isinstance(kind, idl.Array | idl.AbstractSequence):
        inner, elements = kind.value_type, [as_roslib_says(kind.value_type, each) for each in value]
        if isinstance(inner, idl.BasicType) and inner.typename in ARRAYS:
            return {"array": ARRAYS[inner.typename], "values": elements}
        return elements
    if isinstance(kind, idl.AbstractGenericString):
        return {"text": value}
    if kind.typename == "boolean":
        return value
    return bits(value[0], "octet") if kind.typename == "octet" else bits(value, kind.typename)


def message_as_roslib_says(message: Any) -> dict[str, Any]:
    """The same of a whole message."""
    return {name: as_roslib_says(kind, getattr(message, name)) for name, kind in slots(type(message)).items()}


def numbered(kind: Any, value: Any) -> Any:
    """The script's output, its numbers as bits."""
    if isinstance(kind, idl.NamespacedType):
        return message_numbered(class_of(kind), value)
    if isinstance(kind, idl.Array | idl.AbstractSequence):
        inner = kind.value_type
        if isinstance(value, dict):
            return value | {"values": [numbered(inner, each) for each in value["values"]]}
        return [numbered(inner, each) for each in value]
    if isinstance(kind, idl.BasicType) and kind.typename in ("float", "double"):
        return bits(float(value), kind.typename)
    return int(value) if isinstance(kind, idl.BasicType) and kind.typename != "boolean" else value


def message_numbered(cls: Any, value: dict[str, Any]) -> dict[str, Any]:
    """The same of a whole message."""
    return {name: numbered(kind, value[name]) for name, kind in slots(cls).items()}


def drawn(name: str) -> list[tuple[Any, bytes]]:
    """Some random messages of this type, and their CBOR."""
    owner, cls = TYPES[name]
    types, found = TypeRegistry(), list[tuple[Any, bytes]]()
    types.add(owner, whole_text(owner))

    @thorough(name)
    @given(messages(cls))
    def collect(message: Any) -> None:
        found.append((message, types.to_cbor(name, serialize_message(message))))

    collect()
    return found


def test_roslib_reads_every_kind_of_field() -> None:
    """Every message of the test interfaces and of sensor_msgs is unchanged after roslib.js has decoded it."""
    sent = [each for name in TYPES for each in drawn(name)]
    lines = b"\n".join(base64.b64encode(sample(cbor)) for _, cbor in sent)
    node = [str(ROOT / "scripts" / "with-node.sh"), "node"]
    script = str(Path(__file__).with_name("cbor_with_roslib.mjs"))
    done = subprocess.run(
        [*node, script, str(ROSLIB)], input=lines, capture_output=True, timeout=100, check=True
    )
    printed = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(printed) == len(sent) > 200
    for (message, _), value in zip(sent, printed, strict=True):
        assert message_numbered(type(message), value) == message_as_roslib_says(message)


@pytest.mark.parametrize(
    ("text", "cdr", "cbor"),
    [
        ("float64 x", "000000000000f03f", "a16178fb3ff0000000000000"),
        ("float32 x", "0000803f", "a16178fa3f800000"),
        ("int16 x", "feff", "a16178390001"),
        ("uint8 x", "05", "a161781805"),
        ("bool x\nbool y", "0100", "a26178f56179f4"),
        ("string x", "0300000061620000", "a161787a000000026162"),
        ("uint8[] x", "02000000ff00", "a16178d8405a00000002ff00"),
        ("float32[2] x", "0000803f00000040", "a16178d855480000803f00000040"),
        ("int64[] x", "00000000", "a16178d84f5a00000000"),
        ("bool[2] x", "0100", "a1617882f5f4"),
        ("bool[] x", "020000000005", "a161789a00000002f4f5"),
        ("string[] x", "010000000100000000", "a161789a000000017a00000000"),
        ("", "00", "a0"),
    ],
)
def test_bytes_of_cbor(text: str, cdr: str, cbor: str) -> None:
    """The bytes of maps, keys, numbers and typed arrays."""
    assert registry(B=text).to_cbor("a/msg/B", bytes.fromhex("00010000" + cdr)).hex() == cbor


def test_big_endian_numbers_are_turned() -> None:
    """Typed arrays are little endian, for any byte order of the robot."""
    types = registry(B="int16[] a\nfloat64[2] b\nuint8[] c")
    cdr = bytes.fromhex("00000000 00000002 0001 fffe 3ff0000000000000 c000000000000000 00000001 07")
    value = cbor2.loads(types.to_cbor("a/msg/B", cdr))
    assert [(each.tag, each.value.hex()) for each in value.values()] == [
        (77, "0100feff"),
        (86, "000000000000f03f00000000000000c0"),
        (64, "07"),
    ]


def test_nan_and_infinity_stay() -> None:
    """CBOR has them, so no value is lost."""
    types = registry(B="float64 a\nfloat32 b\nfloat64[1] c")
    cdr = b"\0\1\0\0" + bytes.fromhex("000000000000f87f 000080ff 00000000 000000000000f07f")
    value = cbor2.loads(types.to_cbor("a/msg/B", cdr))
    assert math.isnan(value["a"])
    assert value["b"] == -math.inf
    assert value["c"].value.hex() == "000000000000f07f"


@pytest.mark.parametrize(
    "cdr", [b"", b"\0\1\0", b"\0\1\0\0", b"\0\1\0\0\xff\xff\xff\xff", b"\1\1\0\0\0\0\0\0"]
)
def test_bad_messages_are_reported_as_for_json(cdr: bytes) -> None:
    """The same bytes are refused, with the same error."""
    types = registry(B="string x")
    with pytest.raises(Invalid) as cbor:
        types.to_cbor("a/msg/B", cdr)
    with pytest.raises(Invalid) as text:
        types.to_json("a/msg/B", cdr)
    assert str(cbor.value) == str(text.value)
