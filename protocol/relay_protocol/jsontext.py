"""Strict JSON at the edge: valid UTF-8, bounded depth, no NaN, no key twice, and errors that name the fault.

msgspec skips values it does not need without looking into them: neither their UTF-8 nor their depth is
checked there. So the text is checked once, as a whole, before anything is decoded.
"""

from __future__ import annotations

import json
import math
import re
from itertools import accumulate
from typing import Any, TypeVar, get_args

import msgspec

from relay_protocol.errors import MalformedMessage
from relay_protocol.json_keys import check_keys
from relay_protocol.limits import JSON_DEPTH

T = TypeVar("T")


def check_text(data: bytes, depth: int = JSON_DEPTH) -> None:
    """Refuse bytes that are no sane JSON text.

    :param data: the whole message
    :param depth: deepest nesting allowed
    :raises MalformedMessage: invalid UTF-8 (RFC 8259 section 8.1) or nesting deeper than ``depth``
    """
    if not data.isascii():
        try:
            str(data, "utf-8")
        except UnicodeDecodeError as error:
            raise MalformedMessage(f"the message is not valid UTF-8 (byte {error.start})") from None
    # Fewer opening brackets than the limit can't be nested deeper: the usual case costs one count, and one search
    # (for a number, which is four times as fast as for bytes).
    opened = data.count(b"{")
    if _OPENING in data:
        opened += data.count(b"[")
    if opened > depth and _deepest(data) > depth:
        raise MalformedMessage(f"the message nests arrays and objects deeper than {depth}")


_OPENING = ord("[")


def _deepest(data: bytes) -> int:
    """Deepest nesting, by a running sum of brackets outside strings (all loops are in C)."""
    unescaped = data.replace(b"\\\\", b"").replace(b'\\"', b"")
    outside = b"".join(unescaped.split(b'"')[::2])
    steps = memoryview(outside.translate(_STEPS, _NOT_BRACKETS)).cast("b")
    return max(accumulate(steps), default=0)


_NOT_BRACKETS = bytes(byte for byte in range(256) if byte not in b"[]{}")
_STEPS = bytes.maketrans(b"[{]}", b"\x01\x01\xff\xff")


def decode(decoder: msgspec.json.Decoder[T], data: bytes) -> T:
    """Decode one checked message.

    :raises MalformedMessage: not JSON, not of the type the decoder wants, or refused by :func:`check_text` or
        :func:`relay_protocol.json_keys.check_keys`
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
    value = decode(_ANY, data)
    if len(data) >= _DIGITS_OF_DOUBLE and _LONG_RUN in data.translate(_ALL_DIGITS_ALIKE):
        _check_range(data)
    return value


def in_range(data: bytes) -> bool:
    """Whether no number of a JSON text can be beyond any double, seen without reading it.

    Only a number that grows by its exponent can, or one with more digits than the largest double has. False says that
    the text has to be read to know: it may also be letters in a string that look so.

    :param data: JSON, but for the range of its numbers
    """
    return len(data) < _DIGITS_OF_DOUBLE and _LARGE_E not in data and _exponent(data) is None


def _check_range(data: bytes) -> None:
    """Refuse JSON with a number that no double can hold: msgspec takes integers of any length."""
    json.loads(data, parse_int=_in_range, parse_float=_in_range)


def _in_range(digits: str) -> float:
    value = float(digits)
    if math.isinf(value):
        raise MalformedMessage("the message is not JSON: a number is out of range")
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
