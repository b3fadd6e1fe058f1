"""A topic with its type, which together say what a publisher of zero must be."""

from __future__ import annotations

from typing import NamedTuple


class TypedTopic(NamedTuple):
    """A topic as the platform knows it: absolute name, full type name."""

    topic: str
    type: str

    def __str__(self) -> str:
        return f"{self.topic} ({self.type})"
