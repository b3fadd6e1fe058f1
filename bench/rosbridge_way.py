"""How rosbridge turns a ROS 2 message into JSON: a stand-in of ours, because it is not on the package index.

It takes the steps rosbridge_library 2 is known to take, written anew: the name of the type is read off the printed
message; every single value is asked by patterns whether it is an array of bytes, then whether it is a time, a
primitive, a list or a message; floats of arrays are looked at one by one, NaN and infinity become ``None``; arrays of
bytes become base64. :func:`lean` gives the same without the printed message and the patterns.
"""

from __future__ import annotations

import array
import base64
import math
import re
from collections.abc import Callable
from typing import Any

import numpy

_FLOATS = ("float32", "float64", "float", "double")
_WHOLE = ("int8", "octet", "uint8", "char", "int16", "uint16", "int32", "uint32", "int64", "uint64")
_PRIMITIVES = ("bool", "boolean", *_WHOLE, *_FLOATS, "string")
_TIMES = ("builtin_interfaces/Time", "builtin_interfaces/Duration")
_BYTE_ARRAYS = ("uint8[]", "char[]", "sequence<uint8>", "sequence<char>")
_SIZED_BYTES = tuple((f"{name}[]", re.compile(rf"{name}\[\d*\]")) for name in ("uint8", "char"))
_LISTS = (list, tuple, numpy.ndarray, array.array)
_ELEMENT = re.compile(r"<([^,>]+)")
_SIZED_ELEMENT = re.compile(r"([^\[]+)\[")


def values(message: Any) -> Any:
    """A message as values for JSON, the way rosbridge goes."""
    package, _, rest = str(message).split(".", 2)
    return _value(message, f"{package}/{rest.split('(')[0]}")


def _value(value: Any, kind: str) -> Any:
    for plain, pattern in _SIZED_BYTES:
        if pattern.sub(plain, kind) in _BYTE_ARRAYS:
            return base64.standard_b64encode(value).decode("ascii")
    if kind in _TIMES:
        return {"sec": value.sec, "nanosec": value.nanosec}
    if kind in _PRIMITIVES:
        if kind in _FLOATS and (math.isnan(value) or math.isinf(value)):
            return None
        return int.from_bytes(value, "little") if kind == "octet" else value
    if type(value) in _LISTS:
        return _list(value, kind)
    return {name: _value(getattr(value, name), of) for name, of in value.get_fields_and_field_types().items()}


def _list(value: Any, kind: str) -> list[Any]:
    if not len(value):
        return []
    found = _ELEMENT.search(kind) or _SIZED_ELEMENT.search(kind)
    assert found is not None
    element = found[1]
    if element in _PRIMITIVES:
        if isinstance(value, numpy.ndarray):
            return list(value.tolist())
        if element not in _FLOATS:
            return list(value)
    return [_value(each, element) for each in value]


def lean(message: Any) -> Any:
    """The same values without detours: what a careful hand would make of such a walk in Python."""
    return {
        name: _LEAN.get(kind, _lean_other)(getattr(message, name), kind)
        for name, kind in message.get_fields_and_field_types().items()
    }


def _lean_float(value: float, _: str) -> float | None:
    return value if math.isfinite(value) else None


def _lean_other(value: Any, kind: str) -> Any:
    if not kind.endswith((">", "]")):
        return value if isinstance(value, (int, str, bool)) else lean(value)
    if "uint8" in kind or "char" in kind:
        return base64.b64encode(value).decode("ascii")
    if isinstance(value, (array.array, numpy.ndarray)):
        return [each if math.isfinite(each) else None for each in value.tolist()]
    return [each if isinstance(each, (int, str)) else lean(each) for each in value]


_LEAN: dict[str, Callable[[Any, str], Any]] = {
    "float": _lean_float,
    "double": _lean_float,
    "string": lambda value, _: value,
    "octet": lambda value, _: value[0],
}
