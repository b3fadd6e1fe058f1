"""The setting of a V4L2 camera: device path and requested format."""

from __future__ import annotations

from typing import NamedTuple
from urllib.parse import parse_qsl

from relay_protocol.errors import Invalid
from relay_protocol.limits import IMAGE_SIDE

V4L2 = "v4l2:"

MAX_FPS = 240

_MAXIMA = {"width": IMAGE_SIDE, "height": IMAGE_SIDE, "fps": MAX_FPS}
_UNITS = {"fps": "frames per second"}
_EXAMPLE = "v4l2:/dev/video0?width=1280&height=720&fps=30&format=MJPG"


class CameraDevice(NamedTuple):
    """A device and the format requested from its driver, which uses the nearest it has. 0 and empty request
    nothing.

    :param width: pixels; 0 if and only if ``height`` is
    :param height: pixels
    :param fps: frames per second
    :param format: FourCC of its pixels or files: ``MJPG``, ``YUYV``, ``Y16 ``, …
    """

    path: str
    width: int = 0
    height: int = 0
    fps: int = 0
    format: str = ""


def read_device(source: str) -> CameraDevice:
    """Parse ``v4l2:/dev/video0?width=1280&height=720&fps=30&format=MJPG``; everything after the path is
    optional.

    :raises Invalid: a part is wrong; names it and what is allowed
    """
    path, _, query = source.removeprefix(V4L2).partition("?")
    if not query:  # an empty query is an error to some versions of Python
        return CameraDevice(path)
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True)
    except ValueError:
        raise Invalid(f"the part after '?' can't be read; write {_EXAMPLE}") from None
    found = dict(pairs)
    unknown = [name for name in found if name not in (*_MAXIMA, "format")]
    if unknown:
        raise Invalid(f"'{unknown[0]}' is not a setting; there are width, height, fps and format")
    if len(found) < len(pairs):
        raise Invalid("each of width, height, fps and format may occur once")
    if ("width" in found) != ("height" in found):
        # OpenCV changes nothing before both are set.
        raise Invalid("set both width and height, or neither")
    width, height, fps = (_number(name, found[name]) if name in found else 0 for name in _MAXIMA)
    return CameraDevice(path, width, height, fps, _format(found["format"]) if "format" in found else "")


def _number(name: str, text: str) -> int:
    # Only digits, and few: int() accepts more forms, and is slow for long ones.
    number = int(text) if text.isascii() and text.isdigit() and len(text) < 9 else 0
    if not 1 <= number <= _MAXIMA[name]:
        raise Invalid(
            f"{name} must be a whole number from 1 to {_MAXIMA[name]} ({_UNITS.get(name, 'pixels')}); it is '{text}'"
        )
    return number


def _format(text: str) -> str:
    if len(text) != 4 or not (text.isascii() and text.isprintable()):
        raise Invalid(f"format must be a FourCC such as MJPG or YUYV; it is '{text}'")
    return text
