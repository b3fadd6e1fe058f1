"""Converts CDR to JSON or CBOR by code generated for the type; see :mod:`relay_protocol.ros.codegen`.

It reads the bytes once: neighbouring numbers are unpacked at once, across nested messages, and one expression builds
the result. It supports little-endian messages on little-endian machines; others use the slow path.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Generic, Protocol, TypeVar

from relay_protocol.ros.cdr_to_json import HEADER_BYTES, MAX_ELEMENTS
from relay_protocol.ros.codegen import CodeGenerator, FunctionBuilder, TooLarge, UseSlowPath
from relay_protocol.ros.definition import Definition, Field, FieldType, Primitive, Shape
from relay_protocol.ros.emit import CborEmitter, HoldsArrays, JsonEmitter, StructJsonEmitter
from relay_protocol.ros.layout import Block, LayoutTable
from relay_protocol.ros.structs import StructFactory

Read = Callable[[bytes], bytes]

_UNROLLED = 4
"""Longest array of messages whose elements are written out."""

_LITTLE_ENDIAN_HEADER = int.from_bytes(b"\x00\x01", "little")
V = TypeVar("V")


class ValueEmitter(Protocol[V]):
    """Emits values as JSON or CBOR. ``V`` represents code for a value."""

    def number(self, primitive: Primitive, name: str) -> V:
        """One number in the variable ``name``."""

    def text(self, name: str) -> V:
        """A text in the variable ``name``, as UTF-8; emits its check."""

    def wide_text(self, name: str) -> V:
        """A text in the variable ``name``, as :class:`str`."""

    def fixed(self, kind: FieldType, name: str) -> V:
        """An array of numbers of fixed length in the variable ``name``, as bytes."""

    def numbers(self, kind: FieldType, count: str) -> V:
        """``count`` numbers from byte ``p`` on; emits the check that they are there."""

    def object(self, definition: Definition, values: Sequence[V]) -> V:
        """A message."""

    def array(self, values: Sequence[V]) -> V:
        """Elements one by one."""

    def gathered(self, name: str, count: str) -> V:
        """The elements collected in the list ``name``."""

    def gather(self, name: str, value: V) -> str:
        """The statement that adds an element to the list ``name``."""

    def each(self, value: V, loop: str, count: str) -> V:
        """The elements of a comprehension; emits it."""

    def result(self, value: V) -> str:
        """The expression of the encoded message."""


def generate(name: str, definitions: dict[str, Definition], form: str, slow: Read) -> Read:
    """A reader for one type.

    :param form: ``json`` or ``cbor``
    :param slow: converts the messages that generated code does not
    :returns: ``slow`` itself, when the type is too large
    """
    if sys.byteorder == "big":
        return slow
    try:
        return _generated(name, definitions, form, slow)
    except TooLarge:
        return slow


def _generated(name: str, definitions: dict[str, Definition], form: str, slow: Read) -> Read:
    if form == "cbor":
        source = FunctionBuilder()
        _ReaderGenerator(definitions, source, CborEmitter(source)).run(name)
    else:
        source = _json_source(name, definitions)
    return source.function("data")(slow)


def _json_source(name: str, definitions: dict[str, Definition]) -> FunctionBuilder:
    # Structs are cheaper than dicts where messages are nested, but orjson writes arrays and long texts faster.
    if any(field.type.primitive is None for field in definitions[name].fields):
        source = FunctionBuilder()
        try:
            _ReaderGenerator(definitions, source, StructJsonEmitter(source, StructFactory(definitions))).run(
                name
            )
            return source
        except HoldsArrays:
            pass
    source = FunctionBuilder()
    _ReaderGenerator(definitions, source, JsonEmitter(source)).run(name)
    return source


class _ReaderGenerator(CodeGenerator, Generic[V]):
    """Emits the statements that read one message.

    The position is ``self._base``, a variable (empty at the start), plus ``self._taken`` bytes.
    """

    def __init__(
        self, definitions: dict[str, Definition], source: FunctionBuilder, form: ValueEmitter[V]
    ) -> None:
        super().__init__(source)
        self._definitions = definitions
        self._layouts = LayoutTable(definitions)
        self._form = form
        self._base = ""
        self._taken = 0
        self._limits_elements = False

    def run(self, name: str) -> None:
        """Emit the whole function body."""
        head = self.source.new_variable()
        self.codes, self.slots = ["H2x"], [head]
        value = self._message(name)
        self._flush()
        self.source.line(f"return {self._form.result(value)}")

    def emit_alignment(self, alignment: int) -> None:
        """Emit code that moves the position to the next multiple."""
        self._store_position()
        self.source.line(f"p += {HEADER_BYTES} - p & {alignment - 1}")

    def _position(self) -> str:
        return f"{self._base} + {self._taken}" if self._base else str(self._taken)

    def _store_position(self) -> None:
        """Emit code that stores the position in ``p``."""
        self._flush()
        if not (self._base == "p" and self._taken == 0):
            self.source.line(f"p = {self._position()}")
        self._base, self._taken = "p", 0

    def _flush(self) -> None:
        first = not self._base and self._taken == 0
        found = self.take_format()
        if found is None:
            return
        codec, slots = found
        targets = "".join(f"{slot}, " for slot in slots)
        unpack = self.source.constant(codec.unpack_from)
        place = "" if first else f", {self._position()}"
        self.source.line(f"{targets + '= ' if targets else ''}{unpack}(data{place})")
        self._taken += codec.size
        if first:
            self.source.line(f"if {slots[0]} != {_LITTLE_ENDIAN_HEADER}: raise UseSlowPath")

    def _message(self, name: str) -> V:
        definition = self._definitions[name]
        if not definition.fields:
            self.add("x", 1, 1)
        values = [self._field(field) for field in definition.fields]
        return self._form.object(definition, values)

    def _field(self, field: Field) -> V:
        kind = field.type
        self.source.count_value()
        if kind.shape is Shape.SCALAR:
            return self._value(kind)
        numbers = kind.primitive is not None and bool(kind.primitive.code)
        if kind.shape is Shape.ARRAY:
            return self._fixed(kind) if numbers else self._elements(kind)
        return self._numbers(kind) if numbers else self._sequence(kind)

    def _value(self, kind: FieldType) -> V:
        primitive = kind.primitive
        if primitive is None:
            return self._message(kind.base)
        if not primitive.code:
            return self._wide_text() if kind.base == "wstring" else self._text()
        name = self.source.new_variable()
        self.add(primitive.code, primitive.size, primitive.size, name)
        return self._form.number(primitive, name)

    def _count(self) -> str:
        """Emit code that reads a length; the position after it is in ``p``."""
        name = self.source.new_variable()
        self.add("I", 4, 4, name)
        self._store_position()
        return name

    def _text(self) -> V:
        length, name = self.source.new_variable(), self.source.new_variable()
        self.add("I", 4, 4, length)
        self._flush()
        # With length 0 this checks the last byte of the length itself, which is 0.
        self.source.line(f"e = {self._position()} + {length}")
        self.source.line("if data[e - 1]: raise UseSlowPath")
        self.source.line(f"{name} = data[{self._position()}:e - 1]")
        self.source.line("p = e")
        self._base, self._taken = "p", 0
        self.set_alignment(1)
        return self._form.text(name)

    def _wide_text(self) -> V:
        length, name = self._count(), self.source.new_variable()
        self.source.line(f"{name} = {self.source.constant(_wide_text)}(data, p, {length})")
        self.source.line(f"p += 4 * {length}")
        self.set_alignment(4)
        return self._form.wide_text(name)

    def _fixed(self, kind: FieldType) -> V:
        assert kind.primitive is not None
        size, name = kind.primitive.size, self.source.new_variable()
        self.add(f"{kind.length * size}s", kind.length * size, size, name)
        return self._form.fixed(kind, name)

    def _numbers(self, kind: FieldType) -> V:
        assert kind.primitive is not None
        size, count = kind.primitive.size, self._count()
        if size == 8:
            self.source.line(f"if {count}: p += {HEADER_BYTES} - p & 7")
        value = self._form.numbers(kind, count)
        self.source.line(f"p += {count}" + (f" * {size}" if size > 1 else ""))
        self.set_alignment(min(size, 4))
        return value

    def _elements(self, kind: FieldType) -> V:
        """An array of messages or texts."""
        block = self._layouts.block(kind.base) if kind.primitive is None else None
        if kind.length <= _UNROLLED:
            return self._form.array([self._value(kind) for _ in range(kind.length)])
        if block is not None:
            self.align(block.alignment)
            self._store_position()
            return self._blocks(kind, block, str(kind.length))
        self._store_position()
        return self._loop(kind, str(kind.length))

    def _sequence(self, kind: FieldType) -> V:
        """A sequence of messages or texts."""
        if not self._limits_elements:
            self._limits_elements = True
            self.source.prepend(f"elements_left = {MAX_ELEMENTS}")
        count = self._count()
        min_size = self._layouts.min_element_size(kind)
        self.source.line(f"elements_left -= {count}")
        self.source.line(f"if elements_left < 0 or {count} * {min_size} > len(data) - p: raise UseSlowPath")
        block = self._layouts.block(kind.base) if kind.primitive is None else None
        if block is None:
            return self._loop(kind, count)
        if block.alignment == 8:
            self.source.line(f"if {count}: p += {HEADER_BYTES} - p & 7")
        return self._blocks(kind, block, count)

    def _loop(self, kind: FieldType, count: str) -> V:
        name = self.source.new_variable()
        self.source.line(f"{name} = []")
        with self.source.block(f"for _ in range({count}):"):
            self.set_alignment(1)
            value = self._value(kind)
            self._store_position()
            self.source.line(self._form.gather(name, value))
        self.set_alignment(1)
        return self._form.gathered(name, count)

    def _blocks(self, kind: FieldType, block: Block, count: str) -> V:
        """Messages of numbers without padding between them, from ``p`` on."""
        inner = _ReaderGenerator(self._definitions, self.source, self._form)
        inner.set_alignment(block.alignment)
        value = inner._message(kind.base)
        found = inner.take_format()
        assert found is not None
        codec, slots = found
        self.source.line(f"e = p + {count} * {block.size}")
        self.source.line("if e > len(data): raise UseSlowPath")
        unpacked = f"{self.source.constant(codec.iter_unpack)}(data[p:e])"
        result = self._form.each(value, f"for {', '.join(slots)}, in {unpacked}", count)
        self.source.line("p = e")
        self.set_alignment(min(block.alignment, 4))
        return result


def _wide_text(data: bytes, position: int, length: int) -> str:
    """Decode a wide string: UTF-16 units of 32 bits each (Fast DDS)."""
    text = data[position : position + 4 * length].decode("utf-32-le", "surrogatepass")
    if len(text) != length or (length and max(text) > "\uffff"):
        raise UseSlowPath
    if text.isascii():
        return text
    return text.encode("utf-16-le", "surrogatepass").decode("utf-16-le")
