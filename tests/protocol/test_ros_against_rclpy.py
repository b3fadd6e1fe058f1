"""Conversion of every message of the installed ROS 2 packages, compared with rclpy itself."""

from __future__ import annotations

import inspect
import json
import re
from typing import Any

import cbor2
import orjson
import pytest
from hypothesis import given, settings
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore

from relay_protocol.ros import generated_cdr_to_json, generated_json_to_cdr
from relay_protocol.ros.cdr_to_json import ReaderFactory
from relay_protocol.ros.json_to_cdr import WriterFactory
from relay_protocol.ros_types import TypeRegistry
from tests.worlds.ros_messages import EVERY, decoded, installed, messages, thorough, walk_message, whole_text

BAGS = get_typestore(Stores.ROS2_JAZZY)
"""A third implementation. It fills gaps with zeros as we do; rclpy leaves in them what was in memory."""

TYPES = installed()
TEXTS = {owner: whole_text(owner) for owner in {each.owner for each in TYPES.values()}}
REGISTRY = TypeRegistry()
for owner, text in TEXTS.items():
    REGISTRY.add(owner, text)


def refuse(*arguments: Any) -> bytes:
    """Replaces the closures where generated code must not need them."""
    raise AssertionError


def test_many_types_are_compared() -> None:
    """The packages of this suite are installed, and all parts of services and actions."""
    packages = {name.split("/")[0] for name in TYPES}
    assert {"std_msgs", "geometry_msgs", "sensor_msgs", "nav_msgs", "diagnostic_msgs"} <= packages
    assert {"trajectory_msgs", "std_srvs", "rcl_interfaces", "switchboard_test_interfaces"} <= packages
    assert {f"example_interfaces/action/Fibonacci_{part}" for part in ("Goal", "Result", "Feedback")} <= set(
        TYPES
    )
    assert len(TYPES) > 180


@pytest.mark.parametrize("name", TYPES)
def test_default_message_equals_rclpys(name: str) -> None:
    """An empty message has rclpy's values, with defaults of the definition."""
    cls = TYPES[name].cls
    assert deserialize_message(REGISTRY.zero(name), cls) == cls()
    assert REGISTRY.from_json(name, b"{}", 0) == REGISTRY.from_json(name, {}, 0) == REGISTRY.zero(name)


# Hypothesis runs inside the tests: its decorators on parametrized tests conflict with the Twisted plugin.
@pytest.mark.parametrize("name", TYPES)
def test_messages_from_rclpy_are_read(name: str) -> None:
    """rclpy's bytes become the JSON and CBOR of an independent conversion, by every code path."""
    cls, definitions = TYPES[name].cls, REGISTRY._types[name].definitions
    fast = {
        form: generated_cdr_to_json.generate(name, definitions, form, refuse) for form in ("json", "cbor")
    }
    slow = {form: ReaderFactory(definitions, "<", form == "cbor") for form in ("json", "cbor")}

    @thorough(name)
    @given(messages(cls))
    def check(message: Any) -> None:
        cdr = serialize_message(message)
        wanted = walk_message(message, json=True)
        for text in (REGISTRY.to_json(name, cdr), fast["json"](cdr), dumped(slow["json"].read(name, cdr))):
            assert decoded(cls, json.loads(text)) == wanted
        wanted = walk_message(message, json=False)
        for data in (
            REGISTRY.to_cbor(name, cdr),
            fast["cbor"](cdr),
            cbor2.dumps(slow["cbor"].read(name, cdr)),
        ):
            assert decoded(cls, cbor2.loads(data)) == wanted

    check()


def dumped(value: Any) -> bytes:
    """The closures' result, as text."""
    return orjson.dumps(value, option=orjson.OPT_SERIALIZE_NUMPY)


@pytest.mark.parametrize("name", TYPES)
def test_messages_for_rclpy_are_written(name: str) -> None:
    """JSON becomes the message that rclpy would have sent: rclpy reads it, and the bytes are equal."""
    cls, definitions = TYPES[name].cls, REGISTRY._types[name].definitions
    fast, slow = (
        generated_json_to_cdr.generate(name, definitions)(refuse),
        WriterFactory(definitions).writer(name),
    )

    @thorough(name)
    @given(messages(cls, finite=True))
    def check(message: Any) -> None:
        theirs = serialize_message(message)
        text = REGISTRY.to_json(name, theirs)
        ours = REGISTRY.from_json(name, text, 0)
        read = deserialize_message(ours, cls)
        assert walk_message(read, json=False) == walk_message(message, json=False)
        assert same_but_for_gaps(ours, theirs)
        if name in BAGS.fielddefs:
            assert ours == BAGS.serialize_cdr(BAGS.deserialize_cdr(ours, name), name)
        assert fast(text, 0) == ours
        out = bytearray()
        slow(out, json.loads(text), 0)
        assert b"\0\1\0\0" + out == ours

    check()


def same_but_for_gaps(ours: bytes, theirs: bytes) -> bool:
    """Whether theirs contains all of ours, except zeros in padding.

    rclpy leaves arbitrary memory in padding, and adds more at the end: it pads, and counts gaps before empty
    sequences that it does not write.
    """
    return len(ours) <= len(theirs) and all(mine in (its, 0) for mine, its in zip(ours, theirs, strict=False))


@pytest.mark.parametrize("name", TYPES)
def test_numbers_json_lacks_come_back_as_nan(name: str) -> None:
    """NaN and infinity become null, and null becomes NaN; the rest is unchanged."""
    cls = TYPES[name].cls

    @settings(EVERY, max_examples=3)
    @given(messages(cls))
    def check(message: Any) -> None:
        text = REGISTRY.to_json(name, serialize_message(message))
        back = deserialize_message(REGISTRY.from_json(name, text, 0), cls)
        assert walk_message(back, json=True) == walk_message(message, json=True)

    check()


@pytest.mark.parametrize("name", TYPES)
def test_typedef_names_fields_as_rclpy_does(name: str) -> None:
    """rosapi's view has rclpy's fields, types, array lengths and constants."""
    cls = TYPES[name].cls
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
