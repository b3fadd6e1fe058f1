"""The simulated camera: a first-person image of the world, cast column by column, drawn by OpenCV."""

from __future__ import annotations

import math
from datetime import datetime, timezone

import cv2
import numpy as np
import numpy.typing as npt

from robot_client.sim import textures
from robot_client.sim.charger_plates import CameraView, ChargerPlates
from robot_client.sim.table_view import draw_tables
from robot_client.sim.world import Floats, Hits, Pose, World

WIDTH, HEIGHT = 640, 480
"""Default size, pixels."""
VIEW_ANGLE = math.radians(75)
"""Horizontal, radians."""
CAMERA_HEIGHT = 0.38
"""Metres over the floor."""
WALL_HEIGHT = 1.0
"""Metres."""

_TILE_SPAN = 4.0
"""Metres covered by the floor texture before it repeats."""
_REPEATS = 8
"""Repetitions of the texture side by side; at its end, 14 m away or more, fog hides most of the floor."""
_NEAREST = 0.05
_FONT = cv2.FONT_HERSHEY_DUPLEX
_FONT_SCALE = 0.6

Image = npt.NDArray[np.uint8]


class SimCamera:
    """Draws the robot's view. It has buffers of its own, so use one object from one thread at a time.

    :param width: pixels
    :param height: pixels
    """

    def __init__(self, world: World, width: int = WIDTH, height: int = HEIGHT) -> None:
        self._world = world
        self._width, self._height, self._horizon = width, height, height // 2
        self._focal = width / 2 / math.tan(VIEW_ANGLE / 2)  # pixels
        offset = np.arange(width) + 0.5 - width / 2
        self._ray_angles = -np.arctan(offset / self._focal)
        self._straighten = np.cos(self._ray_angles)
        # OpenCV can repeat a texture by itself (BORDER_WRAP), but takes twice as long for it.
        self._tiles = np.tile(textures.floor_tiles(), (_REPEATS, _REPEATS))
        self._far_tiles = cv2.mean(self._tiles)
        self._textures = textures.wall_textures()
        self._panorama_columns = round(math.tau / VIEW_ANGLE * width)
        sky = textures.panorama(self._panorama_columns, self._horizon)
        self._panorama = np.concatenate((sky, sky[:, : width + 1]), axis=1)
        self._colours = np.array([appearance.colour for appearance in world.appearances], dtype=np.float32)
        self._styles = np.array([appearance.texture for appearance in world.appearances])
        rows = np.arange(height - self._horizon, dtype=np.float64) + 0.5
        clear = np.exp(-CAMERA_HEIGHT * self._focal / rows / (textures.FOG_LENGTH / 3))[:, None]
        self._floor_gain = np.repeat(clear, width, axis=1).astype(np.float32)
        base = np.array(textures.FLOOR_TINT) * clear + np.array(textures.FOG) * (1 - clear)
        self._floor_base = np.repeat(base[:, None, :], width, axis=1).astype(np.uint8)
        self._columns = np.tile(np.arange(width, dtype=np.float32), (height, 1))
        self._rows = np.arange(height, dtype=np.float32)[:, None] + np.float32(0.5)
        self._view = CameraView(self._focal, self._horizon, CAMERA_HEIGHT)
        self._plates = ChargerPlates(world, self._view) if world.chargers else None

    def render(self, pose: Pose, speed: float, at: float) -> Image:
        """One image, BGR, shape (height, width, 3); the array is the caller's.

        :param speed: m/s, written into the image
        :param at: seconds since the epoch, written into the image as a UTC clock
        """
        frame = np.empty((self._height, self._width, 3), dtype=np.uint8)
        self._draw_sky(frame, pose)
        self._draw_floor(frame, pose)
        angles = pose.heading + self._ray_angles
        hits = self._world.cast(pose.x, pose.y, angles)
        depth = np.maximum(hits.distance * self._straighten, _NEAREST)
        self._draw_walls(frame, hits, depth)
        if self._plates is not None:
            self._plates.draw(frame, pose, hits, depth, np.exp(-hits.distance / textures.FOG_LENGTH))
        draw_tables(frame, self._world, self._view, (pose.x, pose.y), angles, hits.distance)
        draw_clock(frame, at)
        draw_speed(frame, speed)
        return frame

    def _draw_sky(self, frame: Image, pose: Pose) -> None:
        first = round((-pose.heading / math.tau) % 1.0 * self._panorama_columns)
        frame[: self._horizon] = self._panorama[:, first : first + self._width]

    def _draw_floor(self, frame: Image, pose: Pose) -> None:
        """Draw the floor: it is a plane, so one homography maps pixels to tiles."""
        ahead_x, ahead_y = math.cos(pose.heading), math.sin(pose.heading)
        right_x, right_y = ahead_y, -ahead_x
        lift, focal, half = CAMERA_HEIGHT, self._focal, self._width / 2
        # The robot's position on the texture, near its middle.
        x, y = (_REPEATS // 2 * _TILE_SPAN + at % _TILE_SPAN for at in (pose.x, pose.y))
        # row counted from the horizon is the homogeneous coordinate: distance = lift · focal / row
        to_floor = np.array(
            [
                [lift * right_x, x, lift * (focal * ahead_x - half * right_x) + 0.5 * x],
                [lift * right_y, y, lift * (focal * ahead_y - half * right_y) + 0.5 * y],
                [0.0, 1.0, 0.5],
            ]
        )
        scale = self._tiles.shape[0] / (_REPEATS * _TILE_SPAN)
        matrix = np.diag((scale, scale, 1.0)) @ to_floor
        tiles = cv2.warpPerspective(
            self._tiles,
            matrix,
            (self._width, self._height - self._horizon),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=self._far_tiles,
        )
        cv2.multiply(tiles, self._floor_gain, dst=tiles, dtype=cv2.CV_8U)
        cv2.add(cv2.cvtColor(tiles, cv2.COLOR_GRAY2BGR), self._floor_base, dst=frame[self._horizon :])

    def _draw_walls(self, frame: Image, hits: Hits, depth: Floats) -> None:
        top = self._horizon - (WALL_HEIGHT - CAMERA_HEIGHT) * self._focal / depth
        first = max(0, math.floor(top.min()))
        last = min(self._height, math.ceil(self._horizon + CAMERA_HEIGHT * self._focal / depth.min()))
        texels_per_row = (textures.TEXELS * depth / (WALL_HEIGHT * self._focal)).astype(np.float32)
        down = (self._rows[first:last] - top.astype(np.float32)) * texels_per_row - np.float32(0.5)
        # Pixels that are neither wall nor its edge must stay: map them outside the table.
        outside = (down < -0.5) | (down > textures.TEXELS - 0.5) | (hits.surface < 0)
        np.clip(down, 0, textures.TEXELS - 1, out=down)
        down[outside] = -10.0
        cv2.remap(
            self._wall_columns(hits),
            self._columns[first:last],
            down,
            cv2.INTER_LINEAR,
            dst=frame[first:last],
            borderMode=cv2.BORDER_TRANSPARENT,
        )

    def _wall_columns(self, hits: Hits) -> Image:
        """The painted texture column of each image column, shape (texels, width, 3)."""
        texel = (hits.along * textures.TEXELS).astype(np.int64) % textures.TEXELS
        pattern = self._textures[self._styles[hits.surface], texel].T
        clear = np.exp(-hits.distance / textures.FOG_LENGTH)
        light = ((0.45 + 0.55 * hits.facing) * clear)[:, None]
        haze = np.array(textures.FOG) * (1 - clear)[:, None]
        painted = pattern[:, :, None] * (self._colours[hits.surface] * light).astype(np.float32)
        painted += haze.astype(np.float32)
        table: Image = np.minimum(painted, 255.0, out=painted).astype(np.uint8)
        return table


def to_jpeg(frame: Image, quality: int = 80) -> bytes:
    """Encode a BGR image.

    :param quality: 1 to 100
    :raises ValueError: OpenCV couldn't encode it
    """
    done, encoded = cv2.imencode(".jpg", frame, (cv2.IMWRITE_JPEG_QUALITY, quality))
    if not done:
        raise ValueError("the image could not be encoded as JPEG")
    return encoded.tobytes()


def to_rgb(frame: Image) -> Image:
    """The same image, R, G, B instead of B, G, R."""
    return cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)  # type: ignore[return-value]  # OpenCV does not say that uint8 stays uint8


def draw_clock(frame: Image, at: float) -> None:
    """Write the time into the lower left corner of a image.

    :param frame: BGR, shape (height, width, 3)
    :param at: seconds since the epoch
    """
    clock = datetime.fromtimestamp(at, tz=timezone.utc)
    _caption(frame, f"{clock:%H:%M:%S}.{clock.microsecond // 1000:03d} UTC", 12)


def draw_speed(frame: Image, speed: float) -> None:
    """Write the speed into the lower right corner of a image.

    :param frame: BGR, shape (height, width, 3)
    :param speed: m/s
    """
    _caption(frame, f"{speed:+.2f} m/s", -118)


def _caption(frame: Image, text: str, x: int) -> None:
    """Write a text on a darker background, at a size that is the same share of the image for all image sizes.

    :param x: where it begins in a image of 640 × 480; less than zero: seen from the right edge
    """
    height, width = frame.shape[:2]
    scale = min(width / WIDTH, height / HEIGHT)
    font, stroke = scale * _FONT_SCALE, max(1, int(scale))
    left = round(x * scale) % width
    (long, high), descent = cv2.getTextSize(text, _FONT, font, stroke)
    edge, gap = round(8 * scale), round(6 * scale)
    plate = frame[height - high - descent - 2 * edge : height - edge, left - gap : left + long + gap]
    cv2.convertScaleAbs(plate, dst=plate, alpha=0.35)
    bottom = height - round(11 * scale) - descent
    cv2.putText(frame, text, (left, bottom), _FONT, font, (245, 245, 245), stroke, cv2.LINE_AA)
