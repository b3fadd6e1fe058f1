"""Pictures looked at from the first byte to the last, because browsers get what robots send (SPEC section 2.6).

Only the structure is looked at, never the pixels. Whatever a robot sends, the work is bounded: what is long is
searched by compiled code, and of what Python counts there may be :data:`PARTS`.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable
from typing import NamedTuple

from relay_protocol import limits
from relay_protocol.errors import MalformedMessage

PARTS = 2048
"""Most segments of a JPEG, chunks of a PNG, units of H.264."""


class Seen(NamedTuple):
    """What a picture says of itself.

    :param width: pixels; 0 for H.264, which is not read so far
    :param height: pixels, like ``width``
    :param key: whether it stands alone
    """

    width: int
    height: int
    key: bool


def look_at(codec: str, body: bytes) -> Seen:
    """Look at a picture, the whole of it.

    :param codec: ``jpeg``, ``png`` or ``h264``
    :raises MalformedMessage: it is none, or there is something before, after or missing
    """
    return _LOOKS[codec](body)


# --- JPEG (ITU-T T.81, annex B) ---------------------------------------------------------------------------

_SOI, _EOI, _SOS = 0xD8, 0xD9, 0xDA
_FRAMES = (0xC0, 0xC1, 0xC2)
"""Baseline, extended and progressive with Huffman coding: what every browser shows."""
_TABLES = (0xC4, 0xDB, 0xDD, 0xFE, *range(0xE0, 0xF0))
"""DHT, DQT, DRI, COM, APPn: passed over by their length."""

_NO_FILL = re.compile(rb"[^\xff]")
_END_OF_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
"""Within a scan 0xFF is followed by a zero, or is a restart marker, or fills."""


def _jpeg(body: bytes) -> Seen:
    if body[:2] != bytes((0xFF, _SOI)):
        raise MalformedMessage("this is no JPEG: it does not begin like one")
    size: tuple[int, int] | None = None
    scans = 0
    at = 2
    for _ in range(PARTS):
        marker, at = _marker(body, at)
        if marker == _EOI:
            if not scans:
                raise MalformedMessage("this JPEG ends before it has shown anything")
            if at != len(body):
                raise MalformedMessage(f"{len(body) - at} bytes come after the end of a JPEG")
            assert size is not None
            return Seen(*size, True)
        segment = _segment(body, at)
        at += 2 + len(segment)
        if marker == _SOS:
            if size is None:
                raise MalformedMessage("a scan of a JPEG comes before its size is told")
            if not segment or len(segment) != 4 + 2 * segment[0]:
                raise MalformedMessage("a scan of a JPEG has a head of the wrong length")
            scans += 1
            found = _END_OF_SCAN.search(body, at)
            if found is None:
                raise MalformedMessage("a JPEG breaks off in the middle")
            at = found.start()
        elif marker in _FRAMES:
            if size is not None:
                raise MalformedMessage("a JPEG tells its size twice")
            size = _frame(segment)
        elif marker not in _TABLES:
            raise MalformedMessage(f"a JPEG with marker {marker:#x} is not what browsers show")
    raise MalformedMessage(f"a JPEG has more than {PARTS} parts")


def _marker(body: bytes, at: int) -> tuple[int, int]:
    """The marker that must be here, and where it ends; any number of 0xFF may fill before it."""
    found = _NO_FILL.search(body, at)
    if found is None:
        raise MalformedMessage("a JPEG breaks off before its end")
    if found.start() == at:
        raise MalformedMessage("a JPEG has something between its parts")
    return body[found.start()], found.end()


def _segment(body: bytes, at: int) -> bytes:
    """What a marker's segment holds beside its own length."""
    length = int.from_bytes(body[at : at + 2], "big")
    if length < 2 or at + length > len(body):
        raise MalformedMessage("a part of a JPEG is longer than what there is")
    return body[at + 2 : at + length]


def _frame(segment: bytes) -> tuple[int, int]:
    """Width and height."""
    if len(segment) < 6 or segment[5] not in (1, 3, 4) or len(segment) != 6 + 3 * segment[5]:
        raise MalformedMessage("the frame of a JPEG has a head that can't be")
    return _side(segment[3:5]), _side(segment[1:3])


# --- PNG (W3C, Portable Network Graphics) -----------------------------------------------------------------

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
"""Bits of a sample that may be, by colour type."""
_ANCILLARY = re.compile(rb"[a-z][A-Za-z][A-Z][A-Za-z]\Z")


def _png(body: bytes) -> Seen:
    if body[:8] != _SIGNATURE:
        raise MalformedMessage("this is no PNG: it does not begin like one")
    kind, content, at = _chunk(body, 8)
    if kind != b"IHDR":
        raise MalformedMessage("a PNG does not begin with its head")
    size, needs_palette = _head(content)
    before, palette, pixels = kind, False, 0
    for _ in range(PARTS):
        kind, content, at = _chunk(body, at)
        if kind == b"IEND":
            if content or not pixels:
                raise MalformedMessage("a PNG ends before it has shown anything")
            if at != len(body):
                raise MalformedMessage(f"{len(body) - at} bytes come after the end of a PNG")
            return Seen(*size, True)
        if kind == b"IDAT":
            if (pixels and before != kind) or (needs_palette and not palette):
                raise MalformedMessage("the pixels of a PNG are out of order")
            pixels += len(content)
        elif kind == b"PLTE":
            if palette or before == b"IDAT" or not content or len(content) % 3 or len(content) > 768:
                raise MalformedMessage("the palette of a PNG can't be")
            palette = True
        elif not _ANCILLARY.match(kind):
            raise MalformedMessage("a PNG has a part that no PNG has")
        before = kind
    raise MalformedMessage(f"a PNG has more than {PARTS} parts")


def _chunk(body: bytes, at: int) -> tuple[bytes, bytes, int]:
    """Kind and content of the chunk that must be here, and where it ends."""
    end = at + 12 + int.from_bytes(body[at : at + 4], "big")
    if end > len(body):
        raise MalformedMessage("a PNG breaks off before its end")
    if zlib.crc32(memoryview(body)[at + 4 : end - 4]) != int.from_bytes(body[end - 4 : end], "big"):
        raise MalformedMessage("a part of a PNG is damaged")
    return body[at + 4 : at + 8], body[at + 8 : end - 4], end


def _head(content: bytes) -> tuple[tuple[int, int], bool]:
    """Width and height, and whether the colours are those of a palette."""
    if len(content) != 13:
        raise MalformedMessage("the head of a PNG has a length that can't be")
    depth, colour, compression, filters, interlace = content[8:]
    if depth not in _DEPTHS.get(colour, ()) or compression or filters or interlace > 1:
        raise MalformedMessage("the head of a PNG says what can't be")
    return (_side(content[:4]), _side(content[4:8])), colour == 3


# --- H.264 (ITU-T H.264, section 7.3.1 and annex B) -------------------------------------------------------

_START_CODE = re.compile(rb"\x00\x00\x01")
_NEVER_INSIDE = re.compile(rb"\x00\x00[\x00\x02]")
_SLICE, _IDR, _SPS, _PPS = 1, 5, 7, 8
_UNITS = (_SLICE, _IDR, 6, _SPS, _PPS, 9, 12)
"""Slices, SEI, parameter sets, delimiter, filler: what an encoder of single pictures makes."""


def _h264(body: bytes) -> Seen:
    starts = []
    for found in _START_CODE.finditer(body):
        starts.append(found.start())
        if len(starts) > PARTS:
            raise MalformedMessage(f"a picture of H.264 has more than {PARTS} parts")
    if not starts or body[: starts[0]].strip(b"\x00") or starts[0] > 1:
        raise MalformedMessage("this is no H.264: it does not begin like it")
    kinds = {_unit(body[at + 3 : end]) for at, end in zip(starts, [*starts[1:], len(body)], strict=True)}
    if not kinds & {_SLICE, _IDR}:
        raise MalformedMessage("there is no picture in this H.264")
    return Seen(0, 0, {_IDR, _SPS, _PPS} <= kinds)


def _unit(unit: bytes) -> int:
    """The kind of a unit; zeros at its end belong to the next start code."""
    content = unit.rstrip(b"\x00")
    if len(content) < 2 or content[0] & 0x80 or _NEVER_INSIDE.search(content):
        raise MalformedMessage("a part of H.264 can't be")
    kind = content[0] & 0x1F
    if kind not in _UNITS or (kind in (_IDR, _SPS, _PPS) and not content[0] & 0x60):
        raise MalformedMessage(f"a part of H.264 is of a kind ({kind}) that has no place here")
    return kind


def _side(data: bytes) -> int:
    """Pixels in a row or a column."""
    side = int.from_bytes(data, "big")
    if not 0 < side <= limits.PICTURE_SIDE:
        raise MalformedMessage(f"a picture of {side} pixels; a side has 1 to {limits.PICTURE_SIDE}")
    return side


_LOOKS: dict[str, Callable[[bytes], Seen]] = {"jpeg": _jpeg, "png": _png, "h264": _h264}
