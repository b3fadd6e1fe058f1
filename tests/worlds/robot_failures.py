"""Unexpected errors."""

from __future__ import annotations

from typing import NoReturn


def broken(*_: object, **__: object) -> NoReturn:
    """Raises an error whose text must stay in the log."""
    raise RuntimeError("secret internals")
