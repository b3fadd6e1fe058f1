"""Output of generated readers: JSON from Python values, or CBOR byte by byte.

Source: RFC 8949 (CBOR), RFC 8746 (typed arrays). Heads have fixed widths, so that one call packs many numbers and the
bytes between them.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy
import orjson
import pybase64

from relay_protocol import jsontext
from relay_protocol.ros.cdr_to_json import TYPED_ARRAYS
from relay_protocol.ros.codegen import FunctionBuilder, quoted
from relay_protocol.ros.definition import BYTES, Definition, FieldType, Primitive
from relay_protocol.ros.structs import StructFactory

_FEW = 24
"""Up to this many numbers :mod:`struct` is faster than numpy."""

_COPIED = 4096
"""Up to this many bytes a copy is faster than a view."""

_UNPACK = {
    code: tuple(struct.Struct(f"<{count}{code}").unpack_from for count in range(_FEW + 1))
    for code in "bhHiIqQd"
}


class JsonEmitter:
    """Values are expressions; together they are one dict display, which orjson encodes."""

    def __init__(self, source: FunctionBuilder) -> None:
        self._source = source
        self._arrays = False

    def number(self, primitive: Primitive, name: str) -> str:
        """The variable."""
        return name

    def text(self, name: str) -> str:
        """Decoded; invalid UTF-8 raises."""
        self._source.line(f"{name} = {name}.decode()")
        return name

    def wide_text(self, name: str) -> str:
        """The variable."""
        return name

    def fixed(self, kind: FieldType, name: str) -> str:
        """Bytes as base64, numbers as a tuple, or as an array where there are many."""
        assert kind.primitive is not None
        if kind.base in BYTES:
            return f"{self._base64()}({name})"
        code = kind.primitive.code
        if code == "?" and kind.length <= _FEW:
            return f"[*map(bool, {name})]"
        if code not in "f?" and kind.length <= 2 * _FEW:
            return f"{self._source.constant(struct.Struct(f'<{kind.length}{code}').unpack)}({name})"
        return self._array(code, name)

    def numbers(self, kind: FieldType, count: str) -> str:
        """As :meth:`fixed`, of any length."""
        assert kind.primitive is not None
        name, code, size = self._source.new_variable(), kind.primitive.code, kind.primitive.size
        length = count if size == 1 else f"{count} * {size}"
        part = f"data[p:p + {length}]"
        self._source.line(f"if p + {length} > len(data): raise UseSlowPath")
        if kind.base in BYTES:
            view = self._source.constant(memoryview)
            value = f"{self._base64()}({part} if {count} < {_COPIED} else {view}(data)[p:p + {length}])"
        elif code in "f?":
            # Single precision has a shorter spelling, which only numpy's arrays get.
            value = f"{self._array(code, part)} if {count} else ()"
        else:
            few = self._source.constant(_UNPACK[code])
            # A copy, whose memory is aligned as orjson expects it; the message's head moves numbers by 4.
            value = f"{few}[{count}](data, p) if {count} <= {_FEW} else {self._array(code, part)}"
        self._source.line(f"{name} = {value}")
        return name

    def object(self, definition: Definition, values: Sequence[str]) -> str:
        """A dict display."""
        names = [field.name for field in definition.fields]
        return (
            "{"
            + ", ".join(f"{quoted(name)}: {value}" for name, value in zip(names, values, strict=True))
            + "}"
        )

    def array(self, values: Sequence[str]) -> str:
        """A list display."""
        return f"[{', '.join(values)}]"

    def gathered(self, name: str, count: str) -> str:
        """The list itself."""
        return name

    def gather(self, name: str, value: str) -> str:
        """Append."""
        return f"{name}.append({value})"

    def each(self, value: str, loop: str, count: str) -> str:
        """A list comprehension."""
        name = self._source.new_variable()
        self._source.line(f"{name} = [{value} {loop}]")
        return name

    def result(self, value: str) -> str:
        """orjson's text."""
        options = f", option={orjson.OPT_SERIALIZE_NUMPY}" if self._arrays else ""
        return f"{self._source.constant(orjson.dumps)}({value}{options})"

    def _base64(self) -> str:
        return self._source.constant(pybase64.b64encode_as_string)

    def _array(self, code: str, data: str) -> str:
        self._arrays = True
        frombuffer = self._source.constant(numpy.frombuffer)
        dtype = self._source.constant(numpy.dtype("u1" if code == "?" else code))
        array = f"{frombuffer}({data}, {dtype})"
        # Any byte but 0 is true; numpy's bool takes only 0 and 1.
        return f"({array} != 0)" if code == "?" else array


class HoldsArrays(Exception):
    """The message has arrays of numbers, which msgspec cannot encode."""


class StructJsonEmitter(JsonEmitter):
    """Values are expressions, messages are msgspec structs, which are faster to create than dicts."""

    def __init__(self, source: FunctionBuilder, structs: StructFactory) -> None:
        super().__init__(source)
        self._structs = structs

    def numbers(self, kind: FieldType, count: str) -> str:
        """Not supported.

        :raises HoldsArrays: always
        """
        raise HoldsArrays

    def object(self, definition: Definition, values: Sequence[str]) -> str:
        """A struct."""
        struct = self._source.constant(self._structs.of(definition.name))
        return f"{struct}({', '.join(values)})"

    def result(self, value: str) -> str:
        """msgspec's text."""
        return f"{self._source.constant(jsontext.encode)}({value})"

    def _array(self, code: str, data: str) -> str:
        raise HoldsArrays


class CborPart(NamedTuple):
    """Part of a CBOR item: constant bytes, packed numbers, or an expression.

    :param code: format of the numbers, big endian; empty for an expression
    :param values: expressions of the numbers, or the one expression; bytes where they are known
    """

    code: str
    values: tuple[str | bytes, ...]


def _known(data: bytes) -> CborPart:
    return CborPart(f"{len(data)}s", (data,))


def head(major: int, value: int) -> bytes:
    """The head of a CBOR item: its major type and a length or number (RFC 8949 section 3)."""
    if value < 24:
        return bytes([major << 5 | value])
    for information, code, limit in ((24, "B", 1 << 8), (25, "H", 1 << 16), (26, "I", 1 << 32)):
        if value < limit:
            return struct.pack(">B" + code, major << 5 | information, value)
    return struct.pack(">BQ", major << 5 | 27, value)


_INTEGERS = {"b": (24, 7, "B"), "h": (25, 15, "H"), "i": (26, 31, "I"), "q": (27, 63, "Q")}
_UNSIGNED = {"B": 24, "H": 25, "I": 26, "Q": 27}
_FLOATS = {"f": 0xFA, "d": 0xFB}
_BOOLEANS = bytes([0xF4] + [0xF5] * 255)
_TEXT, _BYTES, _ARRAY = 0x7A, 0x5A, 0x9A
"""Heads of a text, bytes, and an array whose 32-bit length follows."""


class CborEmitter:
    """Values are lists of parts; one call packs neighbouring ones."""

    def __init__(self, source: FunctionBuilder) -> None:
        self._source = source

    def number(self, primitive: Primitive, name: str) -> list[CborPart]:
        """Head and number, both packed."""
        code = primitive.code
        if code == "?":
            return [CborPart("B", (f"0xf4 + {name}",))]
        if code in _FLOATS:
            return [_known(bytes([_FLOATS[code]])), CborPart(code, (name,))]
        if code in _UNSIGNED:
            return [_known(bytes([_UNSIGNED[code]])), CborPart(code, (name,))]
        # A negative number n is written as -1 - n under the next major type.
        width, sign, unsigned = _INTEGERS[code]
        return [CborPart("B" + unsigned, (f"{width} | {name} >> {sign} & 32", f"{name} ^ {name} >> {sign}"))]

    def text(self, name: str) -> list[CborPart]:
        """Copied; invalid UTF-8 raises."""
        self._source.line(f"{name}.decode()")
        return self._sized(_TEXT, name)

    def wide_text(self, name: str) -> list[CborPart]:
        """Encoded as UTF-8."""
        self._source.line(f"{name} = {name}.encode()")
        return self._sized(_TEXT, name)

    def fixed(self, kind: FieldType, name: str) -> list[CborPart]:
        """A typed array, its bytes copied."""
        assert kind.primitive is not None
        if kind.primitive.code == "?":
            translated = f"{name}.translate({self._source.constant(_BOOLEANS)})"
            return [_known(head(4, kind.length)), CborPart(f"{kind.length}s", (translated,))]
        size = kind.length * kind.primitive.size
        start = head(6, TYPED_ARRAYS[kind.primitive.code]) + head(2, size)
        return [_known(start), CborPart(f"{size}s", (name,))]

    def numbers(self, kind: FieldType, count: str) -> list[CborPart]:
        """As :meth:`fixed`, of any length."""
        assert kind.primitive is not None
        name, code, size = self._source.new_variable(), kind.primitive.code, kind.primitive.size
        length = count if size == 1 else f"{count} * {size}"
        self._source.line(f"if p + {length} > len(data): raise UseSlowPath")
        self._source.line(f"{name} = data[p:p + {length}]")
        if code == "?":
            translated = f"{name}.translate({self._source.constant(_BOOLEANS)})"
            return [CborPart("BI", (str(_ARRAY), count)), CborPart("", (translated,))]
        return [_known(head(6, TYPED_ARRAYS[code])), *self._sized(_BYTES, name)]

    def object(self, definition: Definition, values: Sequence[list[CborPart]]) -> list[CborPart]:
        """A map with its keys."""
        names = [field.name for field in definition.fields]
        pieces = [_known(head(5, len(names)))]
        for name, value in zip(names, values, strict=True):
            key = name.encode()
            pieces += [_known(head(3, len(key)) + key), *value]
        return pieces

    def array(self, values: Sequence[list[CborPart]]) -> list[CborPart]:
        """The elements after their number."""
        return [_known(head(4, len(values))), *(piece for value in values for piece in value)]

    def gathered(self, name: str, count: str) -> list[CborPart]:
        """The collected elements after their number."""
        return [CborPart("BI", (str(_ARRAY), count)), CborPart("", ("*" + name,))]

    def gather(self, name: str, value: list[CborPart]) -> str:
        """Append the element's parts."""
        return f"{name} += {self._parts(value)}"

    def each(self, value: list[CborPart], loop: str, count: str) -> list[CborPart]:
        """A list comprehension of the elements' bytes."""
        name = self._source.new_variable()
        (packed,) = self._merged(value)
        self._source.line(f"{name} = [{packed} {loop}]")
        return self.gathered(name, count)

    def result(self, value: list[CborPart]) -> str:
        """All parts joined."""
        merged = self._merged(value)
        if len(merged) == 1:
            return merged[0]
        return f"{self._source.constant(b''.join)}({self._parts(value)})"

    def _sized(self, start: int, name: str) -> list[CborPart]:
        return [CborPart("BI", (str(start), f"len({name})")), CborPart("", (name,))]

    def _parts(self, value: list[CborPart]) -> str:
        return f"({', '.join(self._merged(value))},)"

    def _merged(self, pieces: list[CborPart]) -> list[str]:
        """Expressions of bytes: neighbouring known and packed pieces as one."""
        found: list[str] = []
        run: list[CborPart] = []
        for piece in pieces:
            if piece.code:
                run.append(piece)
            else:
                found += [*self._packed(run), str(piece.values[0])]
                run = []
        return found + self._packed(run)

    def _packed(self, run: list[CborPart]) -> list[str]:
        if not run:
            return []
        codes, values, known = [], list[str](), b""
        for piece in [*run, CborPart("", ())]:
            if piece.values and isinstance(piece.values[0], bytes):
                known += piece.values[0]
                continue
            if known:
                codes.append(f"{len(known)}s")
                values.append(self._source.constant(known))
                known = b""
            codes.append(piece.code)
            values += map(str, piece.values)
        if len(values) == 1 and codes[0].endswith("s"):
            return values
        return [f"{self._source.constant(struct.Struct('>' + ''.join(codes)).pack)}({', '.join(values)})"]
