"""NaN and infinity in JSON from clients.

JSON has no form for them (RFC 8259 section 6). Python's ``json`` writes the literals ``NaN``, ``Infinity`` and
``-Infinity`` anyway, so roslibpy sends them and rosbridge accepts them. Each literal is replaced by a *mark*, a string
that begins with NUL and so cannot be a ROS string. The text is then JSON for every decoder, and an error message can
still show what the client wrote.
"""

from __future__ import annotations

import math
import re
from collections.abc import Container
from typing import Any, TypeVar

import msgspec

from relay_protocol import json_cost, jsontext
from relay_protocol.errors import Invalid

T = TypeVar("T")

NUMBERS = {"\0NaN": math.nan, "\0Infinity": math.inf, "\0-Infinity": -math.inf}
"""Value of each mark."""

INFINITE = ("\0Infinity", "\0-Infinity")
_MARKS = {mark[1:].encode(): msgspec.json.encode(mark) for mark in NUMBERS}
_WRITTEN = frozenset(_MARKS.values())
_IN_TURN = (
    (b"NaN", _MARKS[b"NaN"]),
    (b"Infinity", _MARKS[b"Infinity"]),
    (b"-" + _MARKS[b"Infinity"], _MARKS[b"-Infinity"]),
)
_BACKSLASH = ord("\\")
_MARKED = re.compile(rb'"\\u0000(?:NaN|-?Infinity)"')
# Matches a string up to its quotation mark or the end of the text, so no character is read twice.
_STRING = rb'"[^"\\]*(?:\\.?[^"\\]*)*(?:"|\Z)'
_APART = b"\xff"
_ESCAPES = ((b"\\\\", b"\xfe\xfe"), (b'\\"', b"\xfd\xfd"))
"""Escapes that affect where strings end, and bytes that UTF-8 never contains as placeholders."""
_NOT_IN_TEXT = (b"\xfd", b"\xfe", b"\xff")
_STRING_OR_NAME = re.compile(rb"(" + _STRING + rb")(\s*:)?", re.DOTALL)


class NotFinite(Invalid):
    """NaN or infinity where no float is allowed."""

    code = "not_finite"


def may_hold_literals(text: bytes) -> bool:
    """Whether these literals may be why a text is not JSON."""
    return b"NaN" in text or b"Infinity" in text


def mark(text: bytes) -> bytes:
    """Replace each literal outside strings by a mark, in linear time with loops in C."""
    if not text.isascii() and any(byte in text for byte in _NOT_IN_TEXT):
        return text
    escaped = b"\\" in text
    if escaped:
        for escape, code in _ESCAPES:
            text = text.replace(escape, code)
    pieces = text.split(b'"')
    outside = _APART.join(pieces[::2])
    for literal, written in _IN_TURN:
        outside = outside.replace(literal, written)
    pieces[::2] = outside.split(_APART)
    text = b'"'.join(pieces)
    if escaped:
        for escape, code in _ESCAPES:
            text = text.replace(code, escape)
    return text


def is_marked(text: bytes) -> bool:
    """Whether a JSON text may contain marks."""
    # Each mark has an escape, and one byte is found much faster than a pattern.
    return _BACKSLASH in text and _MARKED.search(text) is not None


def mark_fields(text: bytes, allowed: Container[str]) -> bytes | None:
    """As :func:`mark`, for an object that may contain the literals in some fields only.

    :param allowed: names of these fields
    :returns: ``None`` when the text is not JSON for another reason
    :raises NotFinite: a literal in another field or as a name
    :raises TooCostly: see :func:`relay_protocol.json_cost.check_literals`
    """
    json_cost.check_literals(text)
    marked = mark(text)
    if marked == text:
        return None
    try:
        fields = msgspec.json.decode(marked, type=dict[str, msgspec.Raw])
    except jsontext.FAULTS:
        return None
    for name, value in fields.items():
        if name in NUMBERS or (name not in allowed and is_marked(bytes(value))):
            raise NotFinite(
                f"{display_name(name)}: NaN and infinity are not JSON; they are accepted only as numbers in messages"
            )
    return marked


def decode(decoder: msgspec.json.Decoder[T], text: bytes, allowed: Container[str]) -> T:
    """As :func:`relay_protocol.jsontext.decode`, with marks for the literals in some fields of an object.

    :raises NotFinite, TooCostly: as :func:`mark_fields`
    :raises MalformedMessage: as there
    """
    if not may_hold_literals(text):
        return jsontext.decode(decoder, text)
    # The letters may be in a string, such as base64. Then the text is JSON as it is.
    jsontext.check_text(text)
    try:
        message = decoder.decode(text)
    except jsontext.FAULTS:
        return jsontext.decode(decoder, mark_fields(text, allowed) or text)
    jsontext.check_keys(text)
    return message


def mark_body(text: bytes) -> bytes:
    """As :func:`mark`, for the body of a message alone. JSON that has the letters in a string stays as it is.

    :raises MalformedMessage: see :func:`relay_protocol.jsontext.check_text`
    :raises TooCostly: see :func:`relay_protocol.json_cost.check_literals`
    """
    if not may_hold_literals(text):
        return text
    jsontext.check_text(text)
    try:
        _RAW.decode(text)
    except jsontext.FAULTS:
        json_cost.check_literals(text)
        return mark(text)
    return text


_RAW = msgspec.json.Decoder(msgspec.Raw)


def to_floats(value: Any) -> Any:
    """Replace marks in a decoded value by floats."""
    if type(value) is str:
        return NUMBERS.get(value, value)
    if type(value) is list:
        return [to_floats(each) for each in value]
    if type(value) is dict:
        return {name: to_floats(each) for name, each in value.items()}
    return value


def from_floats(value: Any) -> Any:
    """Replace NaN and infinity by marks before encoding; encoders of JSON would write ``null``."""
    if type(value) is float and not math.isfinite(value):
        return "\0NaN" if math.isnan(value) else INFINITE[value < 0]
    if type(value) is list:
        return [from_floats(each) for each in value]
    if type(value) is dict:
        return {name: from_floats(each) for name, each in value.items()}
    return value


def marks_to_null(text: bytes) -> bytes:
    """Replace the marks in a JSON text by ``null``, as strict JSON requires (SPEC 4)."""
    if not is_marked(text):
        return text
    return _STRING_OR_NAME.sub(_null_for_mark, text)


def require_finite(text: bytes) -> None:
    """Refuse a command to move that has NaN, infinity, or ``null`` for a number.

    :param text: JSON that was checked; NaN and infinity are marks
    :raises NotFinite: with the field
    :raises Invalid: it is ``null`` itself
    :raises TooCostly: see :func:`relay_protocol.json_cost.check_odd`
    """
    # Marks have this escape, however they are written. Nearly all commands have neither.
    if b"null" not in text and b"\\u0000" not in text:
        return
    json_cost.check_odd(text)
    found = _not_finite(jsontext.decode_any(text))
    if found is not None:
        path, value = found
        if not path:
            raise Invalid("the message must be an object, not null")
        raise NotFinite(f"{display_name(path)} must be finite in a command that moves the robot, not {value}")


def _not_finite(value: Any, path: str = "") -> tuple[str, str] | None:
    """Path and name of the first value that is ``null`` or a mark."""
    if value is None:
        return path, "null"
    if type(value) is str:
        return (path, value[1:]) if value in NUMBERS else None
    if type(value) is dict:
        parts = ((f"{path}.{name}" if path else name, each) for name, each in value.items())
    elif type(value) is list:
        parts = ((f"{path}[{index}]", each) for index, each in enumerate(value))
    else:
        return None
    return next((found for name, each in parts if (found := _not_finite(each, name)) is not None), None)


def _null_for_mark(match: re.Match[bytes]) -> bytes:
    return b"null" if match[1] in _WRITTEN and match[2] is None else match[0]


def display_name(name: str) -> str:
    """A mark or a name for error messages, at most 60 characters."""
    return name.replace("\0", "")[:60]
