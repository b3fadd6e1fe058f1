"""What fails as nobody foresaw it."""

from __future__ import annotations

from typing import NoReturn


def broken(*_: object, **__: object) -> NoReturn:
    """Stand for any function; nobody but the log may have its words."""
    raise RuntimeError("secret internals")
