"""Arguments of the relay's own services, as clients give them: an object, or a list in order."""

from __future__ import annotations

from typing import Any

from relay_protocol.errors import Invalid


def get_argument(args: Any, field: str, position: int = 0, default: Any = None) -> Any:
    """One argument, whatever it is.

    :param position: its place in a list
    :param default: for one that is left out
    """
    if isinstance(args, dict):
        return args.get(field, default)
    if isinstance(args, list):
        return args[position] if position < len(args) else default
    return default


def text(args: Any, field: str, position: int = 0, default: str | None = None) -> str:
    """One argument, a string.

    :param position: its place in a list
    :param default: for one that is left out; ``None`` when it must be given
    :raises Invalid: it is left out, or no string
    """
    value = get_argument(args, field, position, default)
    if not isinstance(value, str):
        raise Invalid(f"give '{field}', a string")
    return value


def name(args: Any, field: str) -> str:
    """The name of a topic, service, action or node, with its leading slash.

    :raises Invalid: it is left out, or no string
    """
    return absolute(text(args, field))


def absolute(name: str) -> str:
    """The name with its leading slash."""
    return name if name.startswith("/") else "/" + name
