"""Cameras, as the HTTP API answers with them.

The parameters of a stream, with the names of web_video_server (SPEC 1.8).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Literal, TypedDict, TypeVar
from urllib.parse import parse_qs

from relay_protocol import limits, link
from relay_protocol.errors import Invalid
from relay_protocol.link import VideoSettings
from relay_protocol.text import is_printable


class ShownStream(TypedDict):
    """How a camera is shown now."""

    viewers: int
    state: str
    settings: VideoSettings
    stream_status: dict[str, Any] | None


class CameraInfo(TypedDict):
    """A camera. Unknown properties are null until it has been watched once.

    :param seen: Unix seconds at the robot when it was like this
    """

    name: str
    type: str
    encoding: str | None
    width: int | None
    height: int | None
    fps: float | None
    seen: float | None
    streams: list[ShownStream]


class CameraAddresses(TypedDict):
    """Paths of the images of a camera (SPEC 1.8).

    :param viewer: a page with the stream in it
    """

    snapshot: str
    stream: str
    viewer: str
    websocket: str


class AddressedCamera(CameraInfo):
    """A camera with the paths of its images."""

    addresses: CameraAddresses


class CameraList(TypedDict):
    """The cameras the caller may view."""

    cameras: list[CameraInfo]


T = TypeVar("T")

FIELDS = 64
"""Most parameters of a request, including unknown ones."""

MOST_FPS = 1000

_QUALITY = link.VideoSettings().quality

Kind = Literal["stream", "snapshot", "ws"]

_TYPES: dict[Kind, tuple[str, ...]] = {
    "stream": ("mjpeg", "ros_compressed", "png"),
    "snapshot": ("mjpeg", "ros_compressed", "png"),
    "ws": ("mjpeg", "ros_compressed"),
}
_CODECS: dict[Kind, tuple[link.Codec, ...]] = {
    "stream": ("jpeg",),
    "snapshot": ("jpeg",),
    "ws": ("jpeg", "h264"),
}
_QOS: dict[str, Literal["", "sensor_data", "default"]] = {
    "": "",
    "default": "default",
    "sensor_data": "sensor_data",
    # The system default: the subscription takes what the publisher offers.
    "system_default": "",
}
_TRANSPORTS: dict[str, Literal["", "raw", "compressed"]] = {"": "", "raw": "raw", "compressed": "compressed"}
_ANGLES: dict[str, Literal[0, 90, 180, 270]] = {"0": 0, "90": 90, "180": 180, "270": 270}
_SWITCH = {"": True, "true": True, "1": True, "false": False, "0": False}
_NO = frozenset({"false", "0", "no", "off"})

_WHOLE = re.compile(r"[0-9]{1,9}", re.ASCII)
_DECIMAL = re.compile(r"[0-9]{1,9}(\.[0-9]{1,9})?", re.ASCII)


@dataclass(frozen=True)
class StreamParameters:
    """A camera, and the parameters of its stream."""

    camera: str
    settings: link.VideoSettings


def parse_parameters(query: str, kind: Kind) -> StreamParameters:
    """Parse the query of a request. Unknown parameters are ignored.

    :param query: the text after the question mark
    :param kind: not every value is allowed everywhere
    :raises Invalid: a value is not allowed
    """
    values = _Query(query)
    codec = values.choice("codec", {each: each for each in _CODECS[kind]}, "jpeg")
    transport = values.choice("default_transport", _TRANSPORTS, "")
    form = values.choice("type", {each: each for each in _TYPES[kind]}, "mjpeg")
    if form == "ros_compressed":
        if transport == "raw":
            raise Invalid("'type=ros_compressed' and 'default_transport=raw' contradict each other")
        transport = "compressed"
    return StreamParameters(
        _camera(values.text("topic", "")),
        link.VideoSettings(
            width=values.pixels("width"),
            height=values.pixels("height"),
            # PNG is lossless; elsewhere its quality means how long it is compressed.
            quality=_QUALITY if form == "png" else max(1, values.integer("quality", _QUALITY, 0, 100)),
            fps=values.decimal("fps", 0, MOST_FPS),
            crop=_crop(values.text("crop", "0,0,0,0")),
            rotate=values.choice("rotate", _ANGLES, 0),
            invert=values.is_set("invert"),
            stamp=values.choice("stamp", _SWITCH, False),
            codec="png" if form == "png" else codec,
            qos=values.choice("qos_profile", _QOS, ""),
            transport=transport,
        ),
    )


class _Query:
    def __init__(self, query: str) -> None:
        try:
            self._all = parse_qs(query, keep_blank_values=True, errors="strict", max_num_fields=FIELDS)
        except UnicodeDecodeError:
            raise Invalid("the parameters are not UTF-8") from None
        except ValueError:
            raise Invalid(f"there are more than {FIELDS} parameters") from None

    def text(self, name: str, default: str) -> str:
        """The value of a parameter that may occur once."""
        values = self._all.get(name, [default])
        if len(values) > 1:
            raise Invalid(f"'{name}' occurs {len(values)} times; give it once")
        return values[0]

    def choice(self, name: str, known: dict[str, T], default: T) -> T:
        if name not in self._all:
            return default
        found = known.get(self.text(name, ""))
        if found is None:
            words = ", ".join(f"'{each}'" for each in known if each)
            raise Invalid(f"'{name}' must be one of {words}{'' if '' not in known else ', or empty'}")
        return found

    def is_set(self, name: str) -> bool:
        """Whether a switch is given with any value, as in web_video_server, except one that means no."""
        return name in self._all and self.text(name, "").lower() not in _NO

    def pixels(self, name: str) -> int:
        """Pixels. The value -1, "the camera's own size" in web_video_server, becomes 0."""
        return 0 if self.text(name, "0") == "-1" else self.integer(name, 0, 0, limits.IMAGE_SIDE)

    def integer(self, name: str, default: int, least: int, most: int) -> int:
        text = self.text(name, str(default))
        if not _WHOLE.fullmatch(text) or not least <= int(text) <= most:
            raise Invalid(f"'{name}' must be a whole number from {least} to {most}")
        return int(text)

    def decimal(self, name: str, default: float, most: float) -> float:
        text = self.text(name, str(default))
        if not _DECIMAL.fullmatch(text) or float(text) > most:
            raise Invalid(f"'{name}' must be a number from 0 to {most:g}")
        return float(text)


def _camera(topic: str) -> str:
    """A camera's name; the leading slash may be missing."""
    if not topic.strip("/"):
        raise Invalid("'topic' is missing: the name of the camera")
    name = topic if topic.startswith("/") else f"/{topic}"
    if len(name) > limits.NAME or not is_printable(name):
        raise Invalid(f"'topic' must be a name of at most {limits.NAME} characters")
    return name


def _crop(text: str) -> Any:
    numbers = text.split(",")
    sides = [int(each) for each in numbers if _WHOLE.fullmatch(each)]
    if len(numbers) != 4 or len(sides) != 4 or max(sides) > limits.IMAGE_SIDE:
        raise Invalid(f"'crop' must be x,y,width,height: four whole numbers up to {limits.IMAGE_SIDE}")
    if any(sides) and not (sides[2] and sides[3]):
        raise Invalid("'crop' has a width or height of 0")
    return tuple(sides)
