"""Converts CDR to values for JSON or CBOR: the slow path, with one reader per type and byte order.

Readers are closures built once. They accept every message; most messages use
:mod:`relay_protocol.ros.generated_cdr_to_json`. Neighbouring numbers are read by one :class:`struct.Struct`. CDR
aligns each number to its own size, counted from the start of the body, so a run of numbers has eight layouts, one per
remainder of its position. Lengths are checked against the bytes that are left before anything is made of them.

Source: OMG CORBA 3.3 part 2, section 9.3 (CDR), as ROS 2 uses it (DDSI-RTPS 2.2, section 10).
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy
import pybase64
from cbor2 import CBORTag

from relay_protocol.errors import Invalid
from relay_protocol.ros.definition import BYTES, Definition, Field, FieldType, Primitive, Shape

MAX_ELEMENTS = 250_000
"""Most messages and strings in the sequences of one message. An object takes far more memory than its bytes."""

TYPED_ARRAYS = {"B": 64, "H": 69, "I": 70, "Q": 71, "b": 72, "h": 77, "i": 78, "q": 79, "f": 85, "d": 86}
"""CBOR's tags of typed arrays, little endian, by the letter of the number (RFC 8746 section 2.1)."""

Read = Callable[[bytes, int], "tuple[Any, int]"]
"""Takes the message with its header and a position; returns the value and the position after it."""

Convert = Callable[[bytes, int, int], Any]
"""Takes the message, a position and a count of numbers; returns their representation."""

HEADER_BYTES = 4
"""Size of the encapsulation header; alignment counts from its end."""


class Reader(NamedTuple):
    """Reads one message.

    :param min_size: its smallest size, bytes
    """

    read: Read
    min_size: int


class Layout(NamedTuple):
    """Format and size in bytes of a run of numbers that starts at one remainder modulo 8."""

    codec: struct.Struct
    size: int


def layouts(primitives: list[Primitive], order: str) -> tuple[Layout, ...]:
    """The eight layouts of a run of numbers; ``order`` is ``<`` or ``>``."""
    found = []
    for start in range(8):
        text, position = order, start
        for primitive in primitives:
            padding = -position % primitive.size
            text += "x" * padding + primitive.code
            position += padding + primitive.size
        codec = struct.Struct(text)
        found.append(Layout(codec, codec.size))
    return tuple(found)


class ReaderFactory:
    """Builds readers for the types of one text.

    :param order: byte order of the messages, ``<`` or ``>``
    :param cbor: values are for CBOR, not for JSON: arrays of numbers are typed arrays
    """

    def __init__(self, definitions: dict[str, Definition], order: str, cbor: bool = False) -> None:
        self._definitions = definitions
        self._order = order
        self._cbor = cbor
        self._u32 = struct.Struct(order + "I").unpack_from
        self._readers: dict[str, Reader] = {}
        self._elements_left = 0

    def read(self, name: str, cdr: bytes) -> Any:
        """One message as values.

        :param cdr: with its encapsulation header, which is not checked here
        :raises Invalid: not a message of this type
        """
        self._elements_left = MAX_ELEMENTS
        try:
            return self.reader(name).read(cdr, HEADER_BYTES)[0]
        except struct.error:
            raise Invalid(f"the message ends too early, after {len(cdr)} bytes") from None

    def reader(self, name: str) -> Reader:
        """The reader of one message type."""
        if name not in self._readers:
            self._readers[name] = self._message(self._definitions[name])
        return self._readers[name]

    def _message(self, definition: Definition) -> Reader:
        if not definition.fields:
            return Reader(_read_empty, 1)
        groups = group_numbers(definition.fields)
        min_size = sum(self._min_size(field.type) for field in definition.fields)
        if len(groups) == 1 and isinstance(groups[0], NumberRun):
            return Reader(self._run(groups[0]), min_size)
        steps = [
            (None, self._run(each)) if isinstance(each, NumberRun) else (each.name, self._field(each.type))
            for each in groups
        ]

        def read(data: bytes, position: int) -> tuple[Any, int]:
            value: dict[str, Any] = {}
            for name, step in steps:
                part, position = step(data, position)
                if name is None:
                    value.update(part)
                else:
                    value[name] = part
            return value, position

        return Reader(read, min_size)

    def _run(self, run: NumberRun) -> Read:
        names = [field.name for field in run.fields]
        by_place = [(codec.unpack_from, size) for codec, size in layouts(run.primitives, self._order)]
        choices = [by_place[position - HEADER_BYTES & 7] for position in range(8)]

        def read(data: bytes, position: int) -> tuple[Any, int]:
            unpack, size = choices[position & 7]
            return dict(zip(names, unpack(data, position), strict=True)), position + size

        return read

    def _min_size(self, kind: FieldType) -> int:
        """Fewest bytes of a field, without padding."""
        if kind.shape is Shape.SEQUENCE:
            return 4
        one = self.reader(kind.base).min_size if kind.primitive is None else kind.primitive.size
        return one * (kind.length or 1)

    def _field(self, kind: FieldType) -> Read:
        primitive = kind.primitive
        if primitive is None:
            one, min_size = self.reader(kind.base)
        elif kind.base == "string":
            one, min_size = self._string(), 4
        elif kind.base == "wstring":
            one, min_size = self._wstring(), 4
        else:
            return self._numbers(kind, primitive)
        if kind.shape is Shape.SCALAR:
            return one
        return self._array(one, kind.length) if kind.shape is Shape.ARRAY else self._sequence(one, min_size)

    def _array(self, one: Read, length: int) -> Read:
        return lambda data, position: _read_many(one, length, data, position)

    def _sequence(self, one: Read, min_size: int) -> Read:
        u32 = self._u32

        def read(data: bytes, position: int) -> tuple[Any, int]:
            position = (position + 3) & -4
            (count,) = u32(data, position)
            position += 4
            if count * min_size > len(data) - position:
                raise Invalid(f"a sequence of {count} at byte {position} is longer than the message")
            self._elements_left -= count
            if self._elements_left < 0:
                raise Invalid(f"its sequences hold more than {MAX_ELEMENTS} messages and strings")
            return _read_many(one, count, data, position)

        return read

    def _numbers(self, kind: FieldType, primitive: Primitive) -> Read:
        """Arrays of numbers; those of bytes become base64."""
        u32, size = self._u32, primitive.size
        fixed = kind.length if kind.shape is Shape.ARRAY else None
        convert = self._converter(kind, primitive)

        def read(data: bytes, position: int) -> tuple[Any, int]:
            if fixed is None:
                position = (position + 3) & -4
                (count,) = u32(data, position)
                position += 4
            else:
                count = fixed
            if count:
                position += (HEADER_BYTES - position) % size
            end = position + count * size
            if end > len(data):
                raise Invalid(f"an array of {count} at byte {position} is longer than the message")
            return convert(data, position, count), end

        return read

    def _converter(self, kind: FieldType, primitive: Primitive) -> Convert:
        if self._cbor:
            return _typed_array(primitive, self._order)
        return _bytes_to_text if kind.base in BYTES else _numbers(primitive, self._order)

    def _string(self) -> Read:
        u32 = self._u32

        def read(data: bytes, position: int) -> tuple[Any, int]:
            position = (position + 3) & -4
            (length,) = u32(data, position)
            position += 4
            end = position + length
            if end > len(data):
                raise Invalid(f"a string of {length} bytes at byte {position} is longer than the message")
            # The length counts a closing NUL; some writers send 0 for an empty string. Bytes that are no
            # UTF-8 come from careless nodes, and one bad name should not hide the rest of the message.
            text = data[position : end - 1] if length and not data[end - 1] else data[position:end]
            return text.decode("utf-8", "replace"), end

        return read

    def _wstring(self) -> Read:
        u32, dtype = self._u32, self._order + "u4"

        def read(data: bytes, position: int) -> tuple[Any, int]:
            position = (position + 3) & -4
            (length,) = u32(data, position)
            position += 4
            end = position + 4 * length
            if end > len(data):
                raise Invalid(f"a wide string of {length} at byte {position} is longer than the message")
            # Fast DDS sends every UTF-16 unit as 32 bits.
            units = numpy.frombuffer(data, dtype, length, position) if length else numpy.zeros(0, dtype)
            if length and int(units.max()) > 0xFFFF:
                raise Invalid(f"a wide string at byte {position} holds more than 16 bits per character")
            return units.astype("<u2").tobytes().decode("utf-16-le", "replace"), end

        return read


class NumberRun(NamedTuple):
    """Neighbouring single numbers of a message."""

    fields: list[Field]
    primitives: list[Primitive]


def group_numbers(fields: tuple[Field, ...]) -> list[NumberRun | Field]:
    """Fields in order, neighbouring single numbers taken together."""
    groups: list[NumberRun | Field] = []
    run = NumberRun([], [])
    for field in fields:
        primitive = field.type.primitive
        if field.type.shape is Shape.SCALAR and primitive is not None and primitive.code:
            if not run.fields:
                groups.append(run)
            run.fields.append(field)
            run.primitives.append(primitive)
        else:
            groups.append(field)
            run = NumberRun([], [])
    return groups


def _read_many(one: Read, count: int, data: bytes, position: int) -> tuple[list[Any], int]:
    values = []
    for _ in range(count):
        value, position = one(data, position)
        values.append(value)
    return values, position


def _read_empty(data: bytes, position: int) -> tuple[Any, int]:
    """A message without fields is one byte in ROS 2, because IDL has no empty structures."""
    if position >= len(data):
        raise Invalid(f"the message ends at byte {position}")
    return {}, position + 1


def _bytes_to_text(data: bytes, position: int, count: int) -> str:
    return pybase64.b64encode_as_string(data[position : position + count])


_NATIVE = "<" if sys.byteorder == "little" else ">"


def _numbers(primitive: Primitive, order: str) -> Convert:
    if primitive.code == "?":
        # Any byte but 0 is true; numpy's bool takes only 0 and 1.
        return lambda data, position, count: numpy.frombuffer(data[position : position + count], "u1") != 0
    dtype = numpy.dtype(order + primitive.code)
    native = numpy.dtype(primitive.code)

    def convert(data: bytes, position: int, count: int) -> Any:
        if not count:
            return []
        # A copy, whose memory is aligned as orjson expects it; the message's head moves numbers by 4.
        numbers = numpy.frombuffer(data[position : position + count * dtype.itemsize], dtype)
        return numbers if order == _NATIVE else numbers.astype(native)

    return convert


def _typed_array(primitive: Primitive, order: str) -> Convert:
    if primitive.code == "?":
        return lambda data, position, count: [byte != 0 for byte in data[position : position + count]]
    tag, size = TYPED_ARRAYS[primitive.code], primitive.size

    def convert(data: bytes, position: int, count: int) -> Any:
        numbers = data[position : position + count * size]
        if order == ">" and size > 1:
            numbers = numpy.frombuffer(numbers, f"u{size}").byteswap().tobytes()
        return CBORTag(tag, numbers)

    return convert
