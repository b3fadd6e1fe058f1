"""Texts of types invented for tests."""

from __future__ import annotations

from relay_protocol.ros_types import TypeRegistry

LINE = "=" * 80


def registry(**texts: str) -> TypeRegistry:
    """A registry of these texts, under package ``a``."""
    types = TypeRegistry()
    for name, text in texts.items():
        types.add(f"a/msg/{name}", text)
    return types
