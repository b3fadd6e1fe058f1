"""NaN and infinity in JSON from clients.

JSON has no word for them (RFC 8259 section 6). Python's ``json`` writes the literals ``NaN``, ``Infinity`` and
``-Infinity`` all the same, so roslibpy sends them and rosbridge reads them. A literal is replaced by a *mark*, a string
that no ROS string can be because it begins with NUL. So the text is JSON for every decoder, and a value that can be no
float is still known for what the client wrote.
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
"""What each mark stands for."""

INFINITE = ("\0Infinity", "\0-Infinity")
_MARKS = {mark[1:].encode(): msgspec.json.encode(mark) for mark in NUMBERS}
_WRITTEN = frozenset(_MARKS.values())
_IN_TURN = (
    (b"NaN", _MARKS[b"NaN"]),
    (b"Infinity", _MARKS[b"Infinity"]),
    (b"-" + _MARKS[b"Infinity"], _MARKS[b"-Infinity"]),
)
_MARKED = re.compile(rb'"\\u0000(?:NaN|-?Infinity)"')
# A string matches up to its quotation mark, or up to the end: so no character is looked at twice.
_STRING = rb'"[^"\\]*(?:\\.?[^"\\]*)*(?:"|\Z)'
_APART = b"\xff"
_ESCAPES = ((b"\\\\", b"\xfe\xfe"), (b'\\"', b"\xfd\xfd"))
"""Escapes that matter to find the ends of strings, and what no text in UTF-8 holds to stand for them."""
_NO_TEXT = re.compile(rb"[\xfd-\xff]").search
_STRING_OR_NAME = re.compile(rb"(" + _STRING + rb")(\s*:)?", re.DOTALL)


class NotFinite(Invalid):
    """NaN or infinity stands where no float can be."""

    code = "not_finite"


def may_hold_literals(text: bytes) -> bool:
    """Whether a text that is no JSON may be none because of these literals."""
    return b"NaN" in text or b"Infinity" in text


def mark(text: bytes) -> bytes:
    """The text with a mark for each literal outside of strings; in time linear to its length, by loops in C."""
    if not text.isascii() and _NO_TEXT(text):
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
    """Whether there may be marks in a JSON text."""
    return _MARKED.search(text) is not None


def mark_fields(text: bytes, allowed: Container[str]) -> bytes | None:
    """As :func:`mark`, for an object that may hold the literals only in some of its fields.

    :param allowed: names of these fields
    :returns: ``None`` where the literals are not what keeps the text from being such JSON
    :raises NotFinite: a literal stands in another field, or in the place of a name, or the text is too long to look
    """
    if len(text) > json_cost.LARGE:
        raise NotFinite(
            f"NaN and infinity are no JSON; they are taken in messages of at most {json_cost.LARGE} bytes"
        )
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
                f"{shown(name)}: NaN and infinity are no JSON; they are taken as numbers of messages only"
            )
    return marked


def decode(decoder: msgspec.json.Decoder[T], text: bytes, allowed: Container[str]) -> T:
    """As :func:`relay_protocol.jsontext.decode`, with marks for the literals in some fields of an object.

    :raises NotFinite: as :func:`mark_fields`
    :raises MalformedMessage: as there
    """
    if may_hold_literals(text):
        jsontext.check_text(text)
        text = mark_fields(text, allowed) or text
    return jsontext.decode(decoder, text)


def plain(value: Any) -> Any:
    """A decoded value with floats for marks."""
    if type(value) is str:
        return NUMBERS.get(value, value)
    if type(value) is list:
        return [plain(each) for each in value]
    if type(value) is dict:
        return {name: plain(each) for name, each in value.items()}
    return value


def with_marks(value: Any) -> Any:
    """A value to be encoded, with marks for what is not finite; encoders of JSON write ``null`` for it."""
    if type(value) is float and not math.isfinite(value):
        return "\0NaN" if math.isnan(value) else INFINITE[value < 0]
    if type(value) is list:
        return [with_marks(each) for each in value]
    if type(value) is dict:
        return {name: with_marks(each) for name, each in value.items()}
    return value


def as_null(text: bytes) -> bytes:
    """A JSON text with ``null`` for its marks, for readers of strict JSON (SPEC section 4); nothing else changes."""
    if not is_marked(text):
        return text
    return _STRING_OR_NAME.sub(_null_for_mark, text)


def _null_for_mark(match: re.Match[bytes]) -> bytes:
    return b"null" if match[1] in _WRITTEN and match[2] is None else match[0]


def shown(name: str) -> str:
    """A mark or a name for people, short."""
    return name.replace("\0", "")[:60]
