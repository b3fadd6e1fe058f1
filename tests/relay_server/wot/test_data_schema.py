"""Schemas of ROS messages as they are in JSON."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol.ros.definition import parse
from relay_server.wot.data_schema import data_schema
from relay_server.wot.description import typed

TYPE = "made_up/msg/Odd"
NUMBER = {"oneOf": [{"type": "number"}, {"type": "null", "description": "NaN or infinity"}]}


def schema_of(text: str, most: int = 300) -> dict[str, Any]:
    return data_schema(parse(TYPE, text), TYPE, most)


@pytest.mark.parametrize(
    ("field", "schema"),
    [
        ("bool a", {"type": "boolean"}),
        ("int8 a", {"type": "integer", "minimum": -128, "maximum": 127}),
        ("uint32 a", {"type": "integer", "minimum": 0, "maximum": 4294967295}),
        ("int64 a", {"type": "integer"}),
        ("uint64 a", {"type": "integer", "minimum": 0}),
        ("float32 a", NUMBER),
        ("string a", {"type": "string"}),
        ("string<=5 a", {"type": "string", "maxLength": 5}),
        ("int32 a 7", {"type": "integer", "minimum": -(2**31), "maximum": 2**31 - 1, "default": 7}),
        ("uint8[] a", {"type": "string", "contentEncoding": "base64"}),
        ("bool[] a", {"type": "array", "items": {"type": "boolean"}}),
        ("bool[<=3] a", {"type": "array", "items": {"type": "boolean"}, "maxItems": 3}),
        ("bool[3] a", {"type": "array", "items": {"type": "boolean"}, "minItems": 3, "maxItems": 3}),
    ],
)
def test_fields_have_the_schema_of_their_json(field: str, schema: dict[str, Any]) -> None:
    assert schema_of(field)["properties"] == {"a": schema}


def test_units_hold_for_the_numbers_in_a_message() -> None:
    text = (
        "geometry_msgs/Twist twist\n" + "=" * 80 + "\nMSG: geometry_msgs/Twist\nVector3 linear\nVector3 angular\n"
        + "=" * 80 + "\nMSG: geometry_msgs/Vector3\nfloat64 x\n"
    )  # fmt: skip
    twist = schema_of(text)["properties"]["twist"]["properties"]
    assert [twist[each]["properties"]["x"]["unit"] for each in twist] == ["m/s", "rad/s"]


def test_constants_are_named() -> None:
    assert schema_of("uint8 OFF=0\nuint8 ON=1\nuint8 state")["description"] == (
        "made_up/msg/Odd. Constants: OFF = 0, ON = 1"
    )


def test_large_messages_are_not_described() -> None:
    assert schema_of("bool a\nbool b", most=1) == {"type": "object", "description": TYPE}


def test_typed_schemas_have_a_type_each() -> None:
    assert typed(schema_of("float32[] a"))["properties"]["a"] == {
        "type": "array",
        "items": {"type": "number"},
    }
