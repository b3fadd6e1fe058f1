"""JSON to CDR by code generated for the type; see :mod:`relay_protocol.ros.codegen`.

msgspec decodes the text into structs of the type, which checks it too; neighbouring numbers are packed at once,
across nested messages. What does not fit, and the spellings that are only tolerated, go to the closures.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import pybase64
from msgspec import UNSET

from relay_protocol.limits import ROBOT_MESSAGE
from relay_protocol.ros.codegen import Cursor, Source, TooLarge, Unusual
from relay_protocol.ros.definition import BYTES, Definition, Field, FieldType, Shape
from relay_protocol.ros.layout import Shapes
from relay_protocol.ros.reader import HEAD
from relay_protocol.ros.structs import Structs, is_stamp, is_time

Write = Callable[[Any, int], bytes]

LARGEST_BODY = ROBOT_MESSAGE - 17
"""What is left of a frame to a robot after kind, number, stamp and encapsulation header; bytes."""

_UNROLLED = 4
"""Longest array of messages whose elements are written out."""

_FORMATTED = 100
"""Longest array of numbers for which a format is kept."""

_HEAD_WORD = int.from_bytes(b"\x00\x01\x00\x00", "little")

_PADDING = {
    alignment: tuple(bytes(HEAD - place & alignment - 1) for place in range(alignment))
    for alignment in (2, 4, 8)
}
_NUL_AND_PADDING = {
    alignment: tuple(bytes(1 + (HEAD - place - 1 & alignment - 1)) for place in range(alignment))
    for alignment in (2, 4, 8)
}
"""What fills up to a multiple in the body, by the length of the message so far; after a text with its NUL."""


def generate(name: str, definitions: dict[str, Definition]) -> Callable[[Write], Write]:
    """A writer for one type, still without what takes the values that are unusual.

    :returns: what takes that writer and gives the whole; that writer itself, when the type is too large
    """
    source = Source()
    try:
        if sys.byteorder == "big":
            raise TooLarge
        _Walk(definitions, source).run(name)
    except TooLarge:
        return lambda slow: slow
    return source.function("body, now")


class _Walk(Cursor):
    """Emits the statements that put one message together in ``out``."""

    def __init__(self, definitions: dict[str, Definition], source: Source) -> None:
        super().__init__(source)
        self._definitions = definitions
        self._shapes = Shapes(definitions)
        self._structs = Structs(definitions)
        self._begun = False
        self._repeats = False

    def run(self, name: str) -> None:
        """The whole function."""
        kind = self._structs.of(name)
        self.codes, self.slots = ["I"], [str(_HEAD_WORD)]
        self._message(name, "m")
        decode = self.source.constant(msgspec.json.Decoder(kind).decode)
        if self._repeats:
            self.source.first(f"m = {decode}(body)")
            self.source.first(f"if len(body) > {self._structs.longest_text}: raise Unusual")
            self.source.first("if type(body) is not bytes: raise Unusual")
        else:
            convert, made = self.source.constant(msgspec.convert), self.source.constant(kind)
            self.source.first(f"m = {decode}(body) if type(body) is bytes else {convert}(body, {made})")
        if self._begun:
            self._flush()
            self.source.line(f"if len(out) > {LARGEST_BODY + HEAD}: raise Unusual")
            self.source.line("return bytes(out)")
            return
        packed, size = self._packed()
        if size > LARGEST_BODY:
            raise TooLarge
        self.source.line(f"return {packed}")

    def jump(self, alignment: int) -> None:
        """The message is filled up to the next multiple."""
        padding = _PADDING
        if self.codes == ["x"]:
            self.codes, padding = [], _NUL_AND_PADDING
        self._flush()
        choice = self.source.constant(padding[alignment])
        self.source.line(f"out += {choice}[len(out) & {alignment - 1}]")

    def _packed(self) -> tuple[str, int]:
        found = self.take()
        if found is None:
            return "b''", 0
        codec, slots = found
        return f"{self.source.constant(codec.pack)}({', '.join(slots)})", codec.size

    def _flush(self) -> None:
        if not self._begun:
            self.source.line(f"out = bytearray({self._packed()[0]})")
            self._begun = True
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
        """The time of a header: the present one, unless it is given."""
        name, kind = self.source.fresh(), field.type
        if kind.shape is not Shape.SCALAR or not is_time(self._definitions.get(kind.base)):
            raise TooLarge
        time, unset = self.source.constant(self._structs.of(kind.base)), self.source.constant(UNSET)
        self.source.line(f"{name} = {value}")
        self.source.line(f"if {name} is {unset}: {name} = {time}(now // 1000000000, now % 1000000000)")
        return name

    def _field(self, kind: FieldType, value: str) -> None:
        self.source.step()
        if kind.shape is Shape.SCALAR:
            self._one(kind, value)
        elif kind.primitive is not None and kind.primitive.code:
            self._numbers(kind, value)
        else:
            self._many(kind, value)

    def _one(self, kind: FieldType, value: str) -> None:
        primitive = kind.primitive
        if primitive is None:
            name = self.source.fresh()
            self.source.line(f"{name} = {value}")
            self._message(kind.base, name)
        elif primitive.code:
            self.add(primitive.code, primitive.size, primitive.size, value)
        elif kind.base == "string":
            self._text(kind, value)
        else:
            self._wide(kind, value)

    def _text(self, kind: FieldType, value: str) -> None:
        name = self.source.fresh()
        self.source.line(f"{name} = {value}.encode()")
        bound = f" or len({name}) > {kind.bound}" if kind.bound else ""
        self.source.line(f"if 0 in {name}{bound}: raise Unusual")
        self.add("I", 4, 4, f"len({name}) + 1")
        self._flush()
        self.source.line(f"out += {name}")
        self.lost(1)
        self.add("x", 1, 1)

    def _wide(self, kind: FieldType, value: str) -> None:
        name = self.source.fresh()
        self.source.line(f"{name} = {self.source.constant(_wide)}({value}, {kind.bound or ROBOT_MESSAGE})")
        self.add("I", 4, 4, f"len({name}) // 4")
        self._flush()
        self.source.line(f"out += {name}")
        self.lost(4)

    def _numbers(self, kind: FieldType, value: str) -> None:
        assert kind.primitive is not None
        name, size = self.source.fresh(), kind.primitive.size
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
        self.lost(min(size, 4))

    def _check_length(self, kind: FieldType, name: str, size: int = 1) -> None:
        if kind.length:
            wrong = "!=" if kind.shape is Shape.ARRAY else ">"
            self.source.line(f"if len({name}) {wrong} {kind.length * size}: raise Unusual")

    def _pad_if(self, name: str) -> None:
        self.source.line(f"if {name}: out += {self.source.constant(_PADDING[8])}[len(out) & 7]")

    def _many(self, kind: FieldType, value: str) -> None:
        """Messages or texts."""
        name, element = self.source.fresh(), self.source.fresh()
        self._repeats = self._repeats or kind.primitive is None
        self.source.line(f"{name} = {value}")
        self._check_length(kind, name)
        if kind.shape is Shape.ARRAY and kind.length <= _UNROLLED:
            for index in range(kind.length):
                self._one(kind, f"{name}[{index}]")
            return
        if kind.shape is Shape.SEQUENCE:
            self.add("I", 4, 4, f"len({name})")
        self._flush()
        known = 1
        block = self._shapes.block(kind.base) if kind.primitive is None else None
        if block is not None and kind.shape is Shape.SEQUENCE:
            known = block.alignment
            if known == 8:
                self._pad_if(name)
        with self.source.block(f"for {element} in {name}:"):
            self.lost(known)
            self._one(kind, element)
            self._flush()
            # A few bytes of JSON can stand for a large message of defaults.
            self.source.line(f"if len(out) > {ROBOT_MESSAGE}: raise Unusual")
        self.lost(min(known, 4))


def _wide(text: str, bound: int) -> bytes:
    """A text as 32-bit units, each of which is a UTF-16 unit."""
    if "\0" in text:
        raise Unusual
    if not text.isascii() and max(text) > "\uffff":
        pairs = text.encode("utf-16-le")
        units = struct.pack(f"<{len(pairs) // 2}I", *struct.unpack(f"<{len(pairs) // 2}H", pairs))
    else:
        units = text.encode("utf-32-le")
    if len(units) > 4 * bound:
        raise Unusual
    return units


def _pack_bytes(value: Any) -> bytes:
    return pybase64.b64decode(value, validate=True) if type(value) is str else bytes(value)


def _packer(code: str) -> Callable[[Sequence[Any]], bytes]:
    """Numbers as bytes; :func:`struct.pack` keeps the formats it has seen."""

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
