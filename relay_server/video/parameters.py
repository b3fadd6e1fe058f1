"""What a viewer asks for, in the words of web_video_server (SPEC section 1.8)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Literal, TypeVar
from urllib.parse import parse_qs

from relay_protocol import limits, link
from relay_protocol.errors import Invalid
from relay_protocol.text import legible

T = TypeVar("T")

FIELDS = 64
"""Most parameters of a request, also of those that are passed over."""

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
    # Whatever ROS finds best: that is what the publisher offers.
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
    """A camera, and how it is wanted."""

    camera: str
    settings: link.VideoSettings


def parse_parameters(query: str, kind: Kind) -> StreamParameters:
    """Read the query of a request. What is not known is passed over.

    :param query: what stands behind the question mark
    :param kind: what is asked: not everything can be had everywhere
    :raises Invalid: something makes no sense; says what it may be
    """
    given = _Given(query)
    codec = given.one_of("codec", {each: each for each in _CODECS[kind]}, "jpeg")
    transport = given.one_of("default_transport", _TRANSPORTS, "")
    form = given.one_of("type", {each: each for each in _TYPES[kind]}, "mjpeg")
    if form == "ros_compressed":
        if transport == "raw":
            raise Invalid("'type=ros_compressed' and 'default_transport=raw' contradict each other")
        transport = "compressed"
    return StreamParameters(
        _camera(given.text("topic", "")),
        link.VideoSettings(
            width=given.side("width"),
            height=given.side("height"),
            # PNG loses nothing, and what it may mean of it elsewhere is how long it is compressed.
            quality=_QUALITY if form == "png" else max(1, given.whole("quality", _QUALITY, 0, 100)),
            fps=given.decimal("fps", 0, MOST_FPS),
            crop=_crop(given.text("crop", "0,0,0,0")),
            rotate=given.one_of("rotate", _ANGLES, 0),
            invert=given.there("invert"),
            stamp=given.one_of("stamp", _SWITCH, False),
            codec="png" if form == "png" else codec,
            qos=given.one_of("qos_profile", _QOS, ""),
            transport=transport,
        ),
    )


class _Given:
    """The parameters as they came."""

    def __init__(self, query: str) -> None:
        try:
            self._all = parse_qs(query, keep_blank_values=True, errors="strict", max_num_fields=FIELDS)
        except UnicodeDecodeError:
            raise Invalid("the parameters are not UTF-8") from None
        except ValueError:
            raise Invalid(f"there are more than {FIELDS} parameters") from None

    def text(self, name: str, default: str) -> str:
        """What was given under a name, once at most."""
        values = self._all.get(name, [default])
        if len(values) > 1:
            raise Invalid(f"'{name}' is there {len(values)} times")
        return values[0]

    def one_of(self, name: str, known: dict[str, T], default: T) -> T:
        """One of several words."""
        if name not in self._all:
            return default
        found = known.get(self.text(name, ""))
        if found is None:
            words = ", ".join(f"'{each}'" for each in known if each)
            raise Invalid(f"'{name}' is one of {words}{'' if '' not in known else ', or empty'}")
        return found

    def there(self, name: str) -> bool:
        """Whether a switch is there: with any value, as web_video_server takes it, but one that says no."""
        return name in self._all and self.text(name, "").lower() not in _NO

    def side(self, name: str) -> int:
        """Pixels; those below 0, which web_video_server has for "the camera's own", are 0."""
        return 0 if self.text(name, "0") == "-1" else self.whole(name, 0, 0, limits.PICTURE_SIDE)

    def whole(self, name: str, default: int, least: int, most: int) -> int:
        """A whole number."""
        text = self.text(name, str(default))
        if not _WHOLE.fullmatch(text) or not least <= int(text) <= most:
            raise Invalid(f"'{name}' is a whole number from {least} to {most}")
        return int(text)

    def decimal(self, name: str, default: float, most: float) -> float:
        """A number from 0 on."""
        text = self.text(name, str(default))
        if not _DECIMAL.fullmatch(text) or float(text) > most:
            raise Invalid(f"'{name}' is a number from 0 to {most:g}")
        return float(text)


def _camera(topic: str) -> str:
    """A camera's name; one without slash in front is taken as if it had it."""
    if not topic.strip("/"):
        raise Invalid("'topic' is missing: the name of the camera")
    name = topic if topic.startswith("/") else f"/{topic}"
    if len(name) > limits.NAME or not legible(name):
        raise Invalid(f"'topic' is a name of at most {limits.NAME} characters")
    return name


def _crop(text: str) -> Any:
    numbers = text.split(",")
    sides = [int(each) for each in numbers if _WHOLE.fullmatch(each)]
    if len(numbers) != 4 or len(sides) != 4 or max(sides) > limits.PICTURE_SIDE:
        raise Invalid(f"'crop' is x,y,width,height: four whole numbers up to {limits.PICTURE_SIDE}")
    if any(sides) and not (sides[2] and sides[3]):
        raise Invalid("'crop' has a width or height of 0")
    return tuple(sides)
