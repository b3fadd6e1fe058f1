"""Keys of JSON objects: none may come twice.

RFC 8259 section 4 leaves open which of two equal keys counts. The relay and a robot could read the same text
differently, so such text is refused. Parsers in C (msgspec, orjson) take the last one without a word; the parser of the
standard library reports all pairs, but takes as long as all other work on a small message. So cheap proofs come first:

- A short message is looked up by its shape: its text without the characters of numbers. A stream of commands has one.
- A short message of a new shape is decoded and encoded again. A lost key is a lost colon.
- In a long message with few strings the quotation marks are looked for.

What none of them proves is given to the parser of the standard library. All of them take linear time.
"""

from __future__ import annotations

import json
from typing import Any

import msgspec

from relay_protocol.errors import MalformedMessage

SHORT = 2048
"""Bytes of a message that is looked up by its shape."""

SHAPES = 512
"""Shapes that are kept; at most 1 MiB with :data:`SHORT`."""

OF_NUMBERS = b"0123456789+-.eE"
_NOT_BRACES = bytes(byte for byte in range(256) if byte not in b"{}")
_OPENING = ord("{")
_ESCAPED = b"\\u003"
"""How an escaped colon begins."""

_SPARSE = 64
"""Bytes for each string from which on it is faster to look for quotation marks than to parse."""

_SHOWN = 40
"""Characters of a key in an error message."""

_decode = msgspec.json.Decoder().decode
_encode = msgspec.json.Encoder().encode


distinct: set[bytes] = set()
"""Shapes in which no object can have a key twice, whatever numbers stand in them."""

_seen: set[bytes] = set()
"""Shapes that came once. To prove a shape takes time, and texts that never come again are not worth it."""


def check_keys(data: bytes) -> None:
    """Refuse JSON in which an object has a key twice, also with different escapes.

    :param data: JSON in UTF-8 of bounded depth; ``NaN`` and ``Infinity`` are let through
    :raises MalformedMessage: the sentence names the key
    """
    if len(data) <= SHORT:
        shape = data.translate(None, OF_NUMBERS)
        if shape in distinct:
            return
        if _survives(data):
            _learn(shape)
            return
    elif b"\\" not in data and _distinct_by_quotes(data):
        return
    try:
        json.loads(str(data, "utf-8"), strict=False, object_pairs_hook=_pairs, parse_int=len, parse_float=len)
    except ValueError as error:
        raise MalformedMessage(f"the message is not JSON: {error}") from None


def _learn(shape: bytes) -> None:
    """Note the shape of a text with distinct keys.

    A key with an escape may equal one without. Keys may differ by a digit alone, which the shape does not show.
    """
    if b"\\" in shape:
        return
    if shape not in _seen:
        _add(_seen, shape)
    elif _distinct_by_quotes(shape):
        _add(distinct, shape)


def _add(shapes: set[bytes], shape: bytes) -> None:
    if len(shapes) >= SHAPES:
        shapes.clear()
    shapes.add(shape)


def _survives(data: bytes) -> bool:
    """Whether all colons are still there when the text was decoded and encoded again.

    There is one for each key, and those in strings, which stay as they are. An escape may add one.
    """
    if _ESCAPED in data:
        return False
    try:
        return _encode(_decode(data)).count(b":") == data.count(b":")
    except (msgspec.DecodeError, RecursionError, ValueError):
        return False


def _distinct_by_quotes(data: bytes) -> bool:
    """Whether each object is seen to have each key once; false also for a text of many strings.

    Long strings and long lists of numbers are skipped in C.

    :param data: JSON without a backslash; its numbers may be missing
    """
    keys: set[bytes] = set()
    outer: list[set[bytes]] = []
    most = max(len(data) // _SPARSE, SHORT)
    begun = at = 0
    for _ in range(most):
        start = data.find(b'"', at)
        between = data[at:start] if start >= 0 else data[at:]
        if at and between.lstrip().startswith(b":"):
            key = data[begun : at - 1]
            if key in keys:
                return False
            keys.add(key)
        if b"{" in between or b"}" in between:
            for brace in between.translate(None, _NOT_BRACES):
                if brace == _OPENING:
                    outer.append(keys)
                    keys = set()
                else:
                    keys = outer.pop()
        if start < 0:
            return True
        begun = start + 1
        at = data.find(b'"', begun) + 1
    return False


def _pairs(pairs: list[tuple[str, Any]]) -> None:
    """Look at one object; nothing of it is kept."""
    if len(dict(pairs)) == len(pairs):
        return
    keys = set()
    for key, _ in pairs:
        if key in keys:
            shown = key if len(key) <= _SHOWN else key[: _SHOWN - 3] + "..."
            raise MalformedMessage(
                f"the message has the key '{shown}' twice in one object; send each key once"
            )
        keys.add(key)
