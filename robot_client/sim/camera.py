"""The simulated camera: a first-person picture of the world, cast column by column, drawn by OpenCV."""

from __future__ import annotations

import math
from datetime import datetime, timezone

import cv2
import numpy as np
import numpy.typing as npt

from robot_client.sim import paint
from robot_client.sim.world import Hits, Pose, World

WIDTH, HEIGHT = 640, 480
VIEW_ANGLE = math.radians(75)
"""Horizontal, radians."""
FOCAL = WIDTH / 2 / math.tan(VIEW_ANGLE / 2)
"""Pixels."""
EYE_HEIGHT = 0.38
"""Metres over the floor."""
WALL_HEIGHT = 1.0
"""Metres."""

_HORIZON = HEIGHT // 2
_TILE_SPAN = 4.0
"""Metres covered by the floor texture before it repeats."""
_FOG_LENGTH = 26.0
"""Metres after which about two thirds of a thing's colour are lost."""
_NEAREST = 0.05
_FONT = cv2.FONT_HERSHEY_DUPLEX
_FONT_SCALE = 0.6

Image = npt.NDArray[np.uint8]


class Camera:
    """Draws what a robot sees. Keeps buffers, so one object serves one caller at a time."""

    def __init__(self, world: World) -> None:
        self._world = world
        offset = np.arange(WIDTH) + 0.5 - WIDTH / 2
        self._ray_angles = -np.arctan(offset / FOCAL)
        self._straighten = np.cos(self._ray_angles)
        self._tiles = paint.floor_tiles()
        self._textures = paint.wall_textures()
        self._panorama_columns = round(math.tau / VIEW_ANGLE * WIDTH)
        sky = paint.panorama(self._panorama_columns, _HORIZON)
        self._panorama = np.concatenate((sky, sky[:, : WIDTH + 1]), axis=1)
        self._colours = np.array([look.colour for look in world.looks], dtype=np.float32)
        self._styles = np.array([look.texture for look in world.looks])
        rows = np.arange(HEIGHT - _HORIZON, dtype=np.float64) + 0.5
        self._floor_fog = np.exp(-EYE_HEIGHT * FOCAL / rows / (_FOG_LENGTH / 3))[:, None, None]
        self._floor_gain = np.repeat(np.repeat(self._floor_fog, WIDTH, axis=1), 3, axis=2).astype(np.float32)
        self._floor_base = (np.array(paint.FOG) * (1 - self._floor_gain)).astype(np.uint8)
        self._columns = np.tile(np.arange(WIDTH, dtype=np.float32), (HEIGHT, 1))
        self._rows = np.arange(HEIGHT, dtype=np.float32)[:, None] + np.float32(0.5)

    def render(self, pose: Pose, speed: float, at: float) -> Image:
        """One picture, BGR, shape (480, 640, 3); the array is the caller's.

        :param speed: m/s, written into the picture
        :param at: seconds since the epoch, written into the picture as a UTC clock
        """
        frame = np.empty((HEIGHT, WIDTH, 3), dtype=np.uint8)
        self._draw_sky(frame, pose)
        self._draw_floor(frame, pose)
        self._draw_walls(frame, pose)
        draw_captions(frame, speed, at)
        return frame

    def _draw_sky(self, frame: Image, pose: Pose) -> None:
        first = round((-pose.heading / math.tau) % 1.0 * self._panorama_columns)
        frame[:_HORIZON] = self._panorama[:, first : first + WIDTH]

    def _draw_floor(self, frame: Image, pose: Pose) -> None:
        """The floor is a plane, so the road from pixel to tile is one homography."""
        ahead_x, ahead_y = math.cos(pose.heading), math.sin(pose.heading)
        right_x, right_y = ahead_y, -ahead_x
        lift = EYE_HEIGHT
        half = WIDTH / 2
        # row counted from the horizon is the homogeneous coordinate: distance = lift · focal / row
        to_floor = np.array(
            [
                [lift * right_x, pose.x, lift * (FOCAL * ahead_x - half * right_x) + 0.5 * pose.x],
                [lift * right_y, pose.y, lift * (FOCAL * ahead_y - half * right_y) + 0.5 * pose.y],
                [0.0, 1.0, 0.5],
            ]
        )
        scale = self._tiles.shape[0] / _TILE_SPAN
        matrix = np.diag((scale, scale, 1.0)) @ to_floor
        tiles = cv2.warpPerspective(
            self._tiles,
            matrix,
            (WIDTH, HEIGHT - _HORIZON),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_WRAP,
        )
        cv2.multiply(tiles, self._floor_gain, dst=tiles, dtype=cv2.CV_8U)
        cv2.add(tiles, self._floor_base, dst=frame[_HORIZON:])

    def _draw_walls(self, frame: Image, pose: Pose) -> None:
        hits = self._world.cast(pose.x, pose.y, pose.heading + self._ray_angles)
        depth = np.maximum(hits.distance * self._straighten, _NEAREST)
        top = _HORIZON - (WALL_HEIGHT - EYE_HEIGHT) * FOCAL / depth
        first = max(0, math.floor(top.min()))
        last = min(HEIGHT, math.ceil(_HORIZON + EYE_HEIGHT * FOCAL / depth.min()))
        texels_per_row = (paint.TEXELS * depth / (WALL_HEIGHT * FOCAL)).astype(np.float32)
        down = (self._rows[first:last] - top.astype(np.float32)) * texels_per_row - np.float32(0.5)
        # what is neither wall nor its edge must stay as it is: send it outside the table
        outside = (down < -0.5) | (down > paint.TEXELS - 0.5) | (hits.surface < 0)
        np.clip(down, 0, paint.TEXELS - 1, out=down)
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
        """The painted texture column of each picture column, shape (texels, 640, 3)."""
        texel = (hits.along * paint.TEXELS).astype(np.int64) % paint.TEXELS
        pattern = self._textures[self._styles[hits.surface], texel].T
        clear = np.exp(-hits.distance / _FOG_LENGTH)
        light = ((0.45 + 0.55 * hits.facing) * clear)[:, None]
        haze = np.array(paint.FOG) * (1 - clear)[:, None]
        painted = pattern[:, :, None] * (self._colours[hits.surface] * light).astype(np.float32)
        painted += haze.astype(np.float32)
        table: Image = np.minimum(painted, 255.0, out=painted).astype(np.uint8)
        return table


def to_jpeg(frame: Image, quality: int = 80) -> bytes:
    """Encode a BGR picture.

    :param quality: 1 to 100
    :raises ValueError: OpenCV couldn't encode it
    """
    done, encoded = cv2.imencode(".jpg", frame, (cv2.IMWRITE_JPEG_QUALITY, quality))
    if not done:
        raise ValueError("the picture could not be encoded as JPEG")
    return encoded.tobytes()


def to_rgb(frame: Image) -> bytes:
    """The pixels of a BGR picture, row by row, as R, G, B."""
    return bytes(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB))


def draw_captions(frame: Image, speed: float, at: float) -> None:
    """Write clock and speed into a picture.

    :param frame: BGR, shape (480, 640, 3)
    :param speed: m/s
    :param at: seconds since the epoch
    """
    clock = datetime.fromtimestamp(at, tz=timezone.utc)
    _caption(frame, f"{clock:%H:%M:%S}.{clock.microsecond // 1000:03d} UTC", 12)
    _caption(frame, f"{speed:+.2f} m/s", WIDTH - 118)


def _caption(frame: Image, text: str, x: int) -> None:
    (width, height), baseline = cv2.getTextSize(text, _FONT, _FONT_SCALE, 1)
    plate = frame[HEIGHT - height - baseline - 16 : HEIGHT - 8, x - 6 : x + width + 6]
    cv2.convertScaleAbs(plate, dst=plate, alpha=0.35)
    cv2.putText(frame, text, (x, HEIGHT - 11 - baseline), _FONT, _FONT_SCALE, (245, 245, 245), 1, cv2.LINE_AA)
