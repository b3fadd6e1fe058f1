"""CDR to JSON or CBOR by code generated for the type; see :mod:`relay_protocol.ros.codegen`.

One pass over the bytes: neighbouring numbers are unpacked at once, across nested messages, and what comes out is put
together in one expression. For little-endian messages on little-endian machines, which is all of them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Generic, Protocol, TypeVar

from relay_protocol.ros.codegen import Cursor, Source, TooLarge, Unusual
from relay_protocol.ros.definition import Definition, Field, FieldType, Primitive, Shape
from relay_protocol.ros.emit import CborForm, HoldsArrays, JsonForm, PlainJsonForm
from relay_protocol.ros.layout import Block, Shapes
from relay_protocol.ros.reader import HEAD, MAX_ELEMENTS
from relay_protocol.ros.structs import Structs

Read = Callable[[bytes], bytes]

_UNROLLED = 4
"""Longest array of messages whose elements are written out."""

_HEAD_WORD = int.from_bytes(b"\x00\x01", "little")
V = TypeVar("V")


class Form(Protocol[V]):
    """How values are written: JSON or CBOR. ``V`` is code for a value that is not computed yet."""

    def number(self, primitive: Primitive, name: str) -> V:
        """One number, held by the variable ``name``."""

    def text(self, name: str) -> V:
        """A text, held as UTF-8 by ``name``; emits what checks it."""

    def wide(self, name: str) -> V:
        """A text, held as :class:`str` by ``name``."""

    def fixed(self, kind: FieldType, name: str) -> V:
        """An array of numbers of fixed length, held as bytes by ``name``."""

    def numbers(self, kind: FieldType, count: str) -> V:
        """So many numbers from byte ``p`` on, which need not all be there; emits what takes them."""

    def object(self, definition: Definition, values: Sequence[V]) -> V:
        """A message."""

    def array(self, values: Sequence[V]) -> V:
        """Elements one by one."""

    def gathered(self, name: str, count: str) -> V:
        """The elements gathered in the list ``name``."""

    def gather(self, name: str, value: V) -> str:
        """The statement that adds an element to the list ``name``."""

    def each(self, value: V, loop: str, count: str) -> V:
        """The elements a comprehension makes; emits it."""

    def result(self, value: V) -> str:
        """The expression of the encoded message."""


def generate(name: str, definitions: dict[str, Definition], form: str, slow: Read) -> Read:
    """A reader for one type.

    :param form: ``json`` or ``cbor``
    :param slow: takes the messages that are unusual
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
        source = Source()
        _Walk(definitions, source, CborForm(source)).run(name)
    else:
        source = _json_source(name, definitions)
    return source.function("data")(slow)


def _json_source(name: str, definitions: dict[str, Definition]) -> Source:
    # Structs are cheaper than dicts where messages are nested, but orjson writes arrays and long texts faster.
    if any(field.type.primitive is None for field in definitions[name].fields):
        source = Source()
        try:
            _Walk(definitions, source, PlainJsonForm(source, Structs(definitions))).run(name)
            return source
        except HoldsArrays:
            pass
    source = Source()
    _Walk(definitions, source, JsonForm(source)).run(name)
    return source


class _Walk(Cursor, Generic[V]):
    """Emits the statements that take one message apart.

    The place is ``self._base``, a variable (or nothing at the start), plus ``self._taken``.
    """

    def __init__(self, definitions: dict[str, Definition], source: Source, form: Form[V]) -> None:
        super().__init__(source)
        self._definitions = definitions
        self._shapes = Shapes(definitions)
        self._form = form
        self._base = ""
        self._taken = 0
        self._counts_room = False

    def run(self, name: str) -> None:
        """The whole function."""
        head = self.source.fresh()
        self.codes, self.slots = ["H2x"], [head]
        value = self._message(name)
        self._flush()
        self.source.line(f"return {self._form.result(value)}")

    def jump(self, alignment: int) -> None:
        """The place moves to the next multiple."""
        self._settle()
        self.source.line(f"p += {HEAD} - p & {alignment - 1}")

    def _place(self) -> str:
        return f"{self._base} + {self._taken}" if self._base else str(self._taken)

    def _settle(self) -> None:
        """From here on the place is in ``p``."""
        self._flush()
        if not (self._base == "p" and self._taken == 0):
            self.source.line(f"p = {self._place()}")
        self._base, self._taken = "p", 0

    def _flush(self) -> None:
        first = not self._base and self._taken == 0
        found = self.take()
        if found is None:
            return
        codec, slots = found
        targets = "".join(f"{slot}, " for slot in slots)
        unpack = self.source.constant(codec.unpack_from)
        place = "" if first else f", {self._place()}"
        self.source.line(f"{targets + '= ' if targets else ''}{unpack}(data{place})")
        self._taken += codec.size
        if first:
            self.source.line(f"if {slots[0]} != {_HEAD_WORD}: raise Unusual")

    def _message(self, name: str) -> V:
        definition = self._definitions[name]
        if not definition.fields:
            self.add("x", 1, 1)
        values = [self._field(field) for field in definition.fields]
        return self._form.object(definition, values)

    def _field(self, field: Field) -> V:
        kind = field.type
        self.source.step()
        if kind.shape is Shape.SCALAR:
            return self._one(kind)
        numbers = kind.primitive is not None and bool(kind.primitive.code)
        if kind.shape is Shape.ARRAY:
            return self._fixed(kind) if numbers else self._many(kind)
        return self._numbers(kind) if numbers else self._sequence(kind)

    def _one(self, kind: FieldType) -> V:
        primitive = kind.primitive
        if primitive is None:
            return self._message(kind.base)
        if not primitive.code:
            return self._wide() if kind.base == "wstring" else self._text()
        name = self.source.fresh()
        self.add(primitive.code, primitive.size, primitive.size, name)
        return self._form.number(primitive, name)

    def _count(self) -> str:
        """Read a length; the place behind it is in ``p``."""
        name = self.source.fresh()
        self.add("I", 4, 4, name)
        self._settle()
        return name

    def _text(self) -> V:
        length, name = self.source.fresh(), self.source.fresh()
        self.add("I", 4, 4, length)
        self._flush()
        # Where the length is 0 its own last byte is looked at, which is 0 then.
        self.source.line(f"e = {self._place()} + {length}")
        self.source.line("if data[e - 1]: raise Unusual")
        self.source.line(f"{name} = data[{self._place()}:e - 1]")
        self.source.line("p = e")
        self._base, self._taken = "p", 0
        self.lost(1)
        return self._form.text(name)

    def _wide(self) -> V:
        length, name = self._count(), self.source.fresh()
        self.source.line(f"{name} = {self.source.constant(_wide)}(data, p, {length})")
        self.source.line(f"p += 4 * {length}")
        self.lost(4)
        return self._form.wide(name)

    def _fixed(self, kind: FieldType) -> V:
        assert kind.primitive is not None
        size, name = kind.primitive.size, self.source.fresh()
        self.add(f"{kind.length * size}s", kind.length * size, size, name)
        return self._form.fixed(kind, name)

    def _numbers(self, kind: FieldType) -> V:
        assert kind.primitive is not None
        size, count = kind.primitive.size, self._count()
        if size == 8:
            self.source.line(f"if {count}: p += {HEAD} - p & 7")
        value = self._form.numbers(kind, count)
        self.source.line(f"p += {count}" + (f" * {size}" if size > 1 else ""))
        self.lost(min(size, 4))
        return value

    def _many(self, kind: FieldType) -> V:
        """A fixed number of messages or texts."""
        block = self._shapes.block(kind.base) if kind.primitive is None else None
        if kind.length <= _UNROLLED:
            return self._form.array([self._one(kind) for _ in range(kind.length)])
        if block is not None:
            self.align(block.alignment)
            self._settle()
            return self._blocks(kind, block, str(kind.length))
        self._settle()
        return self._loop(kind, str(kind.length))

    def _sequence(self, kind: FieldType) -> V:
        """Any number of messages or texts."""
        if not self._counts_room:
            self._counts_room = True
            self.source.first(f"room = {MAX_ELEMENTS}")
        count = self._count()
        least = self._shapes.least_of_one(kind)
        self.source.line(f"room -= {count}")
        self.source.line(f"if room < 0 or {count} * {least} > len(data) - p: raise Unusual")
        block = self._shapes.block(kind.base) if kind.primitive is None else None
        if block is None:
            return self._loop(kind, count)
        if block.alignment == 8:
            self.source.line(f"if {count}: p += {HEAD} - p & 7")
        return self._blocks(kind, block, count)

    def _loop(self, kind: FieldType, count: str) -> V:
        name = self.source.fresh()
        self.source.line(f"{name} = []")
        with self.source.block(f"for _ in range({count}):"):
            self.lost(1)
            value = self._one(kind)
            self._settle()
            self.source.line(self._form.gather(name, value))
        self.lost(1)
        return self._form.gathered(name, count)

    def _blocks(self, kind: FieldType, block: Block, count: str) -> V:
        """Messages of numbers without gaps, from ``p`` on."""
        inner = _Walk(self._definitions, self.source, self._form)
        inner.lost(block.alignment)
        value = inner._message(kind.base)
        found = inner.take()
        assert found is not None
        codec, slots = found
        self.source.line(f"e = p + {count} * {block.size}")
        self.source.line("if e > len(data): raise Unusual")
        unpacked = f"{self.source.constant(codec.iter_unpack)}(data[p:e])"
        result = self._form.each(value, f"for {', '.join(slots)}, in {unpacked}", count)
        self.source.line("p = e")
        self.lost(min(block.alignment, 4))
        return result


def _wide(data: bytes, position: int, length: int) -> str:
    """A text of 32-bit units, each of which is a UTF-16 unit."""
    text = data[position : position + 4 * length].decode("utf-32-le", "surrogatepass")
    if len(text) != length or (length and max(text) > "\uffff"):
        raise Unusual
    if text.isascii():
        return text
    return text.encode("utf-16-le", "surrogatepass").decode("utf-16-le")
