"""Pictures that are files already, JPEG, PNG and WebP: which of them, how large, where they end."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Literal

from relay_protocol.errors import Invalid
from robot_client.camera.messages import Damaged, check_size

Kind = Literal["jpeg", "png", "webp"]

_BEGINNINGS: dict[bytes, Kind] = {b"\xff\xd8\xff": "jpeg", b"\x89PNG\r\n\x1a\n": "png"}
_RIFF, _WEBP = b"RIFF", b"WEBP"
"""How a WebP begins (RFC 9649, 2.4): between both stands its length."""
_ENDS: dict[Kind, bytes] = {"jpeg": b"\xff\xd9", "png": b"\0\0\0\0IEND\xaeB`\x82"}

_SIDES = struct.Struct(">HH").unpack_from
_LENGTH = struct.Struct(">H").unpack_from
_IHDR = struct.Struct(">8xI4sII").unpack_from
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""JPEG markers that begin a frame, and so tell its size (T.81, table B.1)."""
_BARE = frozenset({0x01, *range(0xD0, 0xD8)})
"""JPEG markers without a length."""
_DATA = (0x00, 0xD9, 0xDA)
"""JPEG markers after which no size comes: end, start of scan; and what is none, behind which decoders look for the next
one where we would not."""
_LOSSLESS, _LOSSY = 0x2F, b"\x9d\x01\x2a"
"""By which the two forms of a WebP's picture begin; of the second behind three bytes."""
_PARTS = 2048
"""Most markers and bytes of filling before the size; a file of nothing else would keep the process busy for long."""


def kind_of(file: bytes, start: int = 0) -> Kind:
    """What a file is, by its first bytes: what publishers say of it is often wrong.

    :param start: where in ``file`` it begins
    :raises Invalid: none of these
    """
    if file.startswith(_RIFF, start) and file.startswith(_WEBP, start + 8):
        return "webp"
    for beginning, kind in _BEGINNINGS.items():
        if file.startswith(beginning, start):
            return kind
    raise Invalid("the file is no JPEG, PNG or WebP")


def end_of(file: bytes, start: int, stop: int, kind: Kind) -> int:
    """Where the picture ends; cameras that give JPEG pad it with what fills their buffers.

    :raises Damaged: it ends in the middle
    """
    if kind == "webp":
        length = 8 + int.from_bytes(file[start + 4 : start + 8], "little")
        if length > stop - start:
            raise Damaged("the WebP ends in the middle")
        return start + length
    end = _ENDS[kind]
    last = file.rfind(end, start, stop)
    if last < 0:
        raise Damaged(f"the {kind.upper()} ends in the middle")
    return last + len(end)


def size_of(file: bytes, kind: Kind) -> tuple[int, int]:
    """Width and height in pixels, read from the head alone.

    :raises Invalid: there is no size, or one that can't be shown
    """
    width, height = _SIZES[kind](file)
    check_size(width, height)
    return width, height


def is_grey_of_sixteen_bits(file: bytes) -> bool:
    """Whether a PNG has one value of sixteen bits for each pixel (W3C, Portable Network Graphics, 11.2.1)."""
    return file[24:26] == b"\x10\x00"


def _png_size(file: bytes) -> tuple[int, int]:
    if len(file) < 24:
        raise Damaged("the PNG ends in the middle")
    _, name, width, height = _IHDR(file)
    if name != b"IHDR":
        raise Damaged("the PNG has no head")
    return width, height


def _webp_size(file: bytes) -> tuple[int, int]:
    """Of the canvas, or of the only picture (RFC 9649, 2.5 to 2.7; of its lossy form RFC 6386, 9.1)."""
    kind, head = file[12:16], file[20:30]
    if len(head) < 10:
        raise Damaged("the WebP ends in the middle")
    if kind == b"VP8X":
        return 1 + int.from_bytes(head[4:7], "little"), 1 + int.from_bytes(head[7:10], "little")
    if kind == b"VP8L" and head[0] == _LOSSLESS:
        sides = int.from_bytes(head[1:5], "little")
        return 1 + (sides & 0x3FFF), 1 + (sides >> 14 & 0x3FFF)
    if kind == b"VP8 " and head[3:6] == _LOSSY:
        return int.from_bytes(head[6:8], "little") & 0x3FFF, int.from_bytes(head[8:10], "little") & 0x3FFF
    raise Damaged("the WebP has no head")


def _jpeg_size(file: bytes) -> tuple[int, int]:
    """Go from segment to segment until one tells the size (T.81, B.1.1)."""
    at = 2
    for _ in range(_PARTS):
        if at + 9 > len(file) or file[at] != 0xFF:
            break
        marker = file[at + 1]
        if marker in _FRAMES:
            height, width = _SIDES(file, at + 5)
            return width, height
        if marker in _DATA:
            break
        if marker == 0xFF:
            at += 1
        elif marker in _BARE:
            at += 2
        else:
            at += 2 + max(2, _LENGTH(file, at + 2)[0])
    raise Damaged("the JPEG tells no size")


_SIZES: dict[Kind, Callable[[bytes], tuple[int, int]]] = {
    "jpeg": _jpeg_size,
    "png": _png_size,
    "webp": _webp_size,
}
