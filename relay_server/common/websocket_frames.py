"""Websocket messages of the relay: unmasked, whole in one frame (RFC 6455 section 5.2), or in several frames on a slow
connection (section 5.4). Frames that it forwards for a client are masked (section 5.3).

A message for many clients is framed once: sessions give whole frames to their transports.
"""

from __future__ import annotations

import struct

try:
    from websockets.speedups import apply_mask as apply_mask
except ImportError:  # no wheel for this platform: right, but slow
    from websockets.utils import apply_mask as apply_mask


TEXT = 0x81
BINARY = 0x82
CLOSE = 0x88
PING = 0x89
PONG = 0x8A
FIN = 0x80

_MASKED = 0x80
_NO_MASK = bytes(4)
_SHORT = struct.Struct("!BB")
_MEDIUM = struct.Struct("!BBH")
_LONG = struct.Struct("!BBQ")


def text(payload: bytes) -> bytes:
    """The frame of one text message.

    :param payload: UTF-8
    """
    return _head(TEXT, len(payload)) + payload


def text_of(head: bytes, body: bytes, tail: bytes) -> bytes:
    """The frame of one text message made of three pieces; long pieces are copied only once."""
    length = len(head) + len(body) + len(tail)
    first = _MEDIUM.pack(TEXT, 126, length) if 126 <= length < 65536 else _head(TEXT, length)
    return b"".join((first, head, body, tail))


def binary(payload: bytes) -> bytes:
    """The frame of one binary message."""
    return _head(BINARY, len(payload)) + payload


def binary_of(head: bytes, body: bytes) -> bytes:
    """The frame of one binary message made of two pieces; a long body is copied only once."""
    return b"".join((_head(BINARY, len(head) + len(body)), head, body))


def ping(payload: bytes) -> bytes:
    """The frame of a ping.

    :param payload: at most 125 bytes (section 5.5)
    """
    return _SHORT.pack(PING, len(payload)) + payload


def masked(first: int, payload: bytes) -> bytes:
    """A frame as a client sends it, for another relay.

    The mask is zero. Masks protect caches and proxies from what pages choose (RFC 6455 section 10.3), and there are
    none between relays.

    :param first: its first byte, such as :data:`TEXT`
    """
    return _head(first, len(payload), _MASKED) + _NO_MASK + payload


def _head(first: int, length: int, bit: int = 0) -> bytes:
    if length < 126:
        return _SHORT.pack(first, bit | length)
    if length < 65536:
        return _MEDIUM.pack(first, bit | 126, length)
    return _LONG.pack(first, bit | 127, length)


class Fragments:
    """Whole messages, sent in pieces. Only control frames may be sent between two pieces (section 5.4).

    :param frames: one or more messages, each whole in one frame
    """

    __slots__ = ("_at", "_frames", "_left", "_opcode")

    divided = command = False

    def __init__(self, frames: bytes) -> None:
        self._frames = memoryview(frames)
        self._at = 0
        self._left = 0
        """Bytes left of the payload of the message that was begun."""
        self._opcode = 0

    @property
    def left(self) -> int:
        """Bytes that are left, without the headers of further frames."""
        return len(self._frames) - self._at

    @property
    def begun(self) -> int:
        """Bytes that are left of a message of which a part was taken; while there are any, no other may be sent."""
        return self._left

    def take(self, most: int) -> bytes:
        """The next frame.

        :param most: most bytes of its payload, at least one
        """
        if not self._left:
            parsed = parse_head(self._frames, self._at)
            assert parsed is not None
            first, length, start = parsed
            if length <= most:
                begun, self._at = self._at, start + length
                return bytes(self._frames[begun : self._at])
            self._opcode, self._left, self._at = first & 15, length, start
        size = min(self._left, most)
        self._left -= size
        first, self._opcode = self._opcode | (0 if self._left else FIN), 0
        begun, self._at = self._at, self._at + size
        return _head(first, size) + self._frames[begun : self._at]


def parse_head(frames: bytes | memoryview, at: int) -> tuple[int, int, int] | None:
    """First byte of an unmasked frame, length of its payload, and where the payload starts.

    :returns: ``None`` if the head of the frame is incomplete
    """
    if len(frames) - at < 2:
        return None
    first, length = frames[at], frames[at + 1]
    if length < 126:
        return first, length, at + 2
    end = at + (4 if length == 126 else 10)
    if end > len(frames):
        return None
    return first, int.from_bytes(frames[at + 2 : end], "big"), end
