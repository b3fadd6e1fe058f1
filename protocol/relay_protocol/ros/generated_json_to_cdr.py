"""Converts JSON to CDR by code generated for the type; see :mod:`relay_protocol.ros.codegen`.

msgspec decodes and checks the text; neighbouring numbers are packed at once, across nested messages. Invalid values and
unusual spellings use the slow path.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Sequence
from typing import Any, cast

import msgspec
import pybase64
from msgspec import UNSET

from relay_protocol import jsontext
from relay_protocol.limits import RELAY_FRAME
from relay_protocol.ros.cdr_to_json import HEADER_BYTES
from relay_protocol.ros.codegen import CodeGenerator, FunctionBuilder, TooLarge, UseSlowPath
from relay_protocol.ros.definition import BYTES, Definition, Field, FieldType, Shape
from relay_protocol.ros.json_to_cdr import widen
from relay_protocol.ros.layout import LayoutTable
from relay_protocol.ros.structs import StructFactory, is_stamp, is_time

Write = Callable[[Any, int], bytes]
Check = Callable[[bytes], bytes]
"""Takes JSON text that was checked; returns it as robots that speak JSON get it. Raises
:class:`relay_protocol.errors.Invalid` where a writer does."""

LARGEST_BODY = RELAY_FRAME - 17
"""Bytes left in a frame to a robot after kind, number, stamp and encapsulation header."""

_CHECKED_BYTES = 1024 * 1024
"""Longest JSON that is checked without writing the message; no message of it is too large for a robot."""

_UNROLLED = 4
"""Longest array of messages whose elements are written out."""

_FORMATTED = 100
"""Longest array of numbers for which a format is cached."""

_LITTLE_ENDIAN_HEADER = int.from_bytes(b"\x00\x01\x00\x00", "little")

_PADDING = {
    alignment: tuple(bytes(HEADER_BYTES - place & alignment - 1) for place in range(alignment))
    for alignment in (2, 4, 8)
}
_NUL_AND_PADDING = {
    alignment: tuple(bytes(1 + (HEADER_BYTES - place - 1 & alignment - 1)) for place in range(alignment))
    for alignment in (2, 4, 8)
}
"""Padding up to a multiple in the body, by the length of the message so far; after a text including its NUL."""


def generate(name: str, definitions: dict[str, Definition]) -> Callable[[Write], Write]:
    """A writer for one type, still without its slow path.

    :returns: takes the slow path and returns the complete writer; when the type is too large, that is the slow path
    """
    source = FunctionBuilder()
    try:
        if sys.byteorder == "big":
            raise TooLarge
        _WriterGenerator(definitions, source).run(name)
    except TooLarge:
        return lambda slow: slow
    return source.function("body", "now=0")


def generate_check(name: str, definitions: dict[str, Definition]) -> Callable[[Check], Check] | None:
    """Generate a check of whether the writer takes a text; see :meth:`relay_protocol.ros.compiled.CompiledTypes.check`.

    :returns: what takes a check by writing, for unusual texts, and returns the whole check; ``None`` for types with
        arrays
    """
    source = FunctionBuilder()
    checks = _CheckGenerator(definitions, source)
    try:
        checks.run(name)
    except TooLarge:
        return None
    return cast(Callable[[Check], Check], source.function("body"))


class _CheckGenerator:
    """Emits the statements that leave to the writer what may be refused.

    The structs have checked all but the ranges of numbers and the contents of strings.
    """

    def __init__(self, definitions: dict[str, Definition], source: FunctionBuilder) -> None:
        self._source = source
        self._definitions = definitions
        self._structs = StructFactory(definitions)
        self._codes: list[str] = []
        self._numbers: list[str] = []

    def run(self, name: str) -> None:
        """Emit the whole function body."""
        source = self._source
        decode = source.constant(msgspec.json.Decoder(self._structs.of(name)).decode)
        source.line(f"if len(body) > {_CHECKED_BYTES}: raise UseSlowPath")
        source.line(f"m = {decode}(body)")
        self._message(name, "m")
        if self._codes:
            pack = source.constant(struct.Struct("<" + "".join(self._codes)).pack)
            source.line(f"{pack}({', '.join(self._numbers)})")
        # The message has no mark of :mod:`relay_protocol.nonfinite`: a mark is a string with a NUL. A short one is
        # encoded again, so that the robot gets what was checked, also of a text that has a key twice.
        source.line(f"if len(body) <= {jsontext.SHORT_BYTES}: return {source.constant(jsontext.encode)}(m)")
        source.line(f"{source.constant(jsontext.check_keys)}(body)")
        source.line("return body")

    def _message(self, name: str, value: str) -> None:
        definition = self._definitions[name]
        for index, field in enumerate(definition.fields):
            self._source.count_value()
            part = f"{value}.f{index}"
            if is_stamp(definition, field):
                part = self._stamp(field, part)
            self._field(field.type, part)

    def _stamp(self, field: Field, value: str) -> str:
        """A time that is left out is valid."""
        kind = field.type
        if kind.shape is not Shape.SCALAR or not is_time(self._definitions.get(kind.base)):
            raise TooLarge
        name, zero = self._source.new_variable(), self._source.constant(self._structs.of(kind.base)())
        self._source.line(f"{name} = {value}")
        self._source.line(f"if {name} is {self._source.constant(UNSET)}: {name} = {zero}")
        return name

    def _field(self, kind: FieldType, value: str) -> None:
        primitive = kind.primitive
        if kind.shape is not Shape.SCALAR:
            raise TooLarge
        if primitive is None:
            self._message(kind.base, value)
        elif kind.base == "string":
            bound = f" or len({value}.encode()) > {kind.bound}" if kind.bound else ""
            self._source.line(f"if '\\0' in {value}{bound}: raise UseSlowPath")
        elif not primitive.code:
            raise TooLarge
        elif primitive.code not in _ANY_VALUE:
            self._codes.append(primitive.code)
            self._numbers.append(value)


_ANY_VALUE = "?d"
"""Codes of numbers that every Python value fits."""


class _WriterGenerator(CodeGenerator):
    """Emits the statements that write one message to ``out``."""

    def __init__(self, definitions: dict[str, Definition], source: FunctionBuilder) -> None:
        super().__init__(source)
        self._definitions = definitions
        self._layouts = LayoutTable(definitions)
        self._structs = StructFactory(definitions)
        self._started = False
        self._has_message_arrays = False

    def run(self, name: str) -> None:
        """Emit the whole function body."""
        kind = self._structs.of(name)
        self.codes, self.slots = ["I"], [str(_LITTLE_ENDIAN_HEADER)]
        self._message(name, "m")
        decode = self.source.constant(msgspec.json.Decoder(kind).decode)
        if self._has_message_arrays:
            self.source.prepend(f"m = {decode}(body)")
            self.source.prepend(f"if len(body) > {self._structs.max_json_bytes}: raise UseSlowPath")
            self.source.prepend("if type(body) is not bytes: raise UseSlowPath")
        else:
            convert, made = self.source.constant(msgspec.convert), self.source.constant(kind)
            self.source.prepend(f"m = {decode}(body) if type(body) is bytes else {convert}(body, {made})")
        if self._started:
            self._flush()
            self.source.line(f"if len(out) > {LARGEST_BODY + HEADER_BYTES}: raise UseSlowPath")
            self.source.line("return bytes(out)")
            return
        packed, size = self._packed()
        if size > LARGEST_BODY:
            raise TooLarge
        self.source.line(f"return {packed}")

    def emit_alignment(self, alignment: int) -> None:
        """Emit code that pads the message to the next multiple."""
        padding = _PADDING
        if self.codes == ["x"]:
            self.codes, padding = [], _NUL_AND_PADDING
        self._flush()
        choice = self.source.constant(padding[alignment])
        self.source.line(f"out += {choice}[len(out) & {alignment - 1}]")

    def _packed(self) -> tuple[str, int]:
        found = self.take_format()
        if found is None:
            return "b''", 0
        codec, slots = found
        return f"{self.source.constant(codec.pack)}({', '.join(slots)})", codec.size

    def _flush(self) -> None:
        if not self._started:
            self.source.line(f"out = bytearray({self._packed()[0]})")
            self._started = True
        elif self.codes:
            self.source.line(f"out += {self._packed()[0]}")

    def _message(self, name: str, value: str) -> None:
        definition = self._definitions[name]
        if not definition.fields:
            self.add("x", 1, 1)
        for index, field in enumerate(definition.fields):
            part = f"{value}.f{index}"
            if is_stamp(definition, field):
                part = self._stamp(field, part)
            self._field(field.type, part)

    def _stamp(self, field: Field, value: str) -> str:
        """The stamp of a header: the current time, unless it is given."""
        name, kind = self.source.new_variable(), field.type
        if kind.shape is not Shape.SCALAR or not is_time(self._definitions.get(kind.base)):
            raise TooLarge
        time, unset = self.source.constant(self._structs.of(kind.base)), self.source.constant(UNSET)
        self.source.line(f"{name} = {value}")
        self.source.line(f"if {name} is {unset}: {name} = {time}(now // 1000000000, now % 1000000000)")
        return name

    def _field(self, kind: FieldType, value: str) -> None:
        self.source.count_value()
        if kind.shape is Shape.SCALAR:
            self._value(kind, value)
        elif kind.primitive is not None and kind.primitive.code:
            self._numbers(kind, value)
        else:
            self._elements(kind, value)

    def _value(self, kind: FieldType, value: str) -> None:
        primitive = kind.primitive
        if primitive is None:
            name = self.source.new_variable()
            self.source.line(f"{name} = {value}")
            self._message(kind.base, name)
        elif primitive.code:
            self.add(primitive.code, primitive.size, primitive.size, value)
        elif kind.base == "string":
            self._text(kind, value)
        else:
            self._wide_text(kind, value)

    def _text(self, kind: FieldType, value: str) -> None:
        name = self.source.new_variable()
        self.source.line(f"{name} = {value}.encode()")
        bound = f" or len({name}) > {kind.bound}" if kind.bound else ""
        self.source.line(f"if 0 in {name}{bound}: raise UseSlowPath")
        self.add("I", 4, 4, f"len({name}) + 1")
        self._flush()
        self.source.line(f"out += {name}")
        self.set_alignment(1)
        self.add("x", 1, 1)

    def _wide_text(self, kind: FieldType, value: str) -> None:
        name = self.source.new_variable()
        self.source.line(
            f"{name} = {self.source.constant(_wide_text)}({value}, {kind.bound or RELAY_FRAME // 4})"
        )
        self.add("I", 4, 4, f"len({name}) // 4")
        self._flush()
        self.source.line(f"out += {name}")
        self.set_alignment(4)

    def _numbers(self, kind: FieldType, value: str) -> None:
        assert kind.primitive is not None
        name, size = self.source.new_variable(), kind.primitive.size
        code = kind.primitive.code
        if kind.shape is Shape.ARRAY and kind.base not in BYTES and kind.length <= _FORMATTED:
            pack = self.source.constant(struct.Struct(f"<{kind.length}{code}").pack)
            self.source.line(f"{name} = {pack}(*{value})")
        else:
            convert = self.source.constant(_pack_bytes if kind.base in BYTES else _PACKERS[code])
            self.source.line(f"{name} = {convert}({value})")
            self._check_length(kind, name, size)
        if kind.shape is Shape.ARRAY:
            self.add(f"{kind.length * size}s", kind.length * size, size, name)
            return
        self.add("I", 4, 4, f"len({name})" + (f" // {size}" if size > 1 else ""))
        self._flush()
        if size == 8:
            self._pad_if(name)
        self.source.line(f"out += {name}")
        self.set_alignment(min(size, 4))

    def _check_length(self, kind: FieldType, name: str, size: int = 1) -> None:
        if kind.length:
            wrong = "!=" if kind.shape is Shape.ARRAY else ">"
            self.source.line(f"if len({name}) {wrong} {kind.length * size}: raise UseSlowPath")

    def _pad_if(self, name: str) -> None:
        self.source.line(f"if {name}: out += {self.source.constant(_PADDING[8])}[len(out) & 7]")

    def _elements(self, kind: FieldType, value: str) -> None:
        """An array or sequence of messages or texts."""
        name, element = self.source.new_variable(), self.source.new_variable()
        self._has_message_arrays = self._has_message_arrays or kind.primitive is None
        self.source.line(f"{name} = {value}")
        self._check_length(kind, name)
        if kind.shape is Shape.ARRAY and kind.length <= _UNROLLED:
            for index in range(kind.length):
                self._value(kind, f"{name}[{index}]")
            return
        if kind.shape is Shape.SEQUENCE:
            self.add("I", 4, 4, f"len({name})")
        self._flush()
        known = 1
        block = self._layouts.block(kind.base) if kind.primitive is None else None
        if block is not None and kind.shape is Shape.SEQUENCE:
            known = block.alignment
            if known == 8:
                self._pad_if(name)
        with self.source.block(f"for {element} in {name}:"):
            self.set_alignment(known)
            self._value(kind, element)
            self._flush()
            # A few bytes of JSON can stand for a large message of defaults.
            self.source.line(f"if len(out) > {RELAY_FRAME}: raise UseSlowPath")
        self.set_alignment(min(known, 4))


def _wide_text(text: str, bound: int) -> bytes:
    """Encode a wide string: UTF-16 units of 32 bits each (Fast DDS)."""
    # The slow path reports what is too long, before it is converted.
    if "\0" in text or len(text) > bound:
        raise UseSlowPath
    if text.isascii():
        return text.encode("utf-32-le")
    units = text.encode("utf-16-le")
    if len(units) > 2 * bound:
        raise UseSlowPath
    return widen(units)


def _pack_bytes(value: Any) -> bytes:
    return pybase64.b64decode(value, validate=True) if type(value) is str else bytes(value)


def _packer(code: str) -> Callable[[Sequence[Any]], bytes]:
    """A function that packs numbers; :func:`struct.pack` caches its formats."""

    def pack(values: Sequence[Any]) -> bytes:
        return struct.pack(f"<{len(values)}{code}", *values)

    def pack_floats(values: Sequence[Any]) -> bytes:
        try:
            return struct.pack(f"<{len(values)}{code}", *values)
        except struct.error:
            return struct.pack(f"<{len(values)}{code}", *_with_nan(values))

    return pack_floats if code in "fd" else pack


def _with_nan(values: Sequence[Any]) -> list[Any]:
    nan = float("nan")
    return [nan if value is None else value for value in values]


_PACKERS = {code: _packer(code) for code in "?bhHiIqQfd"}
