"""Definitions as rosapi shows them (rosapi_msgs/TypeDef), with the type names its ROS 2 version uses."""

from __future__ import annotations

from typing import Any

from relay_protocol.ros.definition import Definition, Field, FieldType, Shape


def typedef(definition: Definition) -> dict[str, Any]:
    """One type. ``fieldarraylen`` is -1 for a single value, 0 for a sequence, else the array's length."""
    fields, constants = definition.fields, sorted(definition.constants)
    return {
        "type": short_name(definition.name),
        "fieldnames": [field.name for field in fields],
        "fieldtypes": [_type(field.type) for field in fields],
        "fieldarraylen": [_length(field.type) for field in fields],
        "examples": [_example(field) for field in fields],
        "constnames": [constant.name for constant in constants],
        "constvalues": [str(constant.value) for constant in constants],
    }


def short_name(name: str) -> str:
    """``geometry_msgs/msg/Point`` is ``geometry_msgs/Point`` to rosapi."""
    package, _, name = name.split("/")
    return f"{package}/{name}"


def _type(kind: FieldType) -> str:
    return short_name(kind.base) if kind.primitive is None else kind.primitive.idl


def _length(kind: FieldType) -> int:
    return {Shape.SCALAR: -1, Shape.SEQUENCE: 0, Shape.ARRAY: kind.length}[kind.shape]


def _example(field: Field) -> str:
    if field.type.shape is not Shape.SCALAR:
        return "[]"
    if field.type.primitive is None:
        return "{}"
    return str(field.type.primitive.zero if field.default is None else field.default)
