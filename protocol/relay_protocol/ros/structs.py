"""msgspec structs for the types of one text. They decode JSON, check it and fill in defaults.

The attributes are named ``f0``, ``f1``, …; field names are used in JSON only. An unknown field or a wrong type is an
error.
"""

from __future__ import annotations

from typing import Any

import msgspec
from msgspec import UNSET, UnsetType

from relay_protocol.limits import MIB
from relay_protocol.ros.codegen import MAX_STEPS, TooLarge
from relay_protocol.ros.definition import BYTES, HEADER, Definition, Field, FieldType, Shape

_DEFAULTS = 20_000
"""Most elements in the default arrays of all structs of one type."""
_MEMORY = 32 * MIB
"""Most memory of structs decoded from one text, bytes."""

_Kind = Any
"""A type annotation, as msgspec takes it."""


class StructFactory:
    """Creates the struct of a message when it is first used."""

    def __init__(self, definitions: dict[str, Definition]) -> None:
        self._definitions = definitions
        self._structs: dict[str, type[msgspec.Struct]] = {}
        self._fields = 0
        self._defaults = 0
        self.max_fields = 0

    def of(self, name: str) -> type[msgspec.Struct]:
        """The struct of a message; its attributes are in the order of the fields.

        :raises TooLarge: too many fields, or too long default arrays
        """
        found = self._structs.get(name)
        if found is None:
            found = self._structs[name] = self._make(self._definitions[name])
        return found

    @property
    def max_json_bytes(self) -> int:
        """Longest JSON that may be decoded, bytes: a short ``{}`` creates a struct with all its fields."""
        return 3 * _MEMORY // (24 + 8 * self.max_fields)

    def _make(self, definition: Definition) -> type[msgspec.Struct]:
        self._fields += len(definition.fields)
        self.max_fields = max(self.max_fields, len(definition.fields))
        if self._fields > MAX_STEPS:
            raise TooLarge
        parts = []
        for index, field in enumerate(definition.fields):
            kind, default = self._kind(field.type), self._default(field)
            if is_stamp(definition, field):
                kind, default = kind | UnsetType, UNSET
            parts.append((f"f{index}", kind, default))
        return msgspec.defstruct(
            "Message",
            parts,
            rename={f"f{index}": field.name for index, field in enumerate(definition.fields)},
            frozen=True,
            gc=False,
            forbid_unknown_fields=True,
        )

    def _kind(self, kind: FieldType) -> _Kind:
        many = kind.shape is not Shape.SCALAR
        if many and kind.base in BYTES:
            return str | list[int]
        one: _Kind = self.of(kind.base) if kind.primitive is None else type(kind.primitive.zero)
        if many and one is float:
            one = float | None
        return list[one] if many else one

    def _default(self, field: Field) -> Any:
        kind = field.type
        zero = self.of(kind.base)() if kind.primitive is None else kind.primitive.zero
        if kind.shape is Shape.SCALAR:
            return zero if field.default is None else field.default
        length = kind.length if kind.shape is Shape.ARRAY else 0
        self._defaults += length
        if self._defaults > _DEFAULTS:
            raise TooLarge
        values: tuple[Any, ...] = (zero,) * length if field.default is None else tuple(field.default)
        return bytes(values) if kind.base in BYTES else values


_TIME = (("sec", FieldType("int32")), ("nanosec", FieldType("uint32")))


def is_stamp(definition: Definition, field: Field) -> bool:
    """Whether this is the stamp of a header, which defaults to the current time."""
    return definition.name == HEADER and field.name == "stamp"


def is_time(definition: Definition | None) -> bool:
    """Whether a message has the fields of ``builtin_interfaces/Time``, whatever its name."""
    return definition is not None and tuple((field.name, field.type) for field in definition.fields) == _TIME
