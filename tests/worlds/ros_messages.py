"""Every message of the installed ROS 2 packages: its text, rclpy's class, random values, and an independent
conversion.
"""

from __future__ import annotations

import base64
import importlib
import math
import os
import re
import struct
import sys
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from cbor2 import CBORTag
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from rosidl_parser import definition as idl

from relay_protocol.ros.definition import PRIMITIVES

SHARES = [
    Path(prefix) / "share"
    for prefix in [*os.environ.get("AMENT_PREFIX_PATH", "").split(":"), sys.prefix]
    if prefix
]
EVERY = settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=5,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)
"""A few messages of each of the many types, the same ones every time."""

MORE = settings(EVERY, max_examples=25)
"""For the types that have every kind of field."""


def thorough(name: str) -> settings:
    """The number of messages per type."""
    return MORE if name.startswith("switchboard_test_interfaces/msg") else EVERY


ASKED = ["Request", "Response", "Event"]
PARTS = {
    "msg": {"": ""},
    "srv": {part: part for part in ASKED},
    "action": {
        **{part: part for part in ("Goal", "Result", "Feedback")},
        "FeedbackMessage": "Impl.FeedbackMessage",
        **{f"SendGoal_{part}": f"Impl.SendGoalService.{part}" for part in ASKED},
        **{f"GetResult_{part}": f"Impl.GetResultService.{part}" for part in ASKED},
    },
}
"""Messages that are made of a type: how their names end, and where its class has theirs."""
REFERENCE = re.compile(r"\s*([A-Za-z]\w*(?:/\w+){0,2})(?:<=\d+)?(?:\[[^\]]*\])?\s+[A-Za-z]")


class Installed(NamedTuple):
    """One message: the type with its text, and rclpy's class."""

    owner: str
    cls: Any


def source(type_name: str) -> str:
    """The .msg, .srv or .action text as installed."""
    package, kind, name = type_name.split("/")
    paths = [share / package / kind / f"{name}.{kind}" for share in SHARES]
    return next(path for path in paths if path.is_file()).read_text()


def whole_text(type_name: str) -> str:
    """A definition with all nested types, in rosbag2's layout."""
    sections, seen, waiting = [source(type_name)], {type_name}, [(type_name, source(type_name))]
    while waiting:
        owner, text = waiting.pop(0)
        for base in (match[1] for match in map(REFERENCE.match, text.splitlines()) if match):
            if base in PRIMITIVES:
                continue
            *package, name = base.split("/")
            full = f"{package[0] if package else owner.split('/')[0]}/msg/{name}"
            if full not in seen:
                seen.add(full)
                sections.append(f"{'=' * 80}\nMSG: {full.replace('/msg/', '/')}\n{source(full)}")
                waiting.append((full, source(full)))
    return "\n".join(sections)


def installed() -> dict[str, Installed]:
    """All messages by their names, including those of services and actions."""
    found: dict[str, Installed] = {}
    for path in sorted(
        path for share in SHARES for kind in PARTS for path in share.glob(f"*/{kind}/*.{kind}")
    ):
        package, kind, name = path.parts[-3], path.parts[-2], path.stem
        try:
            cls = getattr(importlib.import_module(f"{package}.{kind}"), name)
        except ImportError:
            continue
        owner = f"{package}/{kind}/{name}"
        for part, path in PARTS[kind].items():
            made = attrgetter(path)(cls) if part else cls
            found[f"{owner}_{part}" if part else owner] = Installed(owner, made)
    return found


INTEGERS = {
    f"{'' if signed else 'u'}int{bits}": (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    if signed
    else (0, 2**bits - 1)
    for bits in (8, 16, 32, 64)
    for signed in (True, False)
}
LETTERS = st.sampled_from('aZ0 _/-"\\\n\t\x7fß€\uffff😀')
MOST = 4
"""Longest sequence that is made where nothing else bounds it."""


def slots(cls: Any) -> dict[str, Any]:
    """The fields of rclpy's class with their kinds."""
    return dict(zip(cls.get_fields_and_field_types(), cls.SLOT_TYPES, strict=True))


def class_of(kind: idl.NamespacedType) -> Any:
    """rclpy's class of a message within a message."""
    name, _, part = kind.name.partition("_")
    cls = getattr(importlib.import_module(".".join(kind.namespaces)), name)
    return attrgetter(PARTS[kind.namespaces[-1]][part])(cls) if part else cls


def messages(cls: Any, finite: bool = False) -> st.SearchStrategy[Any]:
    """Messages with random values in every field.

    :param finite: without NaN and infinity
    """
    kinds = {name: values(kind, finite) for name, kind in slots(cls).items()}
    return st.fixed_dictionaries(kinds).map(lambda fields: cls(**fields))


def values(kind: Any, finite: bool) -> st.SearchStrategy[Any]:
    """Values that rclpy accepts for a slot of this kind."""
    if isinstance(kind, idl.Array):
        return st.lists(values(kind.value_type, finite), min_size=kind.size, max_size=kind.size)
    if isinstance(kind, idl.AbstractSequence):
        most = kind.maximum_size if isinstance(kind, idl.BoundedSequence) else MOST
        return st.lists(values(kind.value_type, finite), max_size=min(most, MOST))
    if isinstance(kind, idl.NamespacedType):
        return st.deferred(lambda: messages(class_of(kind), finite))
    if isinstance(kind, idl.AbstractGenericString):
        return texts(kind)
    return numbers(kind.typename, finite)


def texts(kind: Any) -> st.SearchStrategy[str]:
    """Texts; the bound of a string counts bytes, that of a wide one UTF-16 units."""
    bound = getattr(kind, "maximum_size", None)
    text = st.text(LETTERS, max_size=bound if isinstance(bound, int) else 9)
    if not isinstance(bound, int):
        return text
    wide = isinstance(kind, idl.AbstractWString)
    return text.filter(
        lambda each: len(each.encode("utf-16-le")) <= 2 * bound if wide else len(each.encode()) <= bound
    )


def numbers(name: str, finite: bool) -> st.SearchStrategy[Any]:
    """Values of a basic type, often at its limits."""
    if name == "boolean":
        return st.booleans()
    if name == "octet":
        return st.binary(min_size=1, max_size=1)
    if name in INTEGERS:
        low, high = INTEGERS[name]
        return st.sampled_from([low, high, 0, high // 2 + 1]) | st.integers(low, high)
    width = 32 if name == "float" else 64
    return st.floats(width=width, allow_nan=not finite, allow_infinity=not finite)


def bits(value: Any, name: str) -> Any:
    """A number as its bits, so that NaN equals NaN, and decimal spellings of single precision are equal."""
    if name not in ("float", "double") or value is None:
        return value
    return "NaN" if math.isnan(value) else struct.pack("f" if name == "float" else "d", value)


def bulk(kind: Any) -> bool:
    """Whether a kind is an array or sequence of bytes."""
    inner = getattr(kind, "value_type", None)
    return isinstance(inner, idl.BasicType) and inner.typename in ("uint8", "octet")


def walk(kind: Any, value: Any, json: bool) -> Any:
    """A value of rclpy in rosbridge's JSON form, or in that of CBOR with its typed arrays as lists."""
    if isinstance(kind, idl.Array | idl.AbstractSequence):
        if json and bulk(kind):
            return base64.b64encode(
                b"".join(bytes([each]) if isinstance(each, int) else each for each in value)
            ).decode()
        return [walk(kind.value_type, each, json) for each in value]
    if isinstance(kind, idl.NamespacedType):
        return {name: walk(inner, getattr(value, name), json) for name, inner in slots(type(value)).items()}
    if not isinstance(kind, idl.BasicType):
        return value
    if kind.typename == "octet":
        return value[0]
    if json and kind.typename in ("float", "double") and not math.isfinite(value):
        return None
    return bits(value, kind.typename)


def walk_message(message: Any, json: bool) -> dict[str, Any]:
    """The same for a whole message."""
    return {name: walk(kind, getattr(message, name), json) for name, kind in slots(type(message)).items()}


def decoded(cls: Any, value: dict[str, Any]) -> dict[str, Any]:
    """Decoded JSON or CBOR in the form of :func:`walk`."""
    kinds = slots(cls)
    assert list(value) == list(kinds)
    return {name: _decoded(kinds[name], part) for name, part in value.items()}


def _decoded(kind: Any, value: Any) -> Any:
    if isinstance(kind, idl.NamespacedType):
        return decoded(class_of(kind), value)
    if isinstance(kind, idl.Array | idl.AbstractSequence):
        if isinstance(value, CBORTag):
            value = typed_array(value, kind.value_type.typename)
        return value if isinstance(value, str) else [_decoded(kind.value_type, each) for each in value]
    if isinstance(kind, idl.BasicType):
        assert (type(value) is bool) == (kind.typename == "boolean")
        return bits(value, kind.typename)
    return value


TYPED = {
    "uint8": (64, "B"), "octet": (64, "B"), "uint16": (69, "H"), "uint32": (70, "I"), "uint64": (71, "Q"),
    "int8": (72, "b"), "int16": (77, "h"), "int32": (78, "i"), "int64": (79, "q"), "float": (85, "f"),
    "double": (86, "d"),
}  # fmt: skip
"""Tag of the typed array of a basic type, and the letter of its numbers (RFC 8746)."""


def typed_array(value: CBORTag, name: str) -> list[Any]:
    """The numbers of a typed array, which must have the tag of this basic type."""
    tag, code = TYPED[name]
    assert value.tag == tag
    return [number for (number,) in struct.iter_unpack("<" + code, value.value)]
