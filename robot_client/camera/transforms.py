"""Transforms of an image: crop, rotate, invert, scale, burn the time in, in this order (SPEC 2.4)."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone

import cv2

from relay_protocol.errors import Invalid
from relay_protocol.limits import IMAGE_SIDE
from relay_protocol.link import VideoSettings
from robot_client.camera.formats import Pixels

MAX_ENLARGED = 1 << 23
"""Most pixels of an enlarged image, so that a viewer can't exhaust the robot's memory."""

_ROTATIONS = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_FONT_SCALES = (0.45, 1.2)
"""Least and greatest scale of the font: descent the first, JPEG makes a 3 look like an 8."""
_FONT_HEIGHT = 900
"""Height of an image, pixels, at which the font has scale 1."""


@dataclass(frozen=True)
class TransformPlan:
    """The transforms for images of one size.

    :param width: of the result, pixels
    :param height: of the result, pixels
    :param crop: x, y, width, height of the shown part within the camera's image
    :param rotation: clockwise, degrees
    :param stamp: whether the time is burned in
    :param changes: whether the result differs from the image
    """

    width: int
    height: int
    crop: tuple[int, int, int, int]
    rotation: int
    stamp: bool
    changes: bool

    def apply(self, pixels: Pixels, stamp: float) -> Pixels:
        """Transform one image. The argument is not modified, but may be returned.

        :param pixels: of the size the plan was made for, colour or grey
        :param stamp: time of the image, Unix seconds
        """
        x, y, width, height = self.crop
        shown = pixels[y : y + height, x : x + width]
        shown = _rotate(_scale(shown, _rotated_size(self.width, self.height, self.rotation)), self.rotation)
        if self.stamp:
            shown = shown.copy()
            _burn_in(shown, stamp)
        return shown


def plan_transforms(settings: VideoSettings, width: int, height: int, scale: float = 1.0) -> TransformPlan:
    """The transforms that give images as requested.

    :param width: of the camera's image, pixels
    :param height: of the camera's image, pixels
    :param scale: 0 to 1, further factor for each side, for a slow uplink
    :raises Invalid: the crop lies outside the image, or the result would be too large
    """
    crop = _crop(settings.crop, width, height)
    rotation = (settings.rotate + 180 * settings.invert) % 360
    width_out, height_out = _requested_size(settings, _rotated_size(crop[2], crop[3], rotation))
    if width_out * height_out > max(MAX_ENLARGED, crop[2] * crop[3]):
        raise Invalid(
            f"the image would have {width_out}×{height_out} pixels; the most after enlarging is {MAX_ENLARGED}"
        )
    least = step = 2 if settings.codec == "h264" else 1
    out = [max(least, round(side * min(scale, 1.0)) // step * step) for side in (width_out, height_out)]
    whole = crop == (0, 0, width, height)
    changes = settings.stamp or rotation != 0 or not whole or out != [width, height]
    return TransformPlan(out[0], out[1], crop, rotation, settings.stamp, changes)


def _crop(wanted: tuple[int, int, int, int], width: int, height: int) -> tuple[int, int, int, int]:
    x, y, wide, high = wanted
    if not any(wanted):
        return 0, 0, width, height
    if not wide or not high:
        raise Invalid(f"crop {x},{y},{wide},{high} has width 0 or height 0")
    if x >= width or y >= height:
        raise Invalid(
            f"crop {x},{y},{wide},{high} lies outside the camera's image of {width}×{height} pixels"
        )
    return x, y, min(wide, width - x), min(high, height - y)


def _requested_size(settings: VideoSettings, size: tuple[int, int]) -> tuple[int, int]:
    """Size of the result.

    :param size: of the cropped and rotated image
    """
    width, height = size
    wide = settings.width or (round(width * settings.height / height) if settings.height else width)
    high = settings.height or (round(height * settings.width / width) if settings.width else height)
    if max(wide, high) > IMAGE_SIDE:
        raise Invalid(f"the image would have {wide}×{high} pixels; each side may have at most {IMAGE_SIDE}")
    return max(1, wide), max(1, high)


def _rotated_size(width: int, height: int, rotation: int) -> tuple[int, int]:
    return (height, width) if rotation % 180 else (width, height)


def _rotate(pixels: Pixels, rotation: int) -> Pixels:
    return cv2.rotate(pixels, _ROTATIONS[rotation]).astype(pixels.dtype, copy=False) if rotation else pixels


def _scale(pixels: Pixels, size: tuple[int, int]) -> Pixels:
    """Scale before rotating, which gives the same result and leaves fewer pixels to rotate."""
    width, height = size
    high, wide = pixels.shape[:2]
    if (wide, high) == (width, height):
        return pixels
    # Area averaging keeps thin lines in smaller images, but gives steps in larger ones.
    method = cv2.INTER_AREA if width <= wide and height <= high else cv2.INTER_LINEAR
    return cv2.resize(pixels, (width, height), interpolation=method).astype(pixels.dtype, copy=False)


def _burn_in(pixels: Pixels, stamp: float) -> None:
    """Write the time white on black into the upper left corner, in the longest form that fits."""
    clock = datetime.fromtimestamp(stamp, tz=timezone.utc)
    time = f"{clock:%H:%M:%S}"
    parts = f"{time}.{clock.microsecond // 1000:03d}"
    room = pixels.shape[1] - 4
    size = min(max(pixels.shape[0] / _FONT_HEIGHT, _FONT_SCALES[0]), _FONT_SCALES[1])
    for text in (f"{clock:%Y-%m-%d} {parts} UTC", f"{parts} UTC", parts, time):
        (width, height), descent = cv2.getTextSize(text, _FONT, size, _thickness(size))
        if width <= room:
            break
    else:
        size *= room / width
        (width, height), descent = cv2.getTextSize(text, _FONT, size, 1)
    cv2.rectangle(pixels, (0, 0), (width + 4, height + descent + 2), (0, 0, 0), cv2.FILLED)
    cv2.putText(pixels, text, (2, height + 2), _FONT, size, (255, 255, 255), _thickness(size), cv2.LINE_AA)


def _thickness(size: float) -> int:
    return 2 if size >= 0.8 else 1
