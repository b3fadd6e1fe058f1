"""The fields of sensor_msgs/msg/Image and CompressedImage, read from CDR without ROS and without a copy.

Every length is checked against the bytes there are before it is used. Source: OMG DDSI-RTPS 2.5, 10 (encapsulation),
and DDS-XTypes 1.3, 7.4.3 (plain CDR).
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from relay_protocol.errors import Invalid
from relay_protocol.limits import LABEL, PICTURE_SIDE


class Damaged(Invalid):
    """This picture is broken; the camera's next one may not be."""


_ORDERS = {b"\x00\x01": struct.Struct("<I"), b"\x00\x00": struct.Struct(">I")}
_HEAD = 4
"""Bytes of the encapsulation; what follows is aligned from there."""


class Image(NamedTuple):
    """A sensor_msgs/msg/Image.

    :param big_endian: of the pixels; has nothing to do with the byte order of the message
    :param step: bytes from one row to the next
    """

    encoding: str
    width: int
    height: int
    big_endian: bool
    step: int
    pixels: memoryview


class Compressed(NamedTuple):
    """A sensor_msgs/msg/CompressedImage.

    :param start: where in the message the file begins
    :param stop: where it ends
    """

    format: str
    start: int
    stop: int


def read_image(cdr: bytes) -> Image:
    """Take an Image apart; whether its pixels are enough for its size is not looked at.

    :raises Invalid: the bytes are no such message, or the picture has no pixels or too many
    """
    reader = _CdrReader(cdr)
    reader.skip_header()
    height, width = reader.u32(), reader.u32()
    encoding = reader.text("encoding")
    big_endian, step = reader.u8() != 0, reader.u32()
    start, stop = reader.octets()
    check_size(width, height)
    return Image(encoding, width, height, big_endian, step, memoryview(cdr)[start:stop])


def read_compressed(cdr: bytes) -> Compressed:
    """Take a CompressedImage apart.

    :raises Invalid: the bytes are no such message
    """
    reader = _CdrReader(cdr)
    reader.skip_header()
    return Compressed(reader.text("format"), *reader.octets())


def check_size(width: int, height: int) -> None:
    """Refuse what is no picture, and what is larger than any can be sent.

    :param width: pixels
    :param height: pixels
    :raises Invalid: says the size
    """
    if not (0 < width <= PICTURE_SIDE and 0 < height <= PICTURE_SIDE):
        raise Invalid(
            f"a picture of {width}×{height} pixels can't be shown; each side may have 1 to {PICTURE_SIDE}"
        )


class _CdrReader:
    def __init__(self, cdr: bytes) -> None:
        if len(cdr) < _HEAD:
            raise Damaged(f"{len(cdr)} bytes are too short for a CDR message")
        order = _ORDERS.get(cdr[:2])
        if order is None:
            raise Invalid(f"bytes 0 and 1 are {cdr[:2].hex()}; plain CDR has 0001 or 0000")
        self._u32 = order.unpack_from
        self._cdr = cdr
        self._at = _HEAD

    def skip_header(self) -> None:
        """Stamp and frame."""
        self._take(8, "stamp")
        self._take(self.u32(), "frame_id")

    def u8(self) -> int:
        return self._cdr[self._take(1, "is_bigendian")]

    def u32(self) -> int:
        self._at += -self._at % 4
        value: int = self._u32(self._cdr, self._take(4, "a number"))[0]
        return value

    def text(self, what: str) -> str:
        """Short printable ASCII, which all that is told here is."""
        length = self.u32()
        start = self._take(length, what)
        if length > LABEL:
            raise Invalid(f"{what} has {length} bytes; there are at most {LABEL}")
        text = self._cdr[start : start + length].rstrip(b"\0").decode("latin-1")
        if not (text.isascii() and text.isprintable()):
            raise Invalid(f"{what} is not printable ASCII")
        return text

    def octets(self) -> tuple[int, int]:
        """Where a ``uint8[]`` begins and ends."""
        length = self.u32()
        start = self._take(length, "data")
        return start, start + length

    def _take(self, length: int, what: str) -> int:
        start = self._at
        if length > len(self._cdr) - start:
            left = max(0, len(self._cdr) - start)
            raise Damaged(f"the message ends in the middle: {what} has {length} bytes, {left} are left")
        self._at = start + length
        return start
