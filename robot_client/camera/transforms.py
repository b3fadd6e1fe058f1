"""What is done to a picture on its way: crop, rotate, invert, scale, and time burned in, in this order (SPEC 2.4)."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone

import cv2

from relay_protocol.errors import Invalid
from relay_protocol.limits import PICTURE_SIDE
from relay_protocol.link import VideoSettings
from robot_client.camera.formats import Pixels

ENLARGED = 1 << 23
"""Most pixels a picture may be enlarged to: whoever may view must not make the robot spend its memory on nothing."""

_TURNS = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_LETTERS = (0.45, 1.2)
"""Least and greatest scale of the font: under the first a 3 is an 8 once JPEG went over it."""
_LARGE = 900
"""Height of a picture, pixels, for which the font has its natural size."""


@dataclass(frozen=True)
class TransformPlan:
    """The edits for pictures of one size.

    :param width: of what comes out, pixels
    :param height: of what comes out, pixels
    :param crop: x, y, width, height of the part that is shown, within the camera's picture
    :param turn: clockwise, degrees
    :param stamp: whether the time is burned in
    :param touches: whether anything is done at all
    """

    width: int
    height: int
    crop: tuple[int, int, int, int]
    turn: int
    stamp: bool
    touches: bool

    def apply(self, pixels: Pixels, stamp: float) -> Pixels:
        """Edit one picture; what is given is not changed, and may come back itself.

        :param pixels: of the size the plan was made for, colour or grey
        :param stamp: Unix time the picture is of, seconds
        """
        x, y, width, height = self.crop
        shown = pixels[y : y + height, x : x + width]
        shown = _turned(_scaled(shown, *_turned_size(self.width, self.height, self.turn)), self.turn)
        if self.stamp:
            shown = shown.copy()
            _burn_in(shown, stamp)
        return shown


def plan_transforms(settings: VideoSettings, width: int, height: int, scale: float = 1.0) -> TransformPlan:
    """What has to be done so that pictures come out as they are wanted.

    :param width: of the camera's picture, pixels
    :param height: of the camera's picture, pixels
    :param scale: 0 to 1, by how much each side is smaller than it is wanted, because the uplink is thin
    :raises Invalid: the crop shows nothing of the picture, or what comes out would be too large
    """
    crop = _crop(settings.crop, width, height)
    turn = (settings.rotate + 180 * settings.invert) % 360
    wide, high = _wanted(settings, *_turned_size(crop[2], crop[3], turn))
    if wide * high > max(ENLARGED, crop[2] * crop[3]):
        raise Invalid(
            f"the picture would have {wide}×{high} pixels; none is enlarged beyond {ENLARGED} in all"
        )
    least = step = 2 if settings.codec == "h264" else 1
    out = [max(least, round(side * min(scale, 1.0)) // step * step) for side in (wide, high)]
    whole = crop == (0, 0, width, height)
    touches = settings.stamp or turn != 0 or not whole or out != [width, height]
    return TransformPlan(out[0], out[1], crop, turn, settings.stamp, touches)


def _crop(wanted: tuple[int, int, int, int], width: int, height: int) -> tuple[int, int, int, int]:
    x, y, wide, high = wanted
    if not any(wanted):
        return 0, 0, width, height
    if not wide or not high:
        raise Invalid(f"crop {x},{y},{wide},{high} has no width or no height")
    if x >= width or y >= height:
        raise Invalid(
            f"crop {x},{y},{wide},{high} lies outside the camera's picture of {width}×{height} pixels"
        )
    return x, y, min(wide, width - x), min(high, height - y)


def _wanted(settings: VideoSettings, width: int, height: int) -> tuple[int, int]:
    """The size to come out, from that of the part that is shown, turned."""
    wide = settings.width or (round(width * settings.height / height) if settings.height else width)
    high = settings.height or (round(height * settings.width / width) if settings.width else height)
    if max(wide, high) > PICTURE_SIDE:
        raise Invalid(
            f"the picture would have {wide}×{high} pixels; each side may have at most {PICTURE_SIDE}"
        )
    return max(1, wide), max(1, high)


def _turned_size(width: int, height: int, turn: int) -> tuple[int, int]:
    return (height, width) if turn % 180 else (width, height)


def _turned(pixels: Pixels, turn: int) -> Pixels:
    return cv2.rotate(pixels, _TURNS[turn]).astype(pixels.dtype, copy=False) if turn else pixels


def _scaled(pixels: Pixels, width: int, height: int) -> Pixels:
    """Scaled before it is turned, which gives the same and leaves less to turn."""
    high, wide = pixels.shape[:2]
    if (wide, high) == (width, height):
        return pixels
    # Averaging keeps thin lines when a picture shrinks, and gives steps when it grows.
    method = cv2.INTER_AREA if width <= wide and height <= high else cv2.INTER_LINEAR
    return cv2.resize(pixels, (width, height), interpolation=method).astype(pixels.dtype, copy=False)


def _burn_in(pixels: Pixels, stamp: float) -> None:
    """White on black into the upper left corner: the longest form that fits, in letters as large as it may have."""
    clock = datetime.fromtimestamp(stamp, tz=timezone.utc)
    time = f"{clock:%H:%M:%S}"
    parts = f"{time}.{clock.microsecond // 1000:03d}"
    room = pixels.shape[1] - 4
    size = min(max(pixels.shape[0] / _LARGE, _LETTERS[0]), _LETTERS[1])
    for text in (f"{clock:%Y-%m-%d} {parts} UTC", f"{parts} UTC", parts, time):
        (width, height), below = cv2.getTextSize(text, _FONT, size, _thickness(size))
        if width <= room:
            break
    else:
        size *= room / width
        (width, height), below = cv2.getTextSize(text, _FONT, size, 1)
    cv2.rectangle(pixels, (0, 0), (width + 4, height + below + 2), (0, 0, 0), cv2.FILLED)
    cv2.putText(pixels, text, (2, height + 2), _FONT, size, (255, 255, 255), _thickness(size), cv2.LINE_AA)


def _thickness(size: float) -> int:
    return 2 if size >= 0.8 else 1
