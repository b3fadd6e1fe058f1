"""Carries values from fields to fields: paths, checks of types before a pipe starts, and conversion of each value.

Numbers, booleans and strings are carried. A number or boolean becomes a string, a boolean becomes 0 or 1, a number
becomes a boolean by whether it is 0. A string becomes a number or a boolean only by a table.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from relay_protocol.errors import Invalid
from relay_protocol.ros.definition import BYTES, Definition, FieldType, Shape
from relay_server.pipes.schemas import FieldMapping

Step = str | int

_NAME = "[A-Za-z][A-Za-z0-9_]*"
_PATH = re.compile(rf"{_NAME}(?:\.{_NAME}|\[[0-9]{{1,9}}\])*\Z")
_STEP = re.compile(rf"({_NAME})|\[([0-9]+)\]")

_STRINGS = frozenset({"string", "wstring"})
_FLOATS = frozenset({"float32", "float64"})
_INTEGERS = {
    **{f"int{bits}": (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": (0, (1 << bits) - 1) for bits in (8, 16, 32, 64)},
    "byte": (0, 255),
    "char": (0, 255),
}
"""Least and greatest value by type."""

ANY = "any"
"""Stands for the type of a field in a program's values: each value is of its own type."""

_FLOAT32_MAX = 3.4028234663852886e38


def steps_of(path: str) -> list[Step]:
    """The names and indices of a path such as ``axes[0]`` or ``twist.linear.x``.

    :raises Invalid: it is none
    """
    if not _PATH.match(path):
        raise Invalid(f"'{path[:80]}' is no field; write it as 'axes[0]' or 'twist.linear.x'")
    return [name or int(index) for name, index in _STEP.findall(path)]


def type_of_field(definitions: Mapping[str, Definition], type_name: str, path: str) -> str:
    """The basic type of a field.

    :param definitions: of the message and all it contains
    :raises Invalid: there is no such field, or it holds more than one value
    """
    current = FieldType(type_name)
    for step in steps_of(path):
        if isinstance(step, int):
            if current.shape is Shape.SCALAR:
                raise Invalid(f"{type_name}: '{path}' has an index, but there is one value only")
            if current.shape is Shape.ARRAY and step >= current.length:
                raise Invalid(f"{type_name}: '{path}' is beyond the {current.length} values of the array")
            if current.base in BYTES:
                raise Invalid(f"{type_name}: '{path}' is one of many bytes, which are not carried one by one")
            current = FieldType(current.base, current.bound)
            continue
        if current.shape is not Shape.SCALAR:
            raise Invalid(f"{type_name}: '{path}' needs an index, as 'axes[0]'")
        definition = definitions.get(current.base)
        field = next((each for each in definition.fields if each.name == step), None) if definition else None
        if field is None:
            names = ", ".join(each.name for each in definition.fields) if definition else "no fields"
            raise Invalid(f"{type_name} has no field '{path}'; {current.base} has {names}")
        current = field.type
    if current.primitive is None or current.shape is not Shape.SCALAR:
        raise Invalid(f"{type_name}: '{path}' is no single value; name one of its fields")
    return current.base


def check_mapping(mapping: FieldMapping, source_type: str, target_type: str) -> None:
    """Check that values of one basic type can become values of another.

    :raises Invalid: they can't, or the table has a value that does not fit
    """
    target = f"'{mapping.target}' ({target_type})"
    if mapping.table:
        for value in mapping.table.values():
            convert(value, target_type, target)
        return
    if ANY in (source_type, target_type):
        return
    if source_type in _STRINGS and target_type not in _STRINGS:
        raise Invalid(
            f"'{mapping.source}' is a string and {target} is not; give a table of the values that it may have"
        )
    if (mapping.scale, mapping.offset) != (1.0, 0.0) and (source_type in _STRINGS or target_type in _STRINGS):
        raise Invalid(f"scale and offset are for numbers, but '{mapping.source}' or {target} is a string")


def convert(value: Any, target_type: str, name: str) -> Any:
    """A value as one of a basic type, or :data:`ANY`. Numbers are rounded to whole ones where the type needs that.

    :param name: of the target, for errors
    :raises Invalid: it does not fit
    """
    if target_type == ANY:
        return value
    if target_type in _STRINGS:
        return _text_of(value, name)
    if not isinstance(value, bool | int | float):
        raise Invalid(f"{name} takes no {_kind(value)}")
    if target_type == "bool":
        return bool(value)
    if target_type in _FLOATS:
        number = _float(value, name)
        if target_type == "float32" and abs(number) > _FLOAT32_MAX:
            raise Invalid(f"{number:g} is too large for {name}")
        return number
    whole = value if isinstance(value, int) else _rounded(value, name)
    least, most = _INTEGERS[target_type]
    if not least <= whole <= most:
        raise Invalid(f"{whole} does not fit {name}, which holds {least} to {most}")
    return int(whole)


class FieldConverter:
    """Makes the message of the target from that of the source.

    :param mappings: with the basic types of their targets
    """

    def __init__(self, mappings: Sequence[tuple[FieldMapping, str]]) -> None:
        self._carry = [_carrier(mapping, kind) for mapping, kind in mappings]

    def convert(self, message: Any) -> dict[str, Any]:
        """The target's message, with only the fields that are carried.

        :param message: of the source, decoded
        :raises Invalid: a field is missing, or a value does not fit
        """
        result: dict[str, Any] = {}
        for carry in self._carry:
            carry(message, result)
        return result


def _carrier(mapping: FieldMapping, target_type: str) -> Callable[[Any, dict[str, Any]], None]:
    """The function that carries one value from a message to another."""
    steps = steps_of(mapping.source)
    *parents, last = mapping.target.split(".")
    name = f"'{mapping.target}' ({target_type})"
    scaled = (mapping.scale, mapping.offset) != (1.0, 0.0)

    def carry(message: Any, result: dict[str, Any]) -> None:
        value = message
        try:
            for step in steps:
                value = value[step]
        except (LookupError, TypeError):
            raise Invalid(f"the message has no '{mapping.source}'") from None
        if mapping.table:
            key = _text_of(value, f"the table of '{mapping.source}'")
            if key not in mapping.table:
                raise Invalid(f"'{key[:40]}' of '{mapping.source}' is not in the table")
            value = mapping.table[key]
        elif scaled:
            value = _float(_number(value, mapping.source), name) * mapping.scale + mapping.offset
        for parent in parents:
            result = result.setdefault(parent, {})
        result[last] = convert(value, target_type, name)

    return carry


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool | int | float):
        return value
    raise Invalid(f"'{name}' is no number now")


def _kind(value: object) -> str:
    if isinstance(value, str):
        return "string"
    return "list" if isinstance(value, list) else "object" if isinstance(value, dict) else "empty value"


def _float(value: float, name: str) -> float:
    try:
        return float(value)
    except OverflowError:
        raise Invalid(f"a number is too large for {name}") from None


def _rounded(value: float, name: str) -> int:
    if not math.isfinite(value):
        raise Invalid(f"{value} does not fit {name}")
    return round(value)


def _text_of(value: Any, name: str) -> str:
    """A value as text, by which tables find it: ``true``, ``7``, ``0.5``.

    :raises Invalid: it is a list, an object or nothing, as NaN is in JSON
    """
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    if isinstance(value, int | float):
        return str(value)
    raise Invalid(f"{name} takes no {_kind(value)}")
