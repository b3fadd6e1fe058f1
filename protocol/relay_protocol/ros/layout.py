"""Memory layout of types: their smallest size in CDR, and which can be repeated without padding."""

from __future__ import annotations

from typing import NamedTuple

from relay_protocol.ros.definition import Definition, FieldType, Shape


class Block(NamedTuple):
    """A message of numbers only that needs no padding between its copies.

    :param size: bytes
    :param alignment: every copy starts at a multiple of this, bytes
    """

    size: int
    alignment: int


class LayoutTable:
    """Layouts of the types of one text, each computed once."""

    def __init__(self, definitions: dict[str, Definition]) -> None:
        self._definitions = definitions
        self._min_size: dict[str, int] = {}
        self._layouts: dict[str, list[tuple[int, int]] | None] = {}

    def min_size(self, kind: FieldType) -> int:
        """Fewest bytes of a field, without padding."""
        if kind.shape is Shape.SEQUENCE:
            return 4
        return self.min_element_size(kind) * (kind.length or 1)

    def min_element_size(self, kind: FieldType) -> int:
        """Fewest bytes of one element."""
        if kind.primitive is not None:
            return kind.primitive.size
        if kind.base not in self._min_size:
            fields = self._definitions[kind.base].fields
            self._min_size[kind.base] = sum(self.min_size(field.type) for field in fields) or 1
        return self._min_size[kind.base]

    def block(self, name: str) -> Block | None:
        """The message as a block, if it is one."""
        parts = self._parts(name)
        if not parts:
            return None
        first, largest = parts[0][0], max(alignment for alignment, _ in parts)
        position = 0
        for alignment, size in parts:
            position += -position % alignment + size
        return Block(position, first) if first == largest and position % first == 0 else None

    def _parts(self, name: str) -> list[tuple[int, int]] | None:
        """Alignment and size of each part of a message of numbers; ``None`` when it holds anything else."""
        if name not in self._layouts:
            self._layouts[name] = self._find_parts(self._definitions[name])
        return self._layouts[name]

    def _find_parts(self, definition: Definition) -> list[tuple[int, int]] | None:
        parts: list[tuple[int, int]] = []
        for field in definition.fields:
            kind = field.type
            if kind.shape is Shape.SEQUENCE or len(parts) > 100:
                return None
            if kind.primitive is None:
                inner = self._parts(kind.base)
                if not inner or kind.shape is Shape.ARRAY:
                    return None
                parts += inner
            elif not kind.primitive.code:
                return None
            else:
                parts.append((kind.primitive.size, kind.primitive.size * (kind.length or 1)))
        return parts
