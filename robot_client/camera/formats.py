"""Images as cameras publish them, decoded to arrays: the encodings of sensor_msgs/msg/Image, JPEG, PNG and
WebP.

Encodings mean what cv_bridge and image_encodings.hpp say. Sixteen bits become eight by 255 / 65535,
whatever range the camera uses, so that the brightness does not jump. For the same reason depth is coloured
on a fixed scale, also if image_transport has packed it as PNG.
"""

from __future__ import annotations

import math
import struct
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from relay_protocol.errors import Invalid
from robot_client.camera import images
from robot_client.camera.images import DamagedImage, ImageMessage, read_compressed, read_image

Pixels = npt.NDArray[np.uint8]

MAX_PIXELS = 1 << 25
"""Most pixels of a file that is decoded: a few bytes of PNG can stand for any number."""

_GREY_16 = ("16UC1", "mono16")
"""Encodings that a 16-bit PNG holds unchanged."""

_DEPTH_HEADER = struct.Struct("<iff")
"""Header before the file of compressedDepth: ConfigHeader of compressed_depth_image_transport, a kind and
the two parameters by which ``32FC1`` was quantised. It has the publisher's byte order, which is little
endian on all platforms of ROS 2."""


class RawImage(NamedTuple):
    """A decoded image.

    :param encoding: the camera's: ``rgb8``, ``16UC1``, ``jpeg``, …
    :param width: pixels
    :param height: pixels
    :param pixels: (height, width, 3) as B, G, R, or (height, width) grey; may be a read-only view of the
        message
    """

    encoding: str
    width: int
    height: int
    pixels: Pixels


def decode_image(cdr: bytes) -> RawImage:
    """Decode a sensor_msgs/msg/Image.

    :param cdr: the serialised message with its four-byte header
    :raises Invalid: no such message, an unsupported encoding, or a size that does not match its pixels
    """
    found = read_image(cdr)
    layout = _LAYOUTS.get(found.encoding)
    if layout is None:
        raise Invalid(
            f"images of encoding '{found.encoding}' can't be shown; supported are {', '.join(ENCODINGS)}"
        )
    _check(found, layout)
    return RawImage(found.encoding, found.width, found.height, layout.read(found))


class CompressedFile(NamedTuple):
    """The file in a CompressedImage.

    :param file: the encoded file without padding
    :param encoding: encoding of the raw image if the file holds its 16-bit values: ``16UC1``, ``mono16``,
        ``32FC1``; else empty
    :param scale: for ``32FC1``: numerator and offset, see :func:`colour_inverse_depth`
    """

    kind: images.Kind
    file: bytes
    encoding: str = ""
    scale: tuple[float, float] = (0.0, 0.0)


def compressed_file(cdr: bytes) -> CompressedFile:
    """The file in a sensor_msgs/msg/CompressedImage.

    :param cdr: the serialised message with its four-byte header
    :raises Invalid: no such message, no complete JPEG, PNG or WebP, or an unsupported form of depth
    """
    found = read_compressed(cdr)
    encoding, _, codec = (part.strip() for part in found.format.partition(";"))
    if "compressedDepth" in found.format:
        return _compressed_depth(cdr, found.start, found.stop, encoding, codec)
    try:
        kind = images.kind_of(cdr, found.start)
    except Invalid as error:
        if found.start == found.stop or any(
            name in found.format.lower() for name in ("jpeg", "jpg", "png", "webp")
        ):
            raise DamagedImage(str(error)) from None
        raise
    file = cdr[found.start : images.end_of(cdr, found.start, found.stop, kind)]
    as_raw = encoding in _GREY_16 and kind == "png" and images.is_16_bit_grey(file)
    return CompressedFile(kind, file, encoding if as_raw else "")


def _compressed_depth(cdr: bytes, start: int, stop: int, encoding: str, codec: str) -> CompressedFile:
    """The format of compressed_depth_image_transport; old releases do not name the codec, which is PNG
    then."""
    if "rvl" in codec.lower():
        raise Invalid(
            "compressedDepth with RVL can't be shown; set compressedDepth.format of its publisher to png, "
            "or use the topic with the raw depth"
        )
    if encoding not in (*_GREY_16, "32FC1"):
        raise Invalid(
            f"compressedDepth of encoding '{encoding}' can't be shown; supported are 16UC1, mono16, 32FC1"
        )
    at = start + _DEPTH_HEADER.size
    if at >= stop:
        raise DamagedImage("this compressedDepth ends before its PNG begins")
    if images.kind_of(cdr, at) != "png":
        raise Invalid("compressedDepth can only be shown if its file is PNG")
    file = cdr[at : images.end_of(cdr, at, stop, "png")]
    if not images.is_16_bit_grey(file):
        raise Invalid("the PNG of compressedDepth must be 16-bit grey, and this one is not")
    _, *scale = _DEPTH_HEADER.unpack_from(cdr, start)
    if encoding != "32FC1":
        return CompressedFile("png", file, encoding)
    if not all(map(math.isfinite, scale)):
        raise DamagedImage("the quantisation of this compressedDepth is not finite")
    return CompressedFile("png", file, encoding, (scale[0], scale[1]))


def decode_compressed(packed: CompressedFile) -> RawImage:
    """Decode a file to the pixels that the raw topic would give.

    :raises Invalid: see :func:`decode_file`
    """
    if not packed.encoding:
        return decode_file(packed.file)
    values = _imdecode(packed.kind, packed.file, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if values.dtype != np.uint16:
        raise DamagedImage("the PNG is broken")
    height, width = values.shape
    if packed.encoding == "32FC1":
        pixels = colour_inverse_depth(values.astype(np.uint16, copy=False), packed.scale[0], packed.scale[1])
    else:
        rows = np.ascontiguousarray(values).data.cast("B")
        found = ImageMessage(packed.encoding, width, height, sys.byteorder == "big", 2 * width, rows)
        pixels = _LAYOUTS[packed.encoding].read(found)
    return RawImage(packed.encoding, width, height, pixels)


def decode_file(file: bytes) -> RawImage:
    """Decode a JPEG, PNG or WebP; grey images stay grey.

    :raises Invalid: it is none of these, is broken, or has more than :data:`MAX_PIXELS`
    """
    kind = images.kind_of(file)
    pixels = _imdecode(kind, file, cv2.IMREAD_ANYCOLOR).astype(np.uint8, copy=False)
    return RawImage(kind, pixels.shape[1], pixels.shape[0], pixels)


def _imdecode(kind: images.Kind, file: bytes, how: int) -> npt.NDArray[Any]:
    width, height = images.size_of(file, kind)
    if width * height > MAX_PIXELS:
        raise Invalid(f"a {kind.upper()} of {width}×{height} pixels is too large to be decoded")
    try:
        # Without the rotation of Exif: viewers request rotation, and sizes are those of the file's header.
        pixels = cv2.imdecode(np.frombuffer(file, np.uint8), how | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        pixels = None
    if pixels is None or pixels.shape[:2] != (height, width):
        raise DamagedImage(f"the {kind.upper()} is broken")
    return pixels


def message_format(cdr: bytes, compressed: bool) -> tuple[str, int, int]:
    """Encoding, width and height (pixels) of a message. No pixel is read.

    :param compressed: whether it is a CompressedImage
    :raises Invalid: no such message
    """
    if not compressed:
        found = read_image(cdr)
        return found.encoding, found.width, found.height
    packed = compressed_file(cdr)
    width, height = images.size_of(packed.file, packed.kind)
    return packed.encoding or packed.kind, width, height


# --- depth -------------------------------------------------------------------------------------------------

NEAREST, FARTHEST = 250, 16_000
"""Millimetres; depth is red up to the first and blue from the second. In between, each doubling of the
distance takes an equal share of the colours, with green in the middle at 2 m. Missing measurements are
black."""

_MAX_DEPTH = 65_535
"""Millimetres in 16 bits."""

_PALETTE = (235, 20)
"""Range of OpenCV's palette Turbo that is used, near to far: its ends are nearly black."""


def colour_depth(millimetres: npt.NDArray[np.uint16]) -> Pixels:
    """BGR colours of depth; 0 is a missing measurement."""
    return np.take(_DEPTH_COLOURS, millimetres, axis=0)


def to_millimetres(metres: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.uint16]:
    """Depth in millimetres from metres, which are NaN or infinite for missing measurements (REP 118)."""
    measured = np.isfinite(metres) & (metres > 0)
    missing = np.zeros(metres.shape, metres.dtype)
    clipped = np.minimum(metres, _MAX_DEPTH / 1000, where=measured, out=missing)
    return np.asarray(clipped * 1000).astype(np.uint16)


def colour_inverse_depth(values: npt.NDArray[np.uint16], numerator: float, offset: float) -> Pixels:
    """BGR colours of depth that compressed_depth_image_transport quantised by its inverse (``32FC1``).

    Metres are ``numerator / (value - offset)``; 0 is a missing measurement.

    :param numerator: finite
    :param offset: finite
    """
    steps = np.arange(_MAX_DEPTH + 1) - offset
    metres = np.divide(numerator, steps, where=steps > 0, out=np.zeros(steps.shape))
    metres[0] = 0
    return np.take(colour_depth(to_millimetres(metres)), values, axis=0)


def _build_depth_colours() -> Pixels:
    """BGR for each millimetre."""
    octaves = np.log2(np.maximum(np.arange(_MAX_DEPTH + 1), 1) / NEAREST) / np.log2(FARTHEST / NEAREST)
    shade = _PALETTE[0] + (_PALETTE[1] - _PALETTE[0]) * np.clip(octaves, 0, 1)
    # As a square, because releases of OpenCV disagree on the shape of the result for a single row.
    square = np.rint(shade).astype(np.uint8).reshape(256, 256)
    colours: Pixels = cv2.applyColorMap(square, cv2.COLORMAP_TURBO).astype(np.uint8).reshape(-1, 3)
    colours[0] = 0
    return colours


_DEPTH_COLOURS = _build_depth_colours()

# --- layouts of raw encodings ------------------------------------------------------------------------------


class _Layout(NamedTuple):
    """The layout of an encoding.

    :param row: bytes of a row for each pixel
    :param read: decodes an image
    :param lines: rows for every two rows of the image; more than two if chroma planes follow the luma
    :param even: width and height must be multiples of these
    :param least: least pixels of each side
    """

    row: int
    read: Callable[[ImageMessage], Pixels]
    lines: int = 2
    even: tuple[int, int] = (1, 1)
    least: int = 1


def _check(found: ImageMessage, layout: _Layout) -> None:
    size = f"{found.encoding} of {found.width}×{found.height} pixels"
    if found.width % layout.even[0] or found.height % layout.even[1]:
        raise Invalid(f"{size}: this encoding stores pairs of pixels, so the size must be even")
    if min(found.width, found.height) < layout.least:
        raise Invalid(f"{size}: this encoding needs at least {layout.least} pixels each way")
    row = found.width * layout.row
    if found.step < row:
        raise Invalid(f"{size} has rows of {row} bytes, but step says {found.step}")
    needed = found.step * found.height * layout.lines // 2
    if len(found.pixels) < needed:
        raise DamagedImage(
            f"{size} and step {found.step} needs {needed} bytes; the message has {len(found.pixels)}"
        )


def _plane(found: ImageMessage, dtype: str = "u1", channels: int = 1) -> npt.NDArray[Any]:
    """A view of the values of all rows, without the padding of the rows."""
    kind = np.dtype(dtype).newbyteorder(">" if found.big_endian else "<")
    shape = (found.height, found.width, channels)
    strides = (found.step, kind.itemsize * channels, kind.itemsize)
    values: npt.NDArray[Any] = np.ndarray(shape, kind, found.pixels, strides=strides)
    return values[:, :, 0] if channels == 1 else values


def _eight_bit(channels: int, code: int | None = None) -> Callable[[ImageMessage], Pixels]:
    def read(found: ImageMessage) -> Pixels:
        return _converted(_plane(found, "u1", channels).view(np.uint8), code)

    return read


def _sixteen_bit(channels: int, code: int | None = None) -> Callable[[ImageMessage], Pixels]:
    def read(found: ImageMessage) -> Pixels:
        values = _plane(found, "u2", channels).astype(np.uint16)
        return _converted(cv2.convertScaleAbs(values, alpha=255 / 65535).astype(np.uint8, copy=False), code)

    return read


def _bayer8(code: int) -> _Layout:
    return _Layout(1, _eight_bit(1, code), least=_MOSAIC)


def _bayer16(code: int) -> _Layout:
    return _Layout(2, _sixteen_bit(1, code), least=_MOSAIC)


def _converted(pixels: Pixels, code: int | None) -> Pixels:
    return pixels if code is None else cv2.cvtColor(pixels, code).astype(np.uint8, copy=False)


def _millimetres(found: ImageMessage) -> Pixels:
    """Depth in millimetres, 0 for no measurement (REP 118)."""
    return colour_depth(_plane(found, "u2"))


def _metres(found: ImageMessage) -> Pixels:
    """Depth in metres, NaN or infinite for no measurement (REP 118)."""
    return colour_depth(to_millimetres(_plane(found, "f4")))


def _float_colour(channels: int) -> Callable[[ImageMessage], Pixels]:
    """Blue, green and red from 0 to 1, clipped; NaN is black.

    No specification defines this range; renderers and OpenCV use it.
    """

    def read(found: ImageMessage) -> Pixels:
        values = np.nan_to_num(_plane(found, "f4", channels)[:, :, :3], nan=0.0, posinf=1.0, neginf=0.0)
        shown: Pixels = np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
        return shown

    return read


def _interleaved_chroma(code: int) -> Callable[[ImageMessage], Pixels]:
    """Luma, then one U-V pair for every four pixels."""

    def read(found: ImageMessage) -> Pixels:
        return _converted(_plane(found._replace(height=found.height * 3 // 2)).view(np.uint8), code)

    return read


def _i420(found: ImageMessage) -> Pixels:
    """Luma, then U and then V for every four pixels, in rows of half the step."""
    height, width, half = found.height, found.width, found.step // 2
    shape, strides = (2, height // 2, width // 2), (half * height // 2, half, 1)
    chroma: npt.NDArray[np.uint8] = np.ndarray(
        shape, np.uint8, found.pixels[found.step * height :], strides=strides
    )
    planes = np.concatenate((_plane(found).view(np.uint8).ravel(), chroma.ravel()))
    return _converted(planes.reshape(height * 3 // 2, width), cv2.COLOR_YUV2BGR_I420)


_FROM_YUV = np.array(
    [
        [1.164, 2.018, 0.0, -1.164 * 16 - 2.018 * 128],
        [1.164, -0.391, -0.813, -1.164 * 16 + (0.391 + 0.813) * 128],
        [1.164, 0.0, 1.596, -1.164 * 16 - 1.596 * 128],
    ]
)
"""Y, U, V to B, G, R (ITU-R BT.601, Y from 16 to 235), as OpenCV converts the other YUV encodings."""


def _nv24(found: ImageMessage) -> Pixels:
    """Luma, then one U-V pair for every pixel. OpenCV does not support this encoding."""
    luma = _plane(found)
    chroma = found._replace(pixels=found.pixels[found.step * found.height :], step=2 * found.step)
    yuv = cv2.merge((luma.view(np.uint8), *cv2.split(_plane(chroma, channels=2).view(np.uint8))))
    return cv2.transform(yuv, _FROM_YUV).astype(np.uint8, copy=False)


_MOSAIC = 3
"""Least pixels of each side for which OpenCV demosaics; smaller images become black."""
_PAIRS = (2, 1)
_FOURS = (2, 2)

_LAYOUTS: dict[str, _Layout] = {
    "rgb8": _Layout(3, _eight_bit(3, cv2.COLOR_RGB2BGR)),
    "bgr8": _Layout(3, _eight_bit(3)),
    "rgba8": _Layout(4, _eight_bit(4, cv2.COLOR_RGBA2BGR)),
    "bgra8": _Layout(4, _eight_bit(4, cv2.COLOR_BGRA2BGR)),
    "mono8": _Layout(1, _eight_bit(1)),
    "rgb16": _Layout(6, _sixteen_bit(3, cv2.COLOR_RGB2BGR)),
    "bgr16": _Layout(6, _sixteen_bit(3)),
    "rgba16": _Layout(8, _sixteen_bit(4, cv2.COLOR_RGBA2BGR)),
    "bgra16": _Layout(8, _sixteen_bit(4, cv2.COLOR_BGRA2BGR)),
    "mono16": _Layout(2, _sixteen_bit(1)),
    "8UC1": _Layout(1, _eight_bit(1)),
    "8UC3": _Layout(3, _eight_bit(3)),
    "8UC4": _Layout(4, _eight_bit(4, cv2.COLOR_BGRA2BGR)),
    "16UC1": _Layout(2, _millimetres),
    "16UC3": _Layout(6, _sixteen_bit(3)),
    "16UC4": _Layout(8, _sixteen_bit(4, cv2.COLOR_BGRA2BGR)),
    "32FC1": _Layout(4, _metres),
    "32FC3": _Layout(12, _float_colour(3)),
    "32FC4": _Layout(16, _float_colour(4)),
    "bayer_rggb8": _bayer8(cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr8": _bayer8(cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg8": _bayer8(cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg8": _bayer8(cv2.COLOR_BayerGRBG2BGR),
    "bayer_rggb16": _bayer16(cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr16": _bayer16(cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg16": _bayer16(cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg16": _bayer16(cv2.COLOR_BayerGRBG2BGR),
    # The names with and without yuv422 mean the same.
    "uyvy": _Layout(2, _eight_bit(2, cv2.COLOR_YUV2BGR_UYVY), even=_PAIRS),
    "yuv422": _Layout(2, _eight_bit(2, cv2.COLOR_YUV2BGR_UYVY), even=_PAIRS),
    "yuyv": _Layout(2, _eight_bit(2, cv2.COLOR_YUV2BGR_YUY2), even=_PAIRS),
    "yuv422_yuy2": _Layout(2, _eight_bit(2, cv2.COLOR_YUV2BGR_YUY2), even=_PAIRS),
    "nv12": _Layout(1, _interleaved_chroma(cv2.COLOR_YUV2BGR_NV12), lines=3, even=_FOURS),
    "nv21": _Layout(1, _interleaved_chroma(cv2.COLOR_YUV2BGR_NV21), lines=3, even=_FOURS),
    "yuv420": _Layout(1, _i420, lines=3, even=_FOURS),
    "i420": _Layout(1, _i420, lines=3, even=_FOURS),
    "nv24": _Layout(1, _nv24, lines=6),
}

ENCODINGS = tuple(_LAYOUTS)
"""Supported encodings of sensor_msgs/msg/Image. The others of image_encodings.hpp have no meaning as colour
or distance: two values a pixel, signed values, doubles."""
