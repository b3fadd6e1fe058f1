"""Websocket messages as the relay sends them: whole, unmasked, in one frame (RFC 6455 section 5.2).

A message that goes to many clients is framed once. What a session hands to its transport are frames, so that edges
need not look at them again.
"""

from __future__ import annotations

import struct

TEXT = 0x81
BINARY = 0x82
PING = 0x89

_SHORT = struct.Struct("!BB")
_MEDIUM = struct.Struct("!BBH")
_LONG = struct.Struct("!BBQ")


def text(payload: bytes) -> bytes:
    """The frame of one text message.

    :param payload: UTF-8
    """
    return _head(TEXT, len(payload)) + payload


def text_of(head: bytes, body: bytes, tail: bytes) -> bytes:
    """The frame of one text message that is made of three pieces: what is long is copied once only."""
    return b"".join((_head(TEXT, len(head) + len(body) + len(tail)), head, body, tail))


def binary(payload: bytes) -> bytes:
    """The frame of one binary message."""
    return _head(BINARY, len(payload)) + payload


def ping(payload: bytes) -> bytes:
    """The frame of a ping.

    :param payload: at most 125 bytes (section 5.5)
    """
    return _SHORT.pack(PING, len(payload)) + payload


def _head(first: int, length: int) -> bytes:
    if length < 126:
        return _SHORT.pack(first, length)
    if length < 65536:
        return _MEDIUM.pack(first, 126, length)
    return _LONG.pack(first, 127, length)
