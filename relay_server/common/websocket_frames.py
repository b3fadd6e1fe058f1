"""Websocket messages as the relay sends them: unmasked, whole in one frame (RFC 6455 section 5.2), or in several frames
on a connection that is too thin for them (section 5.4).

A message that goes to many clients is framed once. What a session hands to its transport are frames, so that edges
need not look at them again.
"""

from __future__ import annotations

import struct

TEXT = 0x81
BINARY = 0x82
PING = 0x89
FIN = 0x80

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


class Fragments:
    """Whole messages, taken piece by piece. Only control frames may be sent between two pieces (section 5.4).

    :param frames: one or more messages, each whole in one frame
    """

    __slots__ = ("_at", "_frames", "_left", "_opcode")

    divided = command = False

    def __init__(self, frames: bytes) -> None:
        self._frames = memoryview(frames)
        self._at = 0
        self._left = 0
        """Bytes of the payload of the message that was begun."""
        self._opcode = 0

    @property
    def left(self) -> int:
        """Bytes that have not been taken, without the heads of further frames."""
        return len(self._frames) - self._at

    def take(self, most: int) -> bytes:
        """The next frame.

        :param most: bytes of its payload, at least one
        """
        if not self._left:
            first, length, start = _parse(self._frames, self._at)
            if length <= most:
                begun, self._at = self._at, start + length
                return bytes(self._frames[begun : self._at])
            self._opcode, self._left, self._at = first & 15, length, start
        size = min(self._left, most)
        self._left -= size
        first, self._opcode = self._opcode | (0 if self._left else FIN), 0
        begun, self._at = self._at, self._at + size
        return _head(first, size) + self._frames[begun : self._at]


def _parse(frames: memoryview, at: int) -> tuple[int, int, int]:
    """First byte, length of the payload and its place."""
    first, length = frames[at], frames[at + 1]
    if length < 126:
        return first, length, at + 2
    end = at + (4 if length == 126 else 10)
    return first, int.from_bytes(frames[at + 2 : end], "big"), end
