"""Strict JSON: valid UTF-8, bounded depth, no NaN, no key twice in an object, and errors that name the fault.

msgspec skips values that it does not need: it checks neither their UTF-8 nor their depth. So each text is checked
once, as a whole, before it is decoded.

RFC 8259 section 4 leaves open which of two equal keys counts. The relay and a robot could read the same text
differently, so such text is refused. msgspec and orjson silently take the last one. The parser of the standard library
reports all pairs, but takes as long as all other work on a small message. So cheap proofs come first:

- A short message is decoded and encoded again. A lost key is a lost colon.
- In a long message with few strings the quotation marks are searched.

What none of them proves goes to the parser of the standard library. All of them take linear time.
"""

from __future__ import annotations

import json
import math
import re
from itertools import accumulate
from typing import Any, TypeVar, get_args

import msgspec

from relay_protocol import json_cost
from relay_protocol.errors import MalformedMessage
from relay_protocol.limits import JSON_DEPTH

T = TypeVar("T")

# --- UTF-8 and depth --------------------------------------------------------------------------------------

_COUNTED_BYTES = 4096
"""Up to this length brackets are counted; in a longer text a search for each is faster."""


def check_text(data: bytes, depth: int = JSON_DEPTH) -> None:
    """Refuse bytes that are no sane JSON text.

    :param data: the whole message
    :param depth: deepest nesting allowed
    :raises MalformedMessage: invalid UTF-8 or nesting deeper than ``depth``
    """
    if not data.isascii():
        check_utf8(data)
    # Too few bytes, or fewer opening brackets than the limit, can't be nested deeper. Each level takes two bytes of a
    # list, and five of an object (``{"":`` and ``}``).
    least = depth * (2 if _LIST in data else 5)
    if len(data) > least and _opens_more_than(depth, data) and _deepest(data) > depth:
        raise MalformedMessage(f"the message nests arrays and objects deeper than {depth}")


def check_utf8(data: bytes) -> None:
    """Refuse bytes that are not UTF-8 (RFC 8259 section 8.1).

    :raises MalformedMessage: with the first wrong byte
    """
    try:
        data.decode()
    except UnicodeDecodeError as error:
        raise MalformedMessage(f"the message is not valid UTF-8 (byte {error.start})") from None


def _opens_more_than(most: int, data: bytes) -> bool:
    """Whether a text has more opening brackets. A search is 50 times as fast as a count, but there is one for each."""
    if len(data) <= _COUNTED_BYTES:
        # Whether a number is in bytes is found out four times as fast as whether bytes are.
        return data.count(b"{") + (data.count(b"[") if _LIST in data else 0) > most
    for bracket in _OPENING_BRACKETS:
        at = data.find(bracket)
        while at >= 0:
            if most == 0:
                return True
            most -= 1
            at = data.find(bracket, at + 1)
    return False


_OPENING_BRACKETS = b"{["
_LIST = ord("[")


def _deepest(data: bytes) -> int:
    """Deepest nesting, by a running sum of brackets outside strings (all loops are in C)."""
    steps = memoryview(json_cost.outside_strings(data).translate(_STEPS, _NOT_BRACKETS)).cast("b")
    return max(accumulate(steps), default=0)


_NOT_BRACKETS = bytes(byte for byte in range(256) if byte not in b"[]{}")
_STEPS = bytes.maketrans(b"[{]}", b"\x01\x01\xff\xff")


def decode(decoder: msgspec.json.Decoder[T], data: bytes) -> T:
    """Decode one checked message.

    :raises MalformedMessage: not JSON, not of the type the decoder wants, or refused by :func:`check_text` or
        :func:`check_keys`
    """
    check_text(data)
    try:
        message = decoder.decode(data)
    except FAULTS as error:
        raise malformed(error, decoder.type) from None
    check_keys(data)
    return message


FAULTS = (msgspec.DecodeError, RecursionError, ValueError)
"""What a decoder of msgspec raises on a text it can't read."""


def malformed(error: Exception, wanted: Any) -> MalformedMessage:
    """One of :data:`FAULTS` in words.

    :param wanted: the type the decoder was made for
    """
    if isinstance(error, msgspec.ValidationError):
        return MalformedMessage(_sentence(str(error), wanted))
    return MalformedMessage(f"the message is not JSON: {error}")


_ANY: msgspec.json.Decoder[Any] = msgspec.json.Decoder()


def decode_any(data: bytes) -> Any:
    """Decode a checked message without a schema; see :func:`decode`."""
    _check_longest_numbers(data)
    value = decode(_ANY, data)
    if len(data) >= _DIGITS_OF_DOUBLE:
        _check_long_numbers(data)
    return value


def recode(data: bytes) -> bytes:
    """Decode a text without a schema and encode it again: compact, and well-formed whatever came in.

    :raises MalformedMessage: as :func:`decode_any`
    """
    check_text(data)
    _check_longest_numbers(data)
    try:
        value = _ANY.decode(data)
    except FAULTS as error:
        raise malformed(error, Any) from None
    if len(data) >= _DIGITS_OF_DOUBLE:
        _check_long_numbers(data)
    text = encode(value)
    # What comes out of a dict has each key once; so has what went in, if it is the same.
    if text != data and not _keeps_colons(data, text):
        check_keys(data)
    return text


def in_range(data: bytes) -> bool:
    """Whether no number of a JSON text can be beyond any double, seen without reading it.

    Only a number that grows by its exponent can, or one with more digits than the largest double has. False says that
    the text has to be read to know: it may also be letters in a string that look so.

    :param data: JSON, but for the range of its numbers
    """
    return len(data) < _DIGITS_OF_DOUBLE and _LARGE_E not in data and _exponent(data) is None


def _check_longest_numbers(data: bytes) -> None:
    """Refuse a large text with numbers that take long to read, before it is decoded."""
    if json_cost.has_long_numbers(data):
        raise MalformedMessage(_OUT_OF_RANGE)


_OUT_OF_RANGE = "the message is not JSON: a number is out of range"


def _check_long_numbers(data: bytes) -> None:
    """Refuse JSON with a number that no double can hold: msgspec takes integers of any length."""
    if _LONG_RUN in data.translate(_ALL_DIGITS_ALIKE):
        json.loads(data, parse_int=_in_range, parse_float=_in_range)


def _in_range(digits: str) -> float:
    value = float(digits)
    if math.isinf(value):
        raise MalformedMessage(_OUT_OF_RANGE)
    return value


_DIGITS_OF_DOUBLE = 309
_LONG_RUN = b"0" * _DIGITS_OF_DOUBLE
_ALL_DIGITS_ALIKE = bytes.maketrans(b"123456789", b"000000000")


_LARGE_E = ord("E")
_exponent = re.compile(rb"e[+0-9]").search
"""A pattern that begins with one certain letter is searched for as fast as the letter."""


_UNKNOWN_OP = re.compile(r"Invalid value '(.*)' - at `\$\.op`\Z", re.DOTALL)


def _sentence(text: str, wanted: Any) -> str:
    unknown = _UNKNOWN_OP.match(text)
    if unknown is None:
        return text[:1].lower() + text[1:]
    op = unknown[1] if len(unknown[1]) <= 40 else unknown[1][:37] + "..."
    known = sorted(str(each.__struct_config__.tag) for each in get_args(wanted))
    if op in known:
        return "the message has 'op' twice"
    return f"unknown op '{op}'; known are {', '.join(known)}"


encode = msgspec.json.Encoder().encode
"""Any message struct or plain value to compact JSON bytes."""


# --- keys -------------------------------------------------------------------------------------------------

SHORT_BYTES = 2048
"""Length up to which a text is decoded and encoded again."""

_NOT_BRACES = bytes(byte for byte in range(256) if byte not in b"{}")
_OPENING, _CLOSING = ord("{"), ord("}")
_ESCAPED_COLON = b"\\u003"
"""How an escaped colon begins."""

_SPARSE = 64
"""Bytes per string from which on a search for quotation marks is faster than parsing."""

_SHOWN = 40
"""Characters of a key in an error message."""


def check_keys(data: bytes) -> None:
    """Refuse JSON in which an object has a key twice, also with different escapes.

    :param data: JSON that passed :func:`check_text`; ``NaN`` and ``Infinity`` are let through
    :raises MalformedMessage: the sentence names the key
    """
    if len(data) <= SHORT_BYTES:
        if _survives(data):
            return
    elif b"\\" not in data and _distinct_by_quotes(data):
        return
    try:
        json.loads(str(data, "utf-8"), strict=False, object_pairs_hook=_pairs, parse_int=len, parse_float=len)
    except ValueError as error:
        raise MalformedMessage(f"the message is not JSON: {error}") from None


def _survives(data: bytes) -> bool:
    """Whether no key is lost when the text is decoded and encoded again."""
    try:
        return _keeps_colons(data, encode(_ANY.decode(data)))
    except FAULTS:
        return False


def _keeps_colons(data: bytes, again: bytes) -> bool:
    """Whether a text that was decoded and encoded again still has all its colons.

    There is one for each key, and those in strings, which stay as they are. An escape may add one.
    """
    return _ESCAPED_COLON not in data and again.count(b":") == data.count(b":")


def _distinct_by_quotes(data: bytes) -> bool:
    """Whether each object is seen to have each key once; false also for a text of many strings.

    Long strings and long lists of numbers are skipped in C.

    :param data: JSON without a backslash
    """
    keys: set[bytes] = set()
    outer: list[set[bytes]] = []
    most = max(len(data) // _SPARSE, SHORT_BYTES)
    begun = at = 0
    for _ in range(most):
        start = data.find(b'"', at)
        between = data[at:start] if start >= 0 else data[at:]
        if at and (between[:1] == b":" or between.lstrip()[:1] == b":"):
            key = data[begun : at - 1]
            if key in keys:
                return False
            keys.add(key)
        if _OPENING in between or _CLOSING in between:
            for brace in between.translate(None, _NOT_BRACES):
                if brace == _OPENING:
                    outer.append(keys)
                    keys = set()
                elif not outer:
                    # No JSON; the parser names the fault.
                    return False
                else:
                    keys = outer.pop()
        if start < 0:
            return True
        begun = start + 1
        at = data.find(b'"', begun) + 1
    return False


def _pairs(pairs: list[tuple[str, Any]]) -> None:
    """Check one object; nothing of it is stored."""
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
