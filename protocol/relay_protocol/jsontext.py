"""Strict JSON at the edge: valid UTF-8, bounded depth, no NaN, and errors that name the fault.

msgspec skips values it does not need without looking into them: neither their UTF-8 nor their depth is checked
there. So the text is checked once, as a whole, before anything is decoded.
"""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec

from relay_protocol.errors import MalformedMessage
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
    # A text with fewer opening brackets than the limit can't be nested deeper: the usual case costs two counts.
    if data.count(b"[") + data.count(b"{") > depth and not _nests_within(data, depth):
        raise MalformedMessage(f"the message nests arrays and objects deeper than {depth}, or not in pairs")


def _nests_within(data: bytes, depth: int) -> bool:
    """Whether taking away the innermost pairs of brackets ``depth`` times leaves nothing (all of it in C)."""
    unescaped = data.replace(b"\\\\", b"").replace(b'\\"', b"")
    brackets = b"".join(unescaped.split(b'"')[::2]).translate(None, _NOT_BRACKETS)
    for _ in range(depth):
        if not brackets:
            break
        brackets = brackets.replace(b"[]", b"").replace(b"{}", b"")
    return not brackets


_NOT_BRACKETS = bytes(byte for byte in range(256) if byte not in b"[]{}")


def decode(decoder: msgspec.json.Decoder[T], data: bytes) -> T:
    """Decode one checked message.

    :raises MalformedMessage: not JSON, not of the type the decoder wants, or refused by :func:`check_text`
    """
    check_text(data)
    try:
        return decoder.decode(data)
    except msgspec.ValidationError as error:
        raise MalformedMessage(_sentence(error)) from None
    except (msgspec.DecodeError, RecursionError, ValueError) as error:
        raise MalformedMessage(f"the message is not JSON: {error}") from None


_ANY: msgspec.json.Decoder[Any] = msgspec.json.Decoder()


def decode_any(data: bytes) -> Any:
    """Decode a checked message without a schema; see :func:`decode`."""
    return decode(_ANY, data)


def _sentence(error: Exception) -> str:
    text = str(error)
    return text[:1].lower() + text[1:]


encode = msgspec.json.Encoder().encode
"""Any message struct or plain value to compact JSON bytes."""
