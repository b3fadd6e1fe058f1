"""A camera of the kernel (V4L2), and how it is told to give its pictures."""

from __future__ import annotations

from typing import NamedTuple
from urllib.parse import parse_qsl

from relay_protocol.errors import Invalid
from relay_protocol.limits import PICTURE_SIDE

V4L2 = "v4l2:"

FASTEST = 240
"""Most pictures per second that may be asked for."""

_MOST = {"width": PICTURE_SIDE, "height": PICTURE_SIDE, "fps": FASTEST}
_UNITS = {"fps": "pictures per second"}
_EXAMPLE = "v4l2:/dev/video0?width=1280&height=720&fps=30&format=MJPG"


class CameraDevice(NamedTuple):
    """A device, and what is asked of its driver, which takes what comes nearest; 0 and empty ask for nothing.

    :param path: of the device
    :param width: pixels; 0 as ``height`` is
    :param height: pixels
    :param fps: pictures per second
    :param format: of its pixels or files, by its four letters: ``MJPG``, ``YUYV``, ``Y16 ``, …
    """

    path: str
    width: int = 0
    height: int = 0
    fps: int = 0
    format: str = ""


def read_device(source: str) -> CameraDevice:
    """Read ``v4l2:/dev/video0?width=1280&height=720&fps=30&format=MJPG``; all behind the path may be left out.

    :raises Invalid: says what is wrong there, and what there may be
    """
    path, _, query = source.removeprefix(V4L2).partition("?")
    if not query:  # which not every Python takes as nothing
        return CameraDevice(path)
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True)
    except ValueError:
        raise Invalid(f"what stands behind the '?' can't be read; write {_EXAMPLE}") from None
    found = dict(pairs)
    unknown = [name for name in found if name not in (*_MOST, "format")]
    if unknown:
        raise Invalid(f"'{unknown[0]}' can't be set; there are width, height, fps and format")
    if len(found) < len(pairs):
        raise Invalid("each of width, height, fps and format may stand there once")
    if ("width" in found) != ("height" in found):
        # OpenCV changes nothing before it knows both.
        raise Invalid("width and height are set together or not at all")
    width, height, fps = (_number(name, found[name]) if name in found else 0 for name in _MOST)
    return CameraDevice(path, width, height, fps, _format(found["format"]) if "format" in found else "")


def _number(name: str, text: str) -> int:
    # Nothing but digits, and few: int() takes more forms, and time for long ones.
    number = int(text) if text.isascii() and text.isdigit() and len(text) < 9 else 0
    if not 1 <= number <= _MOST[name]:
        raise Invalid(
            f"{name} has to be 1 to {_MOST[name]} {_UNITS.get(name, 'pixels')}, as a whole number; it is '{text}'"
        )
    return number


def _format(text: str) -> str:
    if len(text) != 4 or not (text.isascii() and text.isprintable()):
        raise Invalid(f"format has to be four letters, such as MJPG or YUYV; it is '{text}'")
    return text
