"""Conversion of every message and service of the installed ROS 2 packages, compared with rclpy itself."""

from __future__ import annotations

import base64
import importlib
import inspect
import json
import os
import random
import re
import struct
import sys
from pathlib import Path
from typing import Any

import pytest
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from rosidl_parser import definition as idl

from relay_protocol.ros.definition import PRIMITIVES
from relay_protocol.ros_types import TypeRegistry

SHARES = [
    Path(prefix) / "share"
    for prefix in [*os.environ.get("AMENT_PREFIX_PATH", "").split(":"), sys.prefix]
    if prefix
]
REFERENCE = re.compile(r"\s*([A-Za-z]\w*(?:/\w+){0,2})(?:<=\d+)?(?:\[[^\]]*\])?\s+[A-Za-z]")


def source(type_name: str) -> str:
    """The .msg or .srv text as installed."""
    package, kind, name = type_name.split("/")
    paths = [share / package / kind / f"{name}.{kind}" for share in SHARES]
    return next(path for path in paths if path.is_file()).read_text()


def whole_text(type_name: str) -> str:
    """A definition with all it contains, as rosbag2 lays it out."""
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


def installed() -> dict[str, tuple[str, Any]]:
    """Every message class: its name here, the type whose text defines it, and the class."""
    found: dict[str, tuple[str, Any]] = {}
    for path in sorted(
        path for share in SHARES for kind in ("msg", "srv") for path in share.glob(f"*/{kind}/*.{kind}")
    ):
        package, kind, name = path.parts[-3], path.parts[-2], path.stem
        try:
            cls = getattr(importlib.import_module(f"{package}.{kind}"), name)
        except ImportError:
            continue
        if kind == "msg":
            found[f"{package}/msg/{name}"] = (f"{package}/msg/{name}", cls)
        else:
            for part in ("Request", "Response"):
                found[f"{package}/srv/{name}_{part}"] = (f"{package}/srv/{name}", getattr(cls, part))
    return found


BAGS = get_typestore(Stores.ROS2_JAZZY)
"""A third implementation. It fills gaps with zeros as we do; rclpy leaves in them what was in memory."""

TYPES = installed()
REGISTRY = TypeRegistry()
for owner in {owner for owner, _ in TYPES.values()}:
    REGISTRY.add(owner, whole_text(owner))

RANGES = {
    f"{sign}int{bits}": (0, 2**bits - 1) if sign else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    for bits in (8, 16, 32, 64)
    for sign in ("", "u")
}
LETTERS = 'aZ0 _/-"\\\n\tß€😀'


def random_value(kind: Any, dice: random.Random) -> Any:
    """A value rclpy takes for this slot."""
    if isinstance(kind, idl.Array):
        return [random_value(kind.value_type, dice) for _ in range(kind.size)]
    if isinstance(kind, idl.AbstractSequence):
        most = min(kind.maximum_size, 5) if isinstance(kind, idl.BoundedSequence) else 5
        return [random_value(kind.value_type, dice) for _ in range(dice.randint(0, most))]
    if isinstance(kind, idl.NamespacedType):
        return random_message(getattr(importlib.import_module(".".join(kind.namespaces)), kind.name), dice)
    if isinstance(kind, idl.AbstractGenericString):
        return "".join(dice.choices(LETTERS, k=dice.randint(0, 9)))
    return random_number(kind.typename, dice)


def random_number(name: str, dice: random.Random) -> Any:
    """A value of a basic type, often at its edge."""
    if name == "boolean":
        return dice.random() < 0.5
    if name == "octet":
        return bytes([dice.randint(0, 255)])
    if name in RANGES:
        low, high = RANGES[name]
        return dice.choice([low, high, 0, dice.randint(low, high)])
    number = dice.choice([0.0, -1.5, 1e-30, dice.uniform(-1e6, 1e6)])
    return struct.unpack("f", struct.pack("f", number))[0] if name == "float" else number


def random_message(cls: Any, dice: random.Random) -> Any:
    """A message with every slot filled."""
    slots = zip(cls.get_fields_and_field_types(), cls.SLOT_TYPES, strict=True)
    return cls(**{name: random_value(kind, dice) for name, kind in slots})


def as_json(kind: Any, value: Any) -> Any:
    """What rosbridge's form of JSON says for a value of rclpy."""
    if isinstance(kind, idl.Array | idl.AbstractSequence):
        inner = kind.value_type
        if isinstance(inner, idl.BasicType) and inner.typename in ("uint8", "octet"):
            data = b"".join(value) if inner.typename == "octet" else bytes(value)
            return base64.b64encode(data).decode()
        return [as_json(inner, each) for each in value]
    if isinstance(kind, idl.NamespacedType):
        return message_as_json(value)
    if isinstance(kind, idl.BasicType):
        return exact(value[0] if kind.typename == "octet" else value, kind.typename)
    return value


def exact(value: Any, name: str) -> Any:
    """Single precision has several spellings in decimal: compare its bits."""
    return struct.pack("f", value) if name == "float" else value


def message_as_json(message: Any) -> dict[str, Any]:
    """A whole message in that form."""
    slots = zip(message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True)
    return {name: as_json(kind, getattr(message, name)) for name, kind in slots}


def with_bits(cls: Any, value: dict[str, Any]) -> dict[str, Any]:
    """Parsed JSON with its single-precision numbers as bits."""

    def walk(kind: Any, part: Any) -> Any:
        if isinstance(kind, idl.NamespacedType):
            return with_bits(getattr(importlib.import_module(".".join(kind.namespaces)), kind.name), part)
        if isinstance(kind, idl.Array | idl.AbstractSequence) and isinstance(part, list):
            return [walk(kind.value_type, each) for each in part]
        return exact(part, kind.typename) if isinstance(kind, idl.BasicType) else part

    kinds = dict(zip(cls.get_fields_and_field_types(), cls.SLOT_TYPES, strict=True))
    return {name: walk(kinds[name], part) for name, part in value.items()}


def test_many_types_are_compared() -> None:
    """The packages this suite is about are there."""
    packages = {name.split("/")[0] for name in TYPES}
    assert {"std_msgs", "geometry_msgs", "sensor_msgs", "nav_msgs", "diagnostic_msgs"} <= packages
    assert {"trajectory_msgs", "std_srvs", "rcl_interfaces"} <= packages
    assert len(TYPES) > 180


@pytest.mark.parametrize("name", TYPES)
def test_default_message_equals_rclpys(name: str) -> None:
    """A message nobody filled is what rclpy makes it, defaults of the definition included."""
    cls = TYPES[name][1]
    assert deserialize_message(REGISTRY.zero(name), cls) == cls()


@pytest.mark.parametrize("name", TYPES)
def test_random_messages_survive_both_ways(name: str) -> None:
    """rclpy's bytes become the right JSON, and that JSON becomes the same message again."""
    cls = TYPES[name][1]
    for seed in range(4):
        message = random_message(cls, random.Random(f"{name} {seed}"))
        cdr = serialize_message(message)
        text = REGISTRY.to_json(name, cdr)
        assert with_bits(cls, json.loads(text)) == message_as_json(message)
        again = REGISTRY.from_json(name, text, 0)
        assert deserialize_message(again, cls) == message
        if name in BAGS.fielddefs:
            assert again == BAGS.serialize_cdr(BAGS.deserialize_cdr(again, name), name)


@pytest.mark.parametrize("name", TYPES)
def test_typedef_names_fields_as_rclpy_does(name: str) -> None:
    """rosapi's view has rclpy's fields, types, array lengths and constants."""
    cls = TYPES[name][1]
    view = REGISTRY.typedefs(name)[0]
    fields = cls.get_fields_and_field_types()
    assert view["fieldnames"] == list(fields)
    for kind, length, text in zip(view["fieldtypes"], view["fieldarraylen"], fields.values(), strict=True):
        wanted = re.fullmatch(r"sequence<([^<,]+)(<\d+>)?(, \d+)?>|([^\[<]+)(<\d+>)?(?:\[(\d+)\])?", text)
        assert wanted is not None
        assert kind == (wanted[1] or wanted[4])
        assert length == (0 if wanted[1] else int(wanted[6] or -1))
    constants = {
        key: value
        for key, value in inspect.getmembers(cls)
        if key.isupper() and key != "SLOT_TYPES" and not key.endswith("__DEFAULT")
    }
    assert view["constnames"] == sorted(constants)
    shown = [str(value[0] if isinstance(value, bytes) else value) for _, value in sorted(constants.items())]
    assert view["constvalues"] == shown
