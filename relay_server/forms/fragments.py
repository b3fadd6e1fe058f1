"""Long text messages in fragments (rosbridge v2 protocol, section 3.1.1; SPEC section 1.6)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

from relay_protocol import jsontext

LEAST = 64
"""Smallest fragments a client can ask for, bytes of ``data``."""

MOST = 10_000
"""Fragments of one message; of a longer one they are larger than was asked for."""

_numbers = itertools.count(1)


def divide(message: bytes, size: int) -> list[bytes]:
    """The fragments of a message, or the message alone when it is short enough.

    :param message: JSON
    :param size: most bytes of ``data`` in UTF-8, before it is escaped; 0 for no fragments
    """
    if not size or len(message) <= size:
        return [message]
    parts = list(_parts(message, max(size, -(-len(message) // MOST) + 3)))
    head = b'{"op":"fragment","id":"%d","data":' % next(_numbers)
    total = len(parts)
    return [
        b'%s%s,"num":%d,"total":%d}' % (head, jsontext.encode(part.decode()), number, total)
        for number, part in enumerate(parts)
    ]


def _parts(message: bytes, size: int) -> Iterator[bytes]:
    start, end = 0, size
    while start < len(message):
        # Not in the midst of a character (RFC 3629: its further bytes begin with the bits 10).
        while end < len(message) and message[end] & 0xC0 == 0x80:
            end -= 1
        yield message[start:end]
        start, end = end, end + size
