"""Images as they arrive, read without decoding a pixel: ROS messages from CDR, and JPEG, PNG and WebP files.

Every length is checked against the bytes there are before it is used. No ROS, numpy or OpenCV is imported
here. Sources: OMG DDSI-RTPS 2.5, 10 (encapsulation), DDS-XTypes 1.3, 7.4.3 (plain CDR); JPEG: ITU-T T.81;
PNG: W3C, Portable Network Graphics; WebP: RFC 9649, RFC 6386; Exif 2.32.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Literal, NamedTuple

from relay_protocol.errors import Invalid
from relay_protocol.limits import IMAGE_SIDE, LABEL_LENGTH


class DamagedImage(Invalid):
    """This image is broken; the camera's next one may be good."""


def check_size(width: int, height: int) -> None:
    """Check that an image has pixels, and no more than can be sent.

    :param width: pixels
    :param height: pixels
    :raises Invalid: names the size
    """
    if not (0 < width <= IMAGE_SIDE and 0 < height <= IMAGE_SIDE):
        raise Invalid(
            f"an image of {width}×{height} pixels can't be shown; each side may have 1 to {IMAGE_SIDE}"
        )


# --- ROS messages ------------------------------------------------------------------------------------------

_BYTE_ORDERS = {b"\x00\x01": struct.Struct("<I"), b"\x00\x00": struct.Struct(">I")}
_ENCAPSULATION = 4
"""Bytes of the encapsulation header; alignment counts from its end."""


class ImageMessage(NamedTuple):
    """A sensor_msgs/msg/Image.

    :param big_endian: byte order of the pixels, not of the message
    :param step: bytes from one row to the next
    """

    encoding: str
    width: int
    height: int
    big_endian: bool
    step: int
    pixels: memoryview


class CompressedMessage(NamedTuple):
    """A sensor_msgs/msg/CompressedImage.

    :param start: index in the message of the file's first byte
    :param stop: index after its last byte
    """

    format: str
    start: int
    stop: int


def read_image(cdr: bytes) -> ImageMessage:
    """Parse an Image. Whether it has enough bytes for its size is not checked.

    :raises Invalid: the bytes are no such message, or the size is 0 or too large
    """
    reader = _CdrReader(cdr)
    reader.skip_header()
    height, width = reader.u32(), reader.u32()
    encoding = reader.text("encoding")
    big_endian, step = reader.u8() != 0, reader.u32()
    start, stop = reader.octets()
    check_size(width, height)
    return ImageMessage(encoding, width, height, big_endian, step, memoryview(cdr)[start:stop])


def read_compressed(cdr: bytes) -> CompressedMessage:
    """Parse a CompressedImage.

    :raises Invalid: the bytes are no such message
    """
    reader = _CdrReader(cdr)
    reader.skip_header()
    format = reader.text("format")
    start, stop = reader.octets()
    return CompressedMessage(format, start, stop)


class _CdrReader:
    def __init__(self, cdr: bytes) -> None:
        if len(cdr) < _ENCAPSULATION:
            raise DamagedImage(f"{len(cdr)} bytes are too short for a CDR message")
        order = _BYTE_ORDERS.get(cdr[:2])
        if order is None:
            raise Invalid(f"bytes 0 and 1 are {cdr[:2].hex()}; plain CDR has 0001 or 0000")
        self._u32 = order.unpack_from
        self._cdr = cdr
        self._at = _ENCAPSULATION

    def skip_header(self) -> None:
        self._take(8, "stamp")
        self._take(self.u32(), "frame_id")

    def u8(self) -> int:
        return self._cdr[self._take(1, "is_bigendian")]

    def u32(self) -> int:
        self._at += -self._at % 4
        value: int = self._u32(self._cdr, self._take(4, "a number"))[0]
        return value

    def text(self, field: str) -> str:
        """A string of printable ASCII, at most :data:`LABEL_LENGTH` bytes."""
        length = self.u32()
        start = self._take(length, field)
        if length > LABEL_LENGTH:
            raise Invalid(f"{field} has {length} bytes; the most is {LABEL_LENGTH}")
        text = self._cdr[start : start + length].rstrip(b"\0").decode("latin-1")
        if not (text.isascii() and text.isprintable()):
            raise Invalid(f"{field} is not printable ASCII")
        return text

    def octets(self) -> tuple[int, int]:
        """Start and stop of a ``uint8[]``."""
        length = self.u32()
        start = self._take(length, "data")
        return start, start + length

    def _take(self, length: int, field: str) -> int:
        start = self._at
        if length > len(self._cdr) - start:
            left = max(0, len(self._cdr) - start)
            raise DamagedImage(f"the message is cut off: {field} has {length} bytes, {left} are left")
        self._at = start + length
        return start


# --- files -------------------------------------------------------------------------------------------------

Kind = Literal["jpeg", "png", "webp"]

_SIGNATURES: dict[bytes, Kind] = {b"\xff\xd8\xff": "jpeg", b"\x89PNG\r\n\x1a\n": "png"}
_RIFF, _WEBP = b"RIFF", b"WEBP"
"""Signature of WebP (RFC 9649, 2.4); between the two is the file's length."""
_ENDS: dict[Kind, bytes] = {"jpeg": b"\xff\xd9", "png": b"\0\0\0\0IEND\xaeB`\x82"}

_SIDES = struct.Struct(">HH").unpack_from
_LENGTH = struct.Struct(">H").unpack_from
_IHDR = struct.Struct(">8xI4sII").unpack_from
_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""JPEG markers of frame headers, which hold the size (T.81, table B.1)."""
_BARE_MARKERS = frozenset({0x01, *range(0xD0, 0xD8)})
"""JPEG markers without a length."""
_FINAL_MARKERS = (0x00, 0xD9, 0xDA)
"""JPEG markers after which no size follows: end, start of scan, and 0, which is no marker: decoders search
for the next one differently."""
_LOSSLESS, _LOSSY = 0x2F, b"\x9d\x01\x2a"
"""Signatures of the two WebP formats; that of the second follows three bytes."""
_MAX_SEGMENTS = 2048
"""Most markers and fill bytes before the size: a file of nothing else would keep the process busy for
long."""


def kind_of(file: bytes, start: int = 0) -> Kind:
    """Kind of a file by its first bytes; what publishers say is often wrong.

    :param start: index of its first byte
    :raises Invalid: it is none of these
    """
    if file.startswith(_RIFF, start) and file.startswith(_WEBP, start + 8):
        return "webp"
    for signature, kind in _SIGNATURES.items():
        if file.startswith(signature, start):
            return kind
    raise Invalid("the file is no JPEG, PNG or WebP")


def end_of(file: bytes, start: int, stop: int, kind: Kind) -> int:
    """Index after the last byte of the image; some cameras pad JPEG to the size of their buffers.

    :raises DamagedImage: the file is cut off
    """
    if kind == "webp":
        length = 8 + int.from_bytes(file[start + 4 : start + 8], "little")
        if length > stop - start:
            raise DamagedImage("the WebP is cut off")
        return start + length
    end = _ENDS[kind]
    last = file.rfind(end, start, stop)
    if last < 0:
        raise DamagedImage(f"the {kind.upper()} is cut off")
    return last + len(end)


def size_of(file: bytes, kind: Kind) -> tuple[int, int]:
    """Width and height in pixels, from the file's header.

    :raises Invalid: there is no size, or it can't be shown
    """
    width, height = _SIZES[kind](file)
    check_size(width, height)
    return width, height


def is_16_bit_grey(file: bytes) -> bool:
    """Whether a PNG has one 16-bit value for each pixel (W3C, Portable Network Graphics, 11.2.1)."""
    return file[24:26] == b"\x10\x00"


def _png_size(file: bytes) -> tuple[int, int]:
    if len(file) < 24:
        raise DamagedImage("the PNG is cut off")
    _, name, width, height = _IHDR(file)
    if name != b"IHDR":
        raise DamagedImage("the PNG has no header")
    return width, height


def _webp_size(file: bytes) -> tuple[int, int]:
    """Of the canvas, or of the only image (RFC 9649, 2.5 to 2.7; the lossy format: RFC 6386, 9.1)."""
    kind, header = file[12:16], file[20:30]
    if len(header) < 10:
        raise DamagedImage("the WebP is cut off")
    if kind == b"VP8X":
        return 1 + int.from_bytes(header[4:7], "little"), 1 + int.from_bytes(header[7:10], "little")
    if kind == b"VP8L" and header[0] == _LOSSLESS:
        sides = int.from_bytes(header[1:5], "little")
        return 1 + (sides & 0x3FFF), 1 + (sides >> 14 & 0x3FFF)
    if kind == b"VP8 " and header[3:6] == _LOSSY:
        width, height = int.from_bytes(header[6:8], "little"), int.from_bytes(header[8:10], "little")
        return width & 0x3FFF, height & 0x3FFF
    raise DamagedImage("the WebP has no header")


def _jpeg_size(file: bytes) -> tuple[int, int]:
    """Walk the segments up to the frame header (T.81, B.1.1)."""
    at = 2
    for _ in range(_MAX_SEGMENTS):
        if at + 9 > len(file) or file[at] != 0xFF:
            break
        marker = file[at + 1]
        if marker in _FRAME_MARKERS:
            height, width = _SIDES(file, at + 5)
            return width, height
        if marker in _FINAL_MARKERS:
            break
        if marker == 0xFF:
            at += 1
        elif marker in _BARE_MARKERS:
            at += 2
        else:
            at += 2 + max(2, _LENGTH(file, at + 2)[0])
    raise DamagedImage("the JPEG has no size")


_SIZES: dict[Kind, Callable[[bytes], tuple[int, int]]] = {
    "jpeg": _jpeg_size,
    "png": _png_size,
    "webp": _webp_size,
}

# --- orientation of JPEG -----------------------------------------------------------------------------------

_EXIF = b"Exif\0\0"
_APP1, _SOS = 0xE1, 0xDA
_ORIENTATION = 0x0112
_UPRIGHT = 1

_MAX_EXIF_SEGMENTS = 64
"""Segments that are searched; Exif is among the first."""


def without_orientation(file: bytes) -> bytes:
    """The same JPEG without Exif segments that ask for a rotation (tag 274, Exif 2.32, 4.6.5.1). No pixel
    changes.

    Browsers obey the tag. A re-encoded image has none, so an image that is passed on must have none either:
    else it would turn whenever the uplink gets thin. Viewers ask for a rotation by ``rotate``.

    :param file: a whole JPEG
    """
    at, found = 2, []
    for _ in range(_MAX_EXIF_SEGMENTS):
        if file[at : at + 1] != b"\xff" or at + 4 > len(file) or file[at + 1] == _SOS:
            break
        end = at + 2 + int.from_bytes(file[at + 2 : at + 4], "big")
        if file[at + 1] == _APP1 and _is_rotated(file[at + 4 : end]):
            found.append((at, end))
        at = end
    for start, end in reversed(found):
        file = file[:start] + file[end:]
    return file


def _is_rotated(segment: bytes) -> bool:
    """Whether an APP1 segment is Exif with an orientation other than that of the pixels."""
    if not segment.startswith(_EXIF):
        return False
    tiff = segment[len(_EXIF) :]
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return False
    try:
        (first,) = struct.unpack_from(order + "I", tiff, 4)
        (count,) = struct.unpack_from(order + "H", tiff, first)
        for entry in range(count):
            tag, _, _, value = struct.unpack_from(order + "HHIH", tiff, first + 2 + 12 * entry)
            if tag == _ORIENTATION:
                return bool(value != _UPRIGHT)
    except struct.error:
        pass
    return False
