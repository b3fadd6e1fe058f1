"""Pictures that are files already, JPEG and PNG: which of them, how large, where they end."""

from __future__ import annotations

import struct
from typing import Literal

from relay_protocol.errors import Invalid
from robot_client.camera.messages import Damaged, check_size

Kind = Literal["jpeg", "png"]

_BEGINNINGS: dict[bytes, Kind] = {b"\xff\xd8\xff": "jpeg", b"\x89PNG\r\n\x1a\n": "png"}
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
_PARTS = 2048
"""Most markers and bytes of filling before the size; a file of nothing else would keep the process busy for long."""


def kind_of(file: bytes, start: int = 0) -> Kind:
    """What a file is, by its first bytes: what publishers say of it is often wrong.

    :param start: where in ``file`` it begins
    :raises Invalid: neither JPEG nor PNG
    """
    for beginning, kind in _BEGINNINGS.items():
        if file.startswith(beginning, start):
            return kind
    raise Invalid("the file is neither JPEG nor PNG")


def end_of(file: bytes, start: int, stop: int, kind: Kind) -> int:
    """Where the picture ends; cameras that give JPEG pad it with what fills their buffers.

    :raises Damaged: it ends in the middle
    """
    end = _ENDS[kind]
    last = file.rfind(end, start, stop)
    if last < 0:
        raise Damaged(f"the {kind.upper()} ends in the middle")
    return last + len(end)


def size_of(file: bytes, kind: Kind) -> tuple[int, int]:
    """Width and height in pixels, read from the head alone.

    :raises Invalid: there is no size, or one that can't be shown
    """
    width, height = _png_size(file) if kind == "png" else _jpeg_size(file)
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
