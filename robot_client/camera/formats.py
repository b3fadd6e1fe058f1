"""Pictures as cameras publish them, turned into arrays: every usual encoding of sensor_msgs/msg/Image, JPEG, PNG and
WebP.

Colours mean what cv_bridge and image_encodings.hpp say. Sixteen bits become eight by 255 / 65535, whatever the camera
uses of them, so that the brightness doesn't jump; depth gets colours of a fixed scale for the same reason, also where
image_transport has made a PNG of it.
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
from robot_client.camera import depth, image_headers
from robot_client.camera.messages import Damaged, Image, read_compressed, read_image

Pixels = npt.NDArray[np.uint8]

PIXELS = 1 << 25
"""Most pixels of a file that is decoded: a few bytes of PNG can stand for any number."""

_SIXTEEN = ("16UC1", "mono16")
"""Encodings whose pixels are sixteen bits of a PNG, as they are."""

_DEPTH_HEAD = struct.Struct("<iff")
"""What stands before the file of compressedDepth: ConfigHeader of compressed_depth_image_transport, a kind and two
numbers by which ``32FC1`` was quantised; in the byte order of the publisher,
which is little endian on all that ROS 2 supports."""


class Raw(NamedTuple):
    """A picture as pixels.

    :param encoding: what it came in: ``rgb8``, ``16UC1``, ``jpeg``, …
    :param width: pixels
    :param height: pixels
    :param pixels: (height, width, 3) as B, G, R, or (height, width) grey; may be part of the message, not writable
    """

    encoding: str
    width: int
    height: int
    pixels: Pixels


def image(cdr: bytes) -> Raw:
    """Pixels of a sensor_msgs/msg/Image.

    :param cdr: the message as ROS serialised it, with its four-byte header
    :raises Invalid: no such message, an encoding that can't be shown, or a size that doesn't fit its pixels
    """
    found = read_image(cdr)
    layout = _LAYOUTS.get(found.encoding)
    if layout is None:
        raise Invalid(
            f"a camera of encoding '{found.encoding}' can't be shown; these can: {', '.join(ENCODINGS)}"
        )
    _check(found, layout)
    return Raw(found.encoding, found.width, found.height, layout.read(found))


class Packed(NamedTuple):
    """A picture that comes as a file.

    :param file: from its first byte to its last, not decoded
    :param encoding: what its sixteen bits were before: ``16UC1``, ``mono16``, ``32FC1``. Empty: what it shows is as it
        stands in the file
    :param scale: of ``32FC1``: numerator and offset, see :func:`~robot_client.camera.depth.coloured_inverse`
    """

    kind: image_headers.Kind
    file: bytes
    encoding: str = ""
    scale: tuple[float, float] = (0.0, 0.0)


def compressed(cdr: bytes) -> Packed:
    """The file in a sensor_msgs/msg/CompressedImage.

    :param cdr: the message as ROS serialised it, with its four-byte header
    :raises Invalid: no such message, or no whole JPEG, PNG or WebP, or depth in a form that can't be shown
    """
    return _packed(cdr)


def _packed(cdr: bytes) -> Packed:
    found = read_compressed(cdr)
    encoding, _, codec = (part.strip() for part in found.format.partition(";"))
    if "compressedDepth" in found.format:
        return _compressed_depth(cdr, found.start, found.stop, encoding, codec)
    try:
        kind = image_headers.kind_of(cdr, found.start)
    except Invalid as error:
        if found.start == found.stop or any(
            name in found.format.lower() for name in ("jpeg", "jpg", "png", "webp")
        ):
            raise Damaged(str(error)) from None
        raise
    file = cdr[found.start : image_headers.end_of(cdr, found.start, found.stop, kind)]
    as_raw = encoding in _SIXTEEN and kind == "png" and image_headers.is_grey_of_sixteen_bits(file)
    return Packed(kind, file, encoding if as_raw else "")


def _compressed_depth(cdr: bytes, start: int, stop: int, encoding: str, codec: str) -> Packed:
    """What compressed_depth_image_transport makes; releases of old don't name the codec, which is PNG."""
    if "rvl" in codec.lower():
        raise Invalid(
            "compressedDepth by RVL can't be shown; set compressedDepth.format of its publisher to png, "
            "or take the topic with the raw depth"
        )
    if encoding not in (*_SIXTEEN, "32FC1"):
        raise Invalid(
            f"compressedDepth of encoding '{encoding}' can't be shown; these can: 16UC1, mono16, 32FC1"
        )
    at = start + _DEPTH_HEAD.size
    if at >= stop:
        raise Damaged("this compressedDepth ends before its PNG begins")
    if image_headers.kind_of(cdr, at) != "png":
        raise Invalid("compressedDepth of another kind than PNG can't be shown")
    file = cdr[at : image_headers.end_of(cdr, at, stop, "png")]
    if not image_headers.is_grey_of_sixteen_bits(file):
        raise Invalid("a PNG of compressedDepth has to be grey of sixteen bits, and this one is not")
    _, *scale = _DEPTH_HEAD.unpack_from(cdr, start)
    if encoding != "32FC1":
        return Packed("png", file, encoding)
    if not all(map(math.isfinite, scale)):
        raise Damaged("this compressedDepth does not tell how it was quantised")
    return Packed("png", file, encoding, (scale[0], scale[1]))


def unpacked(packed: Packed) -> Raw:
    """Pixels of a picture that came as a file: as those of the raw topic that it was made of.

    :raises Invalid: as of :func:`decoded`
    """
    if not packed.encoding:
        return decoded(packed.file)
    values = _decoded(packed.kind, packed.file, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if values.dtype != np.uint16:
        raise Damaged("the PNG is broken")
    height, width = values.shape
    if packed.encoding == "32FC1":
        pixels = depth.coloured_inverse(values.astype(np.uint16, copy=False), *packed.scale)
    else:
        rows = np.ascontiguousarray(values).data.cast("B")
        found = Image(packed.encoding, width, height, sys.byteorder == "big", 2 * width, rows)
        pixels = _LAYOUTS[packed.encoding].read(found)
    return Raw(packed.encoding, width, height, pixels)


def decoded(file: bytes) -> Raw:
    """Pixels of a JPEG, PNG or WebP; grey ones stay grey.

    :raises Invalid: it is none, is broken, or has more than :data:`PIXELS`
    """
    kind = image_headers.kind_of(file)
    pixels = _decoded(kind, file, cv2.IMREAD_ANYCOLOR).astype(np.uint8, copy=False)
    return Raw(kind, pixels.shape[1], pixels.shape[0], pixels)


def _decoded(kind: image_headers.Kind, file: bytes, how: int) -> npt.NDArray[Any]:
    width, height = image_headers.size_of(file, kind)
    if width * height > PIXELS:
        raise Invalid(f"a {kind.upper()} of {width}×{height} pixels is too large to be decoded")
    try:
        # A camera's rotation is the viewer's to ask for: sizes are those of the file's head.
        pixels = cv2.imdecode(np.frombuffer(file, np.uint8), how | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        pixels = None
    if pixels is None or pixels.shape[:2] != (height, width):
        raise Damaged(f"the {kind.upper()} is broken")
    return pixels


def looked_at(cdr: bytes, compressed: bool) -> tuple[str, int, int]:
    """What a message holds: encoding, width and height in pixels. No pixel is touched.

    :param compressed: whether it is a CompressedImage
    :raises Invalid: no such message
    """
    if not compressed:
        found = read_image(cdr)
        return found.encoding, found.width, found.height
    packed = _packed(cdr)
    return packed.encoding or packed.kind, *image_headers.size_of(packed.file, packed.kind)


class _Layout(NamedTuple):
    """How the pixels of an encoding lie.

    :param row: bytes a row takes for each of its pixels
    :param read: gives the picture
    :param lines: rows for every two rows of the picture; more than two where colour lies behind the grey
    :param even: what width and height must be multiples of
    :param least: pixels of the shortest side
    """

    row: int
    read: Callable[[Image], Pixels]
    lines: int = 2
    even: tuple[int, int] = (1, 1)
    least: int = 1


def _check(found: Image, layout: _Layout) -> None:
    size = f"{found.encoding} of {found.width}×{found.height} pixels"
    if found.width % layout.even[0] or found.height % layout.even[1]:
        raise Invalid(f"{size}: this encoding has pairs of pixels, so there is no odd size")
    if min(found.width, found.height) < layout.least:
        raise Invalid(f"{size}: this encoding needs at least {layout.least} pixels each way")
    row = found.width * layout.row
    if found.step < row:
        raise Invalid(f"{size} has rows of {row} bytes, but step says {found.step}")
    needed = found.step * found.height * layout.lines // 2
    if len(found.pixels) < needed:
        raise Damaged(f"{size} and step {found.step} takes {needed} bytes; there are {len(found.pixels)}")


def _plane(found: Image, dtype: str = "u1", channels: int = 1) -> npt.NDArray[Any]:
    """The values of all rows, where they lie: what pads the rows is stepped over."""
    kind = np.dtype(dtype).newbyteorder(">" if found.big_endian else "<")
    shape = (found.height, found.width, channels)
    strides = (found.step, kind.itemsize * channels, kind.itemsize)
    values: npt.NDArray[Any] = np.ndarray(shape, kind, found.pixels, strides=strides)
    return values[:, :, 0] if channels == 1 else values


def _eight_bit(channels: int, code: int | None = None) -> Callable[[Image], Pixels]:
    def read(found: Image) -> Pixels:
        return _converted(_plane(found, "u1", channels).view(np.uint8), code)

    return read


def _sixteen_bit(channels: int, code: int | None = None) -> Callable[[Image], Pixels]:
    def read(found: Image) -> Pixels:
        values = _plane(found, "u2", channels).astype(np.uint16)
        return _converted(cv2.convertScaleAbs(values, alpha=255 / 65535).astype(np.uint8, copy=False), code)

    return read


def _bayer8(code: int) -> _Layout:
    return _Layout(1, _eight_bit(1, code), least=_MOSAIC)


def _bayer16(code: int) -> _Layout:
    return _Layout(2, _sixteen_bit(1, code), least=_MOSAIC)


def _converted(pixels: Pixels, code: int | None) -> Pixels:
    return pixels if code is None else cv2.cvtColor(pixels, code).astype(np.uint8, copy=False)


def _millimetres(found: Image) -> Pixels:
    """Depth in millimetres, 0 where nothing was measured (REP 118)."""
    return depth.coloured(_plane(found, "u2"))


def _metres(found: Image) -> Pixels:
    """Depth in metres, NaN or infinite where nothing was measured (REP 118)."""
    return depth.coloured(depth.whole_millimetres(_plane(found, "f4")))


def _light(channels: int) -> Callable[[Image], Pixels]:
    """Blue, green and red from 0 to 1, what is below and above as these; NaN is black.

    Nothing says what such numbers mean; this is what renderers and OpenCV make of them. The scale is fixed.
    """

    def read(found: Image) -> Pixels:
        values = np.nan_to_num(_plane(found, "f4", channels)[:, :, :3], nan=0.0, posinf=1.0, neginf=0.0)
        shown: Pixels = np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
        return shown

    return read


def _pairs_behind(code: int) -> Callable[[Image], Pixels]:
    """Grey, then a pair of U and V for every four pixels."""

    def read(found: Image) -> Pixels:
        return _converted(_plane(found._replace(height=found.height * 3 // 2)).view(np.uint8), code)

    return read


def _i420(found: Image) -> Pixels:
    """Grey, then U and then V for every four pixels, in rows of half the step."""
    height, width, half = found.height, found.width, found.step // 2
    shape, strides = (2, height // 2, width // 2), (half * height // 2, half, 1)
    behind: npt.NDArray[np.uint8] = np.ndarray(
        shape, np.uint8, found.pixels[found.step * height :], strides=strides
    )
    planes = np.concatenate((_plane(found).view(np.uint8).ravel(), behind.ravel()))
    return _converted(planes.reshape(height * 3 // 2, width), cv2.COLOR_YUV2BGR_I420)


_FROM_YUV = np.array(
    [
        [1.164, 2.018, 0.0, -1.164 * 16 - 2.018 * 128],
        [1.164, -0.391, -0.813, -1.164 * 16 + (0.391 + 0.813) * 128],
        [1.164, 0.0, 1.596, -1.164 * 16 - 1.596 * 128],
    ]
)
"""Y, U, V to B, G, R (ITU-R BT.601, Y from 16 to 235), as OpenCV has it for the other encodings of this kind."""


def _nv24(found: Image) -> Pixels:
    """Grey, then a pair U, V for every pixel. OpenCV knows no such encoding."""
    grey = _plane(found)
    behind = found._replace(pixels=found.pixels[found.step * found.height :], step=2 * found.step)
    yuv = cv2.merge((grey.view(np.uint8), *cv2.split(_plane(behind, channels=2).view(np.uint8))))
    return cv2.transform(yuv, _FROM_YUV).astype(np.uint8, copy=False)


_MOSAIC = 3
"""OpenCV makes black of less each way."""
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
    "32FC3": _Layout(12, _light(3)),
    "32FC4": _Layout(16, _light(4)),
    "bayer_rggb8": _bayer8(cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr8": _bayer8(cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg8": _bayer8(cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg8": _bayer8(cv2.COLOR_BayerGRBG2BGR),
    "bayer_rggb16": _bayer16(cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr16": _bayer16(cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg16": _bayer16(cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg16": _bayer16(cv2.COLOR_BayerGRBG2BGR),
    # The names of old mean the same.
    "uyvy": _Layout(2, _eight_bit(2, cv2.COLOR_YUV2BGR_UYVY), even=_PAIRS),
    "yuv422": _Layout(2, _eight_bit(2, cv2.COLOR_YUV2BGR_UYVY), even=_PAIRS),
    "yuyv": _Layout(2, _eight_bit(2, cv2.COLOR_YUV2BGR_YUY2), even=_PAIRS),
    "yuv422_yuy2": _Layout(2, _eight_bit(2, cv2.COLOR_YUV2BGR_YUY2), even=_PAIRS),
    "nv12": _Layout(1, _pairs_behind(cv2.COLOR_YUV2BGR_NV12), lines=3, even=_FOURS),
    "nv21": _Layout(1, _pairs_behind(cv2.COLOR_YUV2BGR_NV21), lines=3, even=_FOURS),
    "yuv420": _Layout(1, _i420, lines=3, even=_FOURS),
    "i420": _Layout(1, _i420, lines=3, even=_FOURS),
    "nv24": _Layout(1, _nv24, lines=6),
}

ENCODINGS = tuple(_LAYOUTS)
"""Of sensor_msgs/msg/Image, those that can be shown. Of image_encodings.hpp the others say nothing of light or
distance: two values a pixel, signed ones, and doubles."""
