"""Messages in PNG, as rosbridge does it: the pixels are the bytes of the JSON (SPEC section 1.6)."""

from __future__ import annotations

import io
import math
from json.encoder import encode_basestring_ascii

import pybase64

from relay_protocol.limits import KIB

MOST = 512 * KIB
"""Largest JSON that is made a PNG, bytes. It takes 20 to 40 ms a megabyte, in which the relay does nothing else."""

LEVEL = 1
"""Of deflate. Level 6 takes up to twice the time of level 1 and saves less than a tenth of the bytes."""


def encode(message: bytes) -> bytes:
    """The ``png`` operation that carries a message.

    :param message: JSON, not empty
    """
    return b'{"op":"png","data":"' + pybase64.b64encode(picture(message)) + b'"}'


def picture(message: bytes) -> bytes:
    """A PNG, 8-bit RGB, about as wide as high; what is over is line feeds."""
    # Only who asks for PNG pays for the library.
    from PIL import Image

    text = message if message.isascii() else _escaped(message)
    width = max(1, math.isqrt(len(text) // 3))
    height = math.ceil(len(text) / (3 * width))
    image = Image.frombytes("RGB", (width, height), text.ljust(3 * width * height, b"\n"))
    out = io.BytesIO()
    image.save(out, "PNG", compress_level=LEVEL)
    return out.getvalue()


def _escaped(message: bytes) -> bytes:
    """The same JSON in ASCII: in browsers roslib 1.x takes each byte for a character."""
    # In one go, a hundred times as fast as character by character. This also escapes quotes, backslashes and the
    # white space between values, which is taken back. Each backslash came out as two, so no pair is parted here.
    parts = encode_basestring_ascii(message.decode())[1:-1].split("\\\\")
    for escaped, plain in (('\\"', '"'), ("\\n", "\n"), ("\\r", "\r"), ("\\t", "\t")):
        parts = [part.replace(escaped, plain) for part in parts]
    return "\\".join(parts).encode()
