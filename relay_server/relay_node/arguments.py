"""Arguments of the relay's own services, as clients give them: an object, or a list in order."""

from __future__ import annotations

from typing import Any

from relay_protocol.errors import Invalid
from relay_server.control.stop_fields import reason_of, stop_id_of


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


def stop_arguments(args: Any) -> tuple[str, str]:
    """Reason and id of a stop; an unusable one counts as none."""
    return reason_of(get_argument(args, "why")), stop_id_of(get_argument(args, "stop_id", 1))


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


def whole_number(args: Any, field: str, position: int, default: int) -> int:
    """One argument, a whole number; ``2.0`` is one, too.

    :param position: its place in a list
    :param default: for one that is left out
    :raises Invalid: it is no whole number
    """
    value = get_argument(args, field, position, default)
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if not isinstance(value, int) or isinstance(value, bool):
        raise Invalid(f"'{field}' must be a whole number")
    return value


def name(args: Any, field: str) -> str:
    """The name of a topic, service, action or node, with its leading slash.

    :raises Invalid: it is left out, or no string
    """
    return absolute(text(args, field))


def absolute(name: str) -> str:
    """The name with its leading slash."""
    return name if name.startswith("/") else "/" + name
