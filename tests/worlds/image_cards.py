"""A test card of known colours, and messages with it in every encoding, made only with numpy, struct and
zlib.
"""

from __future__ import annotations

import struct
import zlib
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Pixels = npt.NDArray[np.uint8]

PATCHES: dict[str, tuple[int, int, int]] = {
    "white": (255, 255, 255),
    "yellow": (255, 255, 0),
    "cyan": (0, 255, 255),
    "green": (0, 255, 0),
    "magenta": (255, 0, 255),
    "red": (255, 0, 0),
    "blue": (0, 0, 255),
    "grey": (128, 128, 128),
}
"""From left to right: R, G, B."""

_MOSAICS = {"rggb": (0, 1, 1, 2), "bggr": (2, 1, 1, 0), "gbrg": (1, 2, 0, 1), "grbg": (1, 0, 2, 1)}
"""Which of R, G, B the four pixels of a square have, as the encodings' names say them, row by row."""


class Coded(NamedTuple):
    """The pixels of a message: rows of ``step`` bytes."""

    encoding: str
    width: int
    height: int
    big_endian: bool
    step: int
    data: bytes


def card(width: int = 320, height: int = 240) -> Pixels:
    """Eight bars; in the lower quarter a ramp from black to white. RGB, shape (height, width, 3)."""
    bar = np.arange(width) * len(PATCHES) // width
    picture = np.repeat(np.array(list(PATCHES.values()), np.uint8)[bar][None], height, axis=0)
    picture[-height // 4 :] = np.linspace(0, 255, width).astype(np.uint8)[None, :, None]
    return picture


def middle_of(patch: str, width: int = 320, height: int = 240) -> tuple[int, int]:
    """Row and column in the middle of a bar."""
    return height // 3, (2 * list(PATCHES).index(patch) + 1) * width // (2 * len(PATCHES))


def depths(width: int = 320, height: int = 240) -> npt.NDArray[np.float64]:
    """Metres from 0.25 at the left to 16 at the right, by octaves; the lower quarter has no measurements."""
    picture = np.repeat((0.25 * 2 ** np.linspace(0, 6, width))[None], height, axis=0)
    picture[-height // 4 :] = 0
    return picture


def grey_of(rgb: Pixels) -> Pixels:
    """ITU-R BT.601."""
    grey: Pixels = np.rint(rgb @ np.array([0.299, 0.587, 0.114])).astype(np.uint8)
    return grey


def _yuv(rgb: Pixels) -> Pixels:
    """ITU-R BT.601 with Y from 16 to 235, shape (height, width, 3)."""
    red, green, blue = np.moveaxis(rgb.astype(float) / 255, 2, 0)
    y = 0.299 * red + 0.587 * green + 0.114 * blue
    planes = (16 + 219 * y, 128 + 224 * (blue - y) / 1.772, 128 + 224 * (red - y) / 1.402)
    yuv: Pixels = np.rint(np.stack(planes, axis=2)).astype(np.uint8)
    return yuv


def _mosaic(rgb: Pixels, order: str) -> Pixels:
    raw = np.empty(rgb.shape[:2], np.uint8)
    for place, channel in enumerate(_MOSAICS[order]):
        rows, columns = slice(place // 2, None, 2), slice(place % 2, None, 2)
        raw[rows, columns] = rgb[rows, columns, channel]
    return raw


def _pairs(rgb: Pixels, grey_at: int) -> Pixels:
    """Two bytes per pixel: its grey at one place, and U or V of its pair at the other."""
    yuv = _yuv(rgb)
    packed = np.empty((*rgb.shape[:2], 2), np.uint8)
    packed[:, :, grey_at] = yuv[:, :, 0]
    packed[:, 0::2, 1 - grey_at] = yuv[:, 0::2, 1]
    packed[:, 1::2, 1 - grey_at] = yuv[:, 0::2, 2]
    return packed


def coded(
    encoding: str, width: int = 320, height: int = 240, *, big_endian: bool = False, padding: int = 0
) -> Coded:
    """The card (for depth encodings: the depths) as a camera with this encoding publishes it.

    :param padding: bytes of 0xA5 after each row
    """
    rgb = card(width, height)
    if encoding in ("yuv420", "i420"):
        padding -= padding % 2
    grey = _padded(_values(encoding, rgb, ">" if big_endian else "<"), padding)
    step, data = grey.shape[1], grey.tobytes()
    if encoding == "nv21":
        data += _padded(_yuv(rgb)[::2, ::2, :0:-1], padding).tobytes()
    elif encoding == "nv12":
        data += _padded(_yuv(rgb)[::2, ::2, 1:], padding).tobytes()
    elif encoding in ("yuv420", "i420"):
        for plane in (1, 2):
            data += _padded(_yuv(rgb)[::2, ::2, plane], padding // 2).tobytes()
    elif encoding == "nv24":
        # A row of its colours is as long as two of its grey, and so is the padding.
        data += _padded(_yuv(rgb)[:, :, 1:], 2 * padding).tobytes()
    return Coded(encoding, width, height, big_endian, step, data)


def _padded(plane: npt.NDArray[np.generic], padding: int) -> Pixels:
    rows = np.ascontiguousarray(plane).view(np.uint8).reshape(plane.shape[0], -1)
    return np.pad(rows, ((0, 0), (0, padding)), constant_values=0xA5)


def _values(encoding: str, rgb: Pixels, order: str) -> npt.NDArray[np.generic]:
    """Pixel values of an encoding; for planar ones the grey."""
    height, width = rgb.shape[:2]
    opaque = np.full((height, width, 1), 255, np.uint8)
    wide = np.dtype("u2").newbyteorder(order)
    if encoding.startswith("bayer_"):
        raw = _mosaic(rgb, encoding[6:10])
        return raw if encoding.endswith("8") else (raw * np.uint16(257)).astype(wide)
    if encoding in ("rgb16", "bgr16", "rgba16", "bgra16", "mono16"):
        return (_values(encoding[:-2] + "8", rgb, order) * np.uint16(257)).astype(wide)
    return {
        "rgb8": lambda: rgb,
        "bgr8": lambda: rgb[:, :, ::-1],
        "rgba8": lambda: np.concatenate((rgb, opaque), axis=2),
        "bgra8": lambda: np.concatenate((rgb[:, :, ::-1], opaque), axis=2),
        "mono8": lambda: grey_of(rgb),
        "8UC1": lambda: grey_of(rgb),
        "8UC3": lambda: rgb[:, :, ::-1],
        "8UC4": lambda: np.concatenate((rgb[:, :, ::-1], opaque), axis=2),
        "16UC1": lambda: np.rint(depths(width, height) * 1000).astype(wide),
        "32FC1": lambda: np.where(depths(width, height) > 0, depths(width, height), np.nan).astype(
            order + "f4"
        ),
        "16UC3": lambda: _values("bgr16", rgb, order),
        "16UC4": lambda: _values("bgra16", rgb, order),
        "32FC3": lambda: (rgb[:, :, ::-1] / 255).astype(order + "f4"),
        "32FC4": lambda: np.concatenate((rgb[:, :, ::-1] / 255, opaque), axis=2).astype(order + "f4"),
        "uyvy": lambda: _pairs(rgb, 1),
        "yuv422": lambda: _pairs(rgb, 1),
        "yuyv": lambda: _pairs(rgb, 0),
        "yuv422_yuy2": lambda: _pairs(rgb, 0),
        "nv12": lambda: _yuv(rgb)[:, :, 0],
        "nv21": lambda: _yuv(rgb)[:, :, 0],
        "yuv420": lambda: _yuv(rgb)[:, :, 0],
        "i420": lambda: _yuv(rgb)[:, :, 0],
        "nv24": lambda: _yuv(rgb)[:, :, 0],
    }[encoding]()


def image_cdr(picture: Coded, *, frame: str = "camera", order: str = "<") -> bytes:
    """A sensor_msgs/msg/Image, built by hand.

    :param order: of the message's own numbers: ``<`` or ``>``
    """
    body = _header(frame, order)
    body = _aligned(body) + struct.pack(order + "II", picture.height, picture.width)
    body += _text(picture.encoding, order) + struct.pack("B", picture.big_endian)
    body = _aligned(body) + struct.pack(order + "II", picture.step, len(picture.data))
    return _encapsulation(order) + body + picture.data


def compressed_cdr(file: bytes, format_: str = "jpeg", *, order: str = "<") -> bytes:
    """A sensor_msgs/msg/CompressedImage, built by hand."""
    body = _aligned(_header("camera", order))
    body = _aligned(body + _text(format_, order)) + struct.pack(order + "I", len(file))
    return _encapsulation(order) + body + file


INVERSE = (100.0 * 101.0, 1 - 100.0 * 101.0 / 16.5)
"""By which compressed_depth_image_transport quantises metres by default, but that it may be told how far: to 16.5 m."""


def quantised(metres: npt.NDArray[np.float64]) -> npt.NDArray[np.uint16]:
    """Metres quantised by :data:`INVERSE`; 0 without a measurement."""
    numerator, offset = INVERSE
    values = np.divide(numerator, metres, out=np.full(metres.shape, -offset), where=metres > 0) + offset
    return np.floor(values).astype(np.uint16)


def png_of(values: npt.NDArray[np.uint16]) -> bytes:
    """A PNG with 16-bit grey, built by hand."""
    height, width = values.shape
    rows = _padded(values.astype(">u2"), 0)
    lines = np.pad(rows, ((0, 0), (1, 0))).tobytes()
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(lines)),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in chunks
    )


def depth_files(width: int = 320, height: int = 240) -> dict[str, bytes]:
    """The depths as image_transport publishes them in PNG: CompressedImage by its ``format``."""
    metres = depths(width, height)
    millimetres = png_of(np.rint(metres * 1000).astype(np.uint16))
    inverse = png_of(quantised(metres))
    return {
        "16UC1; png compressed ": millimetres,
        "16UC1; compressedDepth": depth_head() + millimetres,
        "16UC1; compressedDepth png": depth_head() + millimetres,
        "32FC1; compressedDepth png": depth_head(*INVERSE) + inverse,
    }


def depth_head(numerator: float = 0.0, offset: float = 0.0) -> bytes:
    """The header that compressed_depth_image_transport writes before the file."""
    return struct.pack("<iff", 0, numerator, offset)


def _encapsulation(order: str) -> bytes:
    return b"\0\1\0\0" if order == "<" else b"\0\0\0\0"


def _header(frame: str, order: str) -> bytes:
    return struct.pack(order + "iI", 1_700_000_000, 5) + _text(frame, order)


def _text(text: str, order: str) -> bytes:
    return struct.pack(order + "I", len(text) + 1) + text.encode() + b"\0"


def _aligned(body: bytes) -> bytes:
    return body + bytes(-len(body) % 4)
