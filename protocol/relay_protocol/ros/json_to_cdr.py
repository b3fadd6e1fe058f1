"""Converts JSON values to CDR: the slow path, with one writer per type, built once out of closures.

Every value is checked against its type; an error names the path to the value. Missing fields get the default of the
definition, else zero. A ``std_msgs/Header`` without a stamp gets the current time.

Source: as in :mod:`relay_protocol.ros.cdr_to_json`; always little endian.
"""

from __future__ import annotations

import array
import struct
import sys
from collections.abc import Callable
from typing import Any

import pybase64

from relay_protocol.errors import Invalid
from relay_protocol.limits import RELAY_FRAME
from relay_protocol.nonfinite import NUMBERS, display_name
from relay_protocol.ros.cdr_to_json import NumberRun, group_numbers, layouts
from relay_protocol.ros.definition import BYTES, HEADER, Definition, Field, FieldType, Primitive, Shape

Write = Callable[[bytearray, Any, int], None]
"""Takes the body so far, the value, and the present time (ns since 1970); appends."""

_U32 = struct.Struct("<I").pack
_PADDING = (b"", b"\0", b"\0\0", b"\0\0\0", b"\0" * 4, b"\0" * 5, b"\0" * 6, b"\0" * 7)
_TIME_TYPE = "builtin_interfaces/msg/Time"
_ROS1_TIME = {_TIME_TYPE, "builtin_interfaces/msg/Duration"}
_ROS1_NAMES = {"secs": "sec", "nsecs": "nanosec"}
_NUMBERS = {
    "?": frozenset({bool}),
    "f": frozenset({float, int}),
    "d": frozenset({float, int}),
}
_INTEGER = frozenset({int})
_LINE_BREAKS = b"\r\n"
_ZEROS = object()
"""Default of a fixed array of numbers, which may be long."""
_KINDS = {
    type(None): "null",
    bool: "a boolean",
    int: "a number",
    float: "a number",
    str: "a string",
    list: "an array",
    dict: "an object",
}


class Mismatch(Exception):
    """A value of the wrong type. The path grows while the error passes through the nested writers."""

    def __init__(self, problem: str, path: str = "") -> None:
        super().__init__(problem)
        self.problem = problem
        self.path = path

    def within(self, step: str) -> Mismatch:
        """The same error with the path of one level further out."""
        glue = "" if not self.path or self.path.startswith("[") else "."
        return Mismatch(self.problem, f"{step}{glue}{self.path}")


class WriterFactory:
    """Builds writers for the types of one text."""

    def __init__(self, definitions: dict[str, Definition]) -> None:
        self._definitions = definitions
        self._writers: dict[str, Write] = {}

    def writer(self, name: str) -> Write:
        """The writer of one message type. It raises :class:`Mismatch`."""
        if name not in self._writers:
            self._writers[name] = self._message(self._definitions[name])
        return self._writers[name]

    def _message(self, definition: Definition) -> Write:
        known = {field.name for field in definition.fields}
        steps = [
            _run(each) if isinstance(each, NumberRun) else self._named(each)
            for each in group_numbers(definition.fields)
        ]
        ros1 = definition.name in _ROS1_TIME
        header = definition.name == HEADER and "stamp" in known

        def write(out: bytearray, value: Any, now: int) -> None:
            if type(value) is not dict:
                raise Mismatch(_not_a_message(value, definition))
            if ros1 and not known.issuperset(value):
                value = {_ROS1_NAMES.get(name, name): part for name, part in value.items()}
            if not known.issuperset(value):
                name = next(name for name in value if name not in known)
                raise Mismatch(_unknown(name, definition), shorten(display_name(name)))
            if header and "stamp" not in value:
                value = {**value, "stamp": {"sec": now // 10**9, "nanosec": now % 10**9}}
            for step in steps:
                step(out, value, now)

        return write if definition.fields else _empty(definition)

    def _named(self, field: Field) -> Write:
        name, write, default = field.name, self._field(field.type), _default(field)

        def step(out: bytearray, value: Any, now: int) -> None:
            try:
                write(out, value.get(name, default), now)
            except Mismatch as error:
                raise error.within(name) from None

        return step

    def _field(self, kind: FieldType) -> Write:
        primitive = kind.primitive
        if primitive is not None and primitive.code:
            return _number_array(kind, primitive)
        if primitive is None:
            one = self.writer(kind.base)
        else:
            one = _string(kind) if kind.base == "string" else _wstring(kind)
        return one if kind.shape is Shape.SCALAR else _elements(kind, one)


def _unknown(name: str, definition: Definition) -> str:
    """Error message for an unknown field."""
    if definition.name == HEADER and name == "seq":
        return f"is no field of {HEADER} in ROS 2; leave it out"
    return f"is no field of {definition.name}"


def _not_a_message(value: Any, definition: Definition) -> str:
    """Error message for a value that is not an object."""
    if definition.name == _TIME_TYPE and type(value) is str:
        return (
            f'must be an object, not {_kind(value)}: send {{"sec": ..., "nanosec": ...}}, '
            "or leave the stamp of a header out for the current time"
        )
    return f"must be an object, not {_kind(value)}"


def _default(field: Field) -> Any:
    """The value of a missing field."""
    if field.default is not None:
        return field.default
    kind = field.type
    zero: Any = {} if kind.primitive is None else kind.primitive.zero
    if kind.shape is Shape.SCALAR:
        return zero
    if kind.shape is Shape.ARRAY and kind.primitive is not None and kind.primitive.code:
        return _ZEROS
    return [] if kind.shape is Shape.SEQUENCE else [zero] * kind.length


def _empty(definition: Definition) -> Write:
    def write(out: bytearray, value: Any, now: int) -> None:
        if type(value) is not dict:
            raise Mismatch(f"must be an object, not {_kind(value)}")
        if value:
            raise Mismatch(f"is no field of {definition.name}, which has none", shorten(next(iter(value))))
        out.append(0)

    return write


def _run(run: NumberRun) -> Write:
    """Neighbouring numbers: packed at once, checked one by one only when that fails."""
    parts = [
        (field.name, _default(field), accepted(primitive))
        for field, primitive in zip(run.fields, run.primitives, strict=True)
    ]
    packers = [codec.pack for codec, _ in layouts(run.primitives, "<")]

    def write(out: bytearray, value: Any, now: int) -> None:
        get = value.get
        numbers = []
        for name, default, types in parts:
            number = get(name, default)
            if type(number) not in types:
                break
            numbers.append(number)
        else:
            try:
                out += packers[len(out) & 7](*numbers)
                return
            except (struct.error, OverflowError):
                pass
        numbers = []
        for (name, default, _), primitive in zip(parts, run.primitives, strict=True):
            try:
                numbers.append(fit(get(name, default), primitive))
            except Mismatch as error:
                raise error.within(name) from None
        out += packers[len(out) & 7](*numbers)

    return write


def accepted(primitive: Primitive) -> frozenset[type]:
    """Python types of JSON values that :mod:`struct` packs without conversion."""
    return _NUMBERS.get(primitive.code, _INTEGER)


def fit(value: Any, primitive: Primitive) -> Any:
    """Convert a value to this type of number.

    :raises Mismatch: wrong type, or out of range
    """
    if primitive.code == "?":
        if type(value) is not bool:
            raise Mismatch(f"must be true or false, not {_kind(value)}")
        return value
    if primitive.code in "fd":
        if value is None:
            return float("nan")
        if type(value) is str and value in NUMBERS:
            return NUMBERS[value]
        if type(value) not in (int, float):
            raise Mismatch(f"must be a number, not {_kind(value)}")
    elif type(value) is float and value.is_integer():
        value = int(value)
    elif type(value) is not int:
        raise Mismatch(f"must be an integer, not {_fraction(value)}")
    try:
        struct.pack("<" + primitive.code, value)
    except (struct.error, OverflowError):
        raise Mismatch(f"is out of range for {_msg_name(primitive)}") from None
    return value


def _msg_name(primitive: Primitive) -> str:
    return {"float": "float32", "double": "float64", "octet": "byte"}.get(primitive.idl, primitive.idl)


def _fraction(value: Any) -> str:
    return "a fraction" if type(value) is float else _kind(value)


def _number_array(kind: FieldType, primitive: Primitive) -> Write:
    is_bytes = kind.base in BYTES
    types = accepted(primitive)
    code = "B" if primitive.code == "?" else primitive.code

    def write(out: bytearray, value: Any, now: int) -> None:
        if value is _ZEROS:
            body = bytes(kind.length * primitive.size)
        elif is_bytes and type(value) is str and value not in NUMBERS:
            body = _from_base64(value)
            _check_length(kind, len(body))
        else:
            body = _pack(_as_list(kind, value), code, types, primitive)
        if kind.shape is Shape.SEQUENCE:
            out += _PADDING[-len(out) & 3]
            out += _U32(len(body) // primitive.size)
        if body:
            out += _PADDING[-len(out) % primitive.size]
            out += body

    return write


def _pack(values: list[Any], code: str, types: frozenset[type], primitive: Primitive) -> bytes:
    if types.issuperset(map(type, values)):
        try:
            return _array_bytes(code, values)
        except (OverflowError, struct.error):
            pass
    fitted = []
    for index, value in enumerate(values):
        try:
            fitted.append(fit(value, primitive))
        except Mismatch as error:
            raise error.within(f"[{index}]") from None
    return _array_bytes(code, fitted)


def _array_bytes(code: str, values: list[Any]) -> bytes:
    if code == "f":
        # array.array turns too large a number into infinity without a word; struct refuses it.
        return struct.pack(f"<{len(values)}f", *values)
    numbers = array.array(code, values)
    if sys.byteorder == "big":
        numbers.byteswap()
    return numbers.tobytes()


def _from_base64(text: str) -> bytes:
    try:
        # Some encoders break lines (RFC 2045 section 6.8), with CR LF or LF; nothing else beside the alphabet is taken.
        return pybase64.b64decode(text.encode("ascii").translate(None, _LINE_BREAKS), validate=True)
    except ValueError:
        raise Mismatch("is a string that is not base64") from None


def _as_list(kind: FieldType, value: Any) -> list[Any]:
    if type(value) is not list:
        form = "an array or a base64 string" if kind.base in BYTES else "an array"
        raise Mismatch(f"must be {form}, not {_kind(value)}")
    _check_length(kind, len(value))
    return value


def _check_length(kind: FieldType, length: int) -> None:
    if kind.shape is Shape.ARRAY and length != kind.length:
        raise Mismatch(f"must have exactly {kind.length} elements, not {length}")
    if kind.shape is Shape.SEQUENCE and kind.length and length > kind.length:
        raise Mismatch(f"must have at most {kind.length} elements, not {length}")


def _elements(kind: FieldType, one: Write) -> Write:
    def write(out: bytearray, value: Any, now: int) -> None:
        values = _as_list(kind, value)
        if kind.shape is Shape.SEQUENCE:
            out += _PADDING[-len(out) & 3]
            out += _U32(len(values))
        for index, each in enumerate(values):
            try:
                one(out, each, now)
            except Mismatch as error:
                raise error.within(f"[{index}]") from None
            # A few bytes of JSON can stand for a large message of defaults.
            if len(out) > RELAY_FRAME:
                raise Mismatch(f"makes a message of more than {RELAY_FRAME} bytes")

    return write


def _string(kind: FieldType) -> Write:
    def write(out: bytearray, value: Any, now: int) -> None:
        body = _text(kind, value, "utf-8")
        if kind.bound and len(body) > kind.bound:
            raise Mismatch(f"must have at most {kind.bound} bytes of UTF-8, not {len(body)}")
        out += _PADDING[-len(out) & 3]
        out += _U32(len(body) + 1)
        out += body
        out.append(0)

    return write


def _wstring(kind: FieldType) -> Write:
    def write(out: bytearray, value: Any, now: int) -> None:
        body = _text(kind, value, "utf-16-le")
        length = len(body) // 2
        if kind.bound and length > kind.bound:
            raise Mismatch(f"must have at most {kind.bound} characters, not {length}")
        if 4 * length > RELAY_FRAME:
            raise Mismatch(f"makes a message of more than {RELAY_FRAME} bytes")
        out += _PADDING[-len(out) & 3]
        out += _U32(length)
        out += widen(body)

    return write


def widen(utf16: bytes) -> bytes:
    """The units of a wide string, in 32 bits each.

    :param utf16: little endian
    """
    units = bytearray(2 * len(utf16))
    units[::4], units[1::4] = utf16[::2], utf16[1::2]
    return bytes(units)


def _text(kind: FieldType, value: Any, encoding: str) -> bytes:
    if type(value) is not str or value in NUMBERS:
        raise Mismatch(f"must be a string, not {_kind(value)}")
    if "\0" in value:
        raise Mismatch("must not hold a NUL character, which ends a string in ROS")
    try:
        return value.encode(encoding)
    except UnicodeEncodeError:
        raise Mismatch("holds half of a surrogate pair") from None


def _kind(value: Any) -> str:
    if type(value) is str and value in NUMBERS:
        return display_name(value)
    return _KINDS.get(type(value), type(value).__name__)


def shorten(text: str) -> str:
    """Text from a client, shortened for an error message."""
    return text if len(text) <= 60 else text[:57] + "..."


def as_invalid(type_name: str, error: Mismatch) -> Invalid:
    """The error message for the client."""
    return Invalid(
        f"{type_name}: {error.path} {error.problem}" if error.path else f"{type_name} {error.problem}"
    )
