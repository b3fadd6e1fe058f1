"""Values of parameters: JSON on one side, ``rcl_interfaces/msg/ParameterValue`` on the other."""

from __future__ import annotations

import base64
import binascii
import math
from typing import Any

from relay_protocol.errors import Invalid

NOT_SET = 0
BOOL = 1
INTEGER = 2
DOUBLE = 3
STRING = 4
BYTES = 5
BOOLS = 6
INTEGERS = 7
DOUBLES = 8
STRINGS = 9

_FIELDS = {
    BOOL: "bool_value",
    INTEGER: "integer_value",
    DOUBLE: "double_value",
    STRING: "string_value",
    BYTES: "byte_array_value",
    BOOLS: "bool_array_value",
    INTEGERS: "integer_array_value",
    DOUBLES: "double_array_value",
    STRINGS: "string_array_value",
}
_OF_ELEMENTS = {BOOL: BOOLS, INTEGER: INTEGERS, DOUBLE: DOUBLES, STRING: STRINGS}


def from_parameter(told: Any) -> tuple[Any] | None:
    """The value as JSON has it, in a tuple of its own because it can be null (NaN); ``None`` when nothing is set.

    :param told: a ParameterValue in JSON, from a robot
    :raises Invalid: it is none
    """
    try:
        kind = told["type"]
        if kind == NOT_SET:
            return None
        value = told[_FIELDS[kind]]
        if kind == BYTES and isinstance(value, str):
            # In messages bytes are base64; a parameter's value is what people read and write.
            return (list(base64.b64decode(value, validate=True)),)
    except (TypeError, KeyError, binascii.Error, ValueError):
        raise Invalid("this is no value of a parameter") from None
    return (value,)


def to_parameter(value: Any, has: int | None = None) -> dict[str, Any]:
    """A ParameterValue in JSON, to be sent to a robot.

    :param value: decoded from JSON
    :param has: the type the parameter has now, where that is known: it decides between 1 and 1.0, bytes and
        integers, what an empty list is of, and whether null is NaN, as which it is read
    :raises Invalid: no parameter can have this value
    """
    if isinstance(value, list):
        if has == DOUBLES or any(isinstance(each, float) for each in value):
            value = [math.nan if each is None else each for each in value]
        kind = _kind_of_list(value, has)
    else:
        if value is None and has == DOUBLE:
            value = math.nan
        kind = _kind(value)
        if kind == INTEGER and has == DOUBLE:
            kind = DOUBLE
    return {"type": kind, _FIELDS[kind]: value}


def _kind(value: Any) -> int:
    if isinstance(value, bool):
        return BOOL
    if isinstance(value, int):
        return INTEGER
    if isinstance(value, float):
        return DOUBLE
    if isinstance(value, str):
        return STRING
    if value is None:
        raise Invalid(
            "null is NaN, which only a parameter of numbers with a fraction can be; this one is none now"
        )
    raise Invalid("a parameter is a boolean, a number, a string, or a list of one of these")


def _kind_of_list(values: list[Any], has: int | None) -> int:
    kinds = {_kind(each) for each in values}
    if not kinds:
        if has in (BYTES, BOOLS, INTEGERS, DOUBLES, STRINGS):
            return has
        raise Invalid("nobody can tell what an empty list would hold: the parameter has no type yet")
    if kinds == {INTEGER, DOUBLE} or (kinds == {INTEGER} and has == DOUBLES):
        return DOUBLES
    if kinds == {INTEGER} and has == BYTES and all(0 <= each <= 255 for each in values):
        return BYTES
    if len(kinds) > 1:
        raise Invalid("a parameter's list holds values of one type only")
    return _OF_ELEMENTS[kinds.pop()]
