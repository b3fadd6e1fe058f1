"""ICPI messages: ``dest!sn!sender!id!n!ak!0|1!fx!Function!ar!(0)v0(1)v1!br!0|1``.

Values are text without ``!``, ``(`` and ``%``; these are written as ``%21``, ``%28`` and ``%25``. Other escapes are
read as in URLs (RFC 3986, section 2.1), as bytes of UTF-8.
"""

from __future__ import annotations

import re
from typing import NamedTuple
from urllib.parse import unquote

from relay_protocol.errors import Invalid

MAX_MESSAGE = 16 * 1024
"""Bytes."""

MAX_ARGUMENTS = 32

FORM = "dest!sn!sender!id!n!ak!0|1!fx!Function!ar!(0)v0(1)v1!br!0|1"

_FIELDS = ("sn", "id", "ak", "fx", "ar", "br")
_NAME = re.compile(r"[\w.~:/ -]{1,128}\Z")
_FUNCTION = re.compile(r"[A-Za-z_]\w{0,63}\Z")
_ID = re.compile(r"[^!\x00-\x1f\x7f]{0,64}\Z")
_ARGUMENT = re.compile(r"\((0|[1-9][0-9]?)\)([^(]*)")
_ESCAPED = {"%": "%25", "!": "%21", "(": "%28"}
_NO_ESCAPE = re.compile(r"%(?![0-9A-Fa-f]{2}).{0,2}")


class IcpiMessage(NamedTuple):
    """One message.

    :param dest: the receiver: a Role, a program, or ``relay``
    :param sender: the program that sends it
    :param id: of a request, any text that its sender chooses, or empty; its reply has the same
    :param acknowledge: whether the sender wants a reply
    :param function: what is called
    :param args: in order
    :param broadcast: whether it goes to all programs of the sender's user
    """

    dest: str
    sender: str
    id: str
    acknowledge: bool
    function: str
    args: tuple[str, ...] = ()
    broadcast: bool = False


def parse(text: str) -> IcpiMessage:
    """Read a message.

    :raises Invalid: it is none; the text says which part is wrong
    """
    parts = text.split("!")
    if len(parts) != 2 * len(_FIELDS) + 1:
        raise Invalid(f"this has {len(parts)} parts between '!'; a message has 13: {FORM}")
    for position, name in enumerate(_FIELDS):
        found = parts[1 + 2 * position]
        if found != name:
            raise Invalid(f"'{found[:20]}' stands where '{name}' must stand: {FORM}")
    sender, id, acknowledge, function, args, broadcast = parts[2::2]
    dest = _unescaped(parts[0])
    if not (broadcast == "1" and not dest) and not _NAME.match(dest):
        raise Invalid(f"'{dest[:40]}' is no receiver")
    sender = _unescaped(sender)
    if sender and not _NAME.match(sender):
        raise Invalid(f"'{sender[:40]}' is no sender")
    if not _ID.match(id):
        raise Invalid(f"'{id[:20]}' is no id: it has 64 characters at most, and no control characters")
    if not _FUNCTION.match(function):
        raise Invalid(f"'{function[:40]}' is no function: it must have letters, digits and '_'")
    return IcpiMessage(
        dest, sender, id, _flag("ak", acknowledge), function, _arguments(args), _flag("br", broadcast)
    )


def write(message: IcpiMessage) -> str:
    """The text of a message."""
    args = "".join(f"({number}){_escaped(each)}" for number, each in enumerate(message.args))
    values = (
        _escaped(message.sender),
        message.id,
        str(int(message.acknowledge)),
        message.function,
        args,
        str(int(message.broadcast)),
    )
    fields = "".join(f"!{name}!{value}" for name, value in zip(_FIELDS, values, strict=True))
    return _escaped(message.dest) + fields


def id_of(text: str) -> str:
    """The id of a message that can't be read otherwise, for the answer; empty if it has none."""
    found = re.search(r"!id!([^!\x00-\x1f\x7f]{0,64})!", text)
    return found[1] if found is not None else ""


def _flag(name: str, text: str) -> bool:
    if text not in ("0", "1"):
        raise Invalid(f"'{text[:20]}' stands where '{name}' must be 0 or 1")
    return text == "1"


def _arguments(text: str) -> tuple[str, ...]:
    found: list[str] = []
    at = 0
    while at < len(text):
        match = _ARGUMENT.match(text, at)
        if match is None or int(match[1]) != len(found):
            raise Invalid(
                f"argument {len(found)} must begin with '({len(found)})', not '{text[at : at + 20]}'"
            )
        if len(found) >= MAX_ARGUMENTS:
            raise Invalid(f"there are more than {MAX_ARGUMENTS} arguments")
        found.append(_unescaped(match[2]))
        at = match.end()
    return tuple(found)


def _escaped(text: str) -> str:
    return re.sub("[%!(]", lambda found: _ESCAPED[found[0]], text)


def _unescaped(text: str) -> str:
    if "%" not in text:
        return text
    wrong = _NO_ESCAPE.search(text)
    if wrong is not None:
        raise Invalid(f"'{wrong[0]}' is no escape; write '%25' for '%'")
    try:
        return unquote(text, errors="strict")
    except UnicodeDecodeError:
        raise Invalid(f"the escapes of '{text[:40]}' are not UTF-8") from None
