"""A topic with its type, which together determine a publisher of zero."""

from __future__ import annotations

from typing import NamedTuple


class TypedTopic(NamedTuple):
    """A topic as the platform resolved it: absolute name, full type name."""

    name: str
    type: str

    def __str__(self) -> str:
        return f"{self.name} ({self.type})"
