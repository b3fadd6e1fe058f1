"""Validates images of robots before browsers receive them (SPEC 2.6).

The whole structure is checked, but no pixels are decoded. The work is bounded: long parts are searched by compiled
code, and Python handles at most :data:`MAX_PARTS` parts.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable
from typing import NamedTuple

from relay_protocol import limits
from relay_protocol.errors import MalformedMessage

MAX_PARTS = 2048
"""Most segments of a JPEG, chunks of a PNG, units of H.264."""


class ImageInfo(NamedTuple):
    """Facts from the headers of an image.

    :param width: pixels; 0 for H.264, whose size is not read
    :param height: pixels; 0 for H.264
    :param key: whether it can be decoded without other frames
    """

    width: int
    height: int
    key: bool


def validate(codec: str, body: bytes) -> ImageInfo:
    """Check an image from its first byte to its last.

    :param codec: ``jpeg``, ``png`` or ``h264``
    :raises MalformedMessage: not such an image, incomplete, or with extra bytes before or after it
    """
    return _VALIDATORS[codec](body)


class _Size(NamedTuple):
    """Pixels."""

    width: int
    height: int


# --- JPEG (ITU-T T.81, annex B) ---------------------------------------------------------------------------

_SOI, _EOI, _SOS = 0xD8, 0xD9, 0xDA
_FRAMES = (0xC0, 0xC1, 0xC2)
"""Baseline, extended and progressive with Huffman coding: what every browser shows."""
_TABLES = (0xC4, 0xDB, 0xDD, 0xFE, *range(0xE0, 0xF0))
"""DHT, DQT, DRI, COM, APPn: passed over by their length."""

_NO_FILL = re.compile(rb"[^\xff]")
_END_OF_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
"""Within a scan 0xFF is followed by a zero, or is a restart marker, or fills."""


def _jpeg(body: bytes) -> ImageInfo:
    if body[:2] != bytes((0xFF, _SOI)):
        raise MalformedMessage("not a JPEG: the first bytes are wrong")
    size: _Size | None = None
    scans = 0
    at = 2
    for _ in range(MAX_PARTS):
        marker, at = _marker(body, at)
        if marker == _EOI:
            if not scans:
                raise MalformedMessage("the JPEG ends without an image")
            if at != len(body):
                raise MalformedMessage(f"{len(body) - at} bytes follow the end of the JPEG")
            assert size is not None
            return ImageInfo(width=size.width, height=size.height, key=True)
        segment = _segment(body, at)
        at += 2 + len(segment)
        if marker == _SOS:
            if size is None:
                raise MalformedMessage("a scan of the JPEG comes before its size")
            if not segment or len(segment) != 4 + 2 * segment[0]:
                raise MalformedMessage("a scan of the JPEG has a header of the wrong length")
            scans += 1
            found = _END_OF_SCAN.search(body, at)
            if found is None:
                raise MalformedMessage("the JPEG is incomplete: it ends inside a scan")
            at = found.start()
        elif marker in _FRAMES:
            if size is not None:
                raise MalformedMessage("the JPEG has two sizes")
            size = _frame(segment)
        elif marker not in _TABLES:
            raise MalformedMessage(f"browsers do not support marker {marker:#x} of the JPEG")
    raise MalformedMessage(f"the JPEG has more than {MAX_PARTS} parts")


def _marker(body: bytes, at: int) -> tuple[int, int]:
    """The marker that must be here, and where it ends; any number of 0xFF may fill before it."""
    found = _NO_FILL.search(body, at)
    if found is None:
        raise MalformedMessage("the JPEG is incomplete: it has no end marker")
    if found.start() == at:
        raise MalformedMessage("the JPEG has extra bytes between its parts")
    return body[found.start()], found.end()


def _segment(body: bytes, at: int) -> bytes:
    """What a marker's segment holds beside its own length."""
    length = int.from_bytes(body[at : at + 2], "big")
    if length < 2 or at + length > len(body):
        raise MalformedMessage("a part of the JPEG is longer than the file")
    return body[at + 2 : at + length]


def _frame(segment: bytes) -> _Size:
    if len(segment) < 6 or segment[5] not in (1, 3, 4) or len(segment) != 6 + 3 * segment[5]:
        raise MalformedMessage("the frame of the JPEG has an invalid header")
    return _Size(width=_side(segment[3:5]), height=_side(segment[1:3]))


# --- PNG (W3C, Portable Network Graphics) -----------------------------------------------------------------

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
"""Bits of a sample that may be, by colour type."""
_ANCILLARY = re.compile(rb"[a-z][A-Za-z][A-Z][A-Za-z]\Z")


def _png(body: bytes) -> ImageInfo:
    if body[:8] != _SIGNATURE:
        raise MalformedMessage("not a PNG: the first bytes are wrong")
    kind, content, at = _chunk(body, 8)
    if kind != b"IHDR":
        raise MalformedMessage("the PNG does not begin with its header")
    size, needs_palette = _header(content)
    before, palette, pixels = kind, False, 0
    for _ in range(MAX_PARTS):
        kind, content, at = _chunk(body, at)
        if kind == b"IEND":
            if content or not pixels:
                raise MalformedMessage("the PNG ends without an image")
            if at != len(body):
                raise MalformedMessage(f"{len(body) - at} bytes follow the end of the PNG")
            return ImageInfo(width=size.width, height=size.height, key=True)
        if kind == b"IDAT":
            if (pixels and before != kind) or (needs_palette and not palette):
                raise MalformedMessage("the pixels of the PNG are out of order")
            pixels += len(content)
        elif kind == b"PLTE":
            if palette or before == b"IDAT" or not content or len(content) % 3 or len(content) > 768:
                raise MalformedMessage("the palette of the PNG is invalid")
            palette = True
        elif not _ANCILLARY.match(kind):
            raise MalformedMessage("the PNG has a chunk of an unknown kind")
        before = kind
    raise MalformedMessage(f"the PNG has more than {MAX_PARTS} parts")


def _chunk(body: bytes, at: int) -> tuple[bytes, bytes, int]:
    """Kind and content of the chunk that must be here, and where it ends."""
    end = at + 12 + int.from_bytes(body[at : at + 4], "big")
    if end > len(body):
        raise MalformedMessage("the PNG is incomplete")
    if zlib.crc32(memoryview(body)[at + 4 : end - 4]) != int.from_bytes(body[end - 4 : end], "big"):
        raise MalformedMessage("a chunk of the PNG has a wrong checksum")
    return body[at + 4 : at + 8], body[at + 8 : end - 4], end


def _header(content: bytes) -> tuple[_Size, bool]:
    """The size, and whether the colours are those of a palette."""
    if len(content) != 13:
        raise MalformedMessage("the header of the PNG has a wrong length")
    depth, colour, compression, filters, interlace = content[8:]
    if depth not in _DEPTHS.get(colour, ()) or compression or filters or interlace > 1:
        raise MalformedMessage("the header of the PNG has invalid values")
    return _Size(width=_side(content[:4]), height=_side(content[4:8])), colour == 3


# --- H.264 (ITU-T H.264, section 7.3.1 and annex B) -------------------------------------------------------

_START_CODE = re.compile(rb"\x00\x00\x01")
_NEVER_INSIDE = re.compile(rb"\x00\x00[\x00\x02]")
_SLICE, _IDR, _SPS, _PPS = 1, 5, 7, 8
_UNITS = (_SLICE, _IDR, 6, _SPS, _PPS, 9, 12)
"""Slices, SEI, parameter sets, delimiter and filler."""


def _h264(body: bytes) -> ImageInfo:
    starts = []
    for found in _START_CODE.finditer(body):
        starts.append(found.start())
        if len(starts) > MAX_PARTS:
            raise MalformedMessage(f"the frame of H.264 has more than {MAX_PARTS} parts")
    if not starts or body[: starts[0]].strip(b"\x00") or starts[0] > 1:
        raise MalformedMessage("not H.264: the first bytes are wrong")
    kinds = {_unit(body[at + 3 : end]) for at, end in zip(starts, [*starts[1:], len(body)], strict=True)}
    if not kinds & {_SLICE, _IDR}:
        raise MalformedMessage("there is no frame in this H.264")
    return ImageInfo(width=0, height=0, key={_IDR, _SPS, _PPS} <= kinds)


def _unit(unit: bytes) -> int:
    """The kind of a unit; zeros at its end belong to the next start code."""
    content = unit.rstrip(b"\x00")
    if len(content) < 2 or content[0] & 0x80 or _NEVER_INSIDE.search(content):
        raise MalformedMessage("a unit of H.264 is invalid")
    kind = content[0] & 0x1F
    if kind not in _UNITS or (kind in (_IDR, _SPS, _PPS) and not content[0] & 0x60):
        raise MalformedMessage(f"a unit of H.264 has kind {kind}, which is not allowed here")
    return kind


def _side(data: bytes) -> int:
    """Pixels in a row or a column."""
    side = int.from_bytes(data, "big")
    if not 0 < side <= limits.IMAGE_SIDE:
        raise MalformedMessage(f"an image side of {side} pixels; a side has 1 to {limits.IMAGE_SIDE}")
    return side


_VALIDATORS: dict[str, Callable[[bytes], ImageInfo]] = {"jpeg": _jpeg, "png": _png, "h264": _h264}
