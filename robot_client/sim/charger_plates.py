"""Draws chargers into the camera's image: plates with ArUco markers on walls, by columns like the walls."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from robot_client.sim import textures
from robot_client.sim.world import Charger, Floats, Hits, Pose, World

MARKER_SIDE = 0.4
"""Metres, of the marker's black square."""
SIDE = 0.6
"""Metres, of the plate: with the white margin of the marker."""
MIDDLE = 0.38
"""Metres over the floor."""

_FAMILY = cv2.aruco.DICT_4X4_50
_TEXELS = 72
"""Rows and columns of a plate's texture: eight for each of the marker's six fields and for the white."""
_BLACK, _WHITE = 20, 235

Image = npt.NDArray[np.uint8]


class CameraView(NamedTuple):
    """Geometry of the camera.

    :ivar focal: focal length, pixels
    :ivar horizon: row of the image
    :ivar height: above the floor, metres
    """

    focal: float
    horizon: int
    height: float


class ChargerPlates:
    """Draws the chargers of a world into the columns of an image."""

    def __init__(self, world: World, view: CameraView) -> None:
        self._world = world
        self._view = view
        self._plates = [(each, _texture(each.marker)) for each in world.chargers]

    def draw(self, frame: Image, pose: Pose, hits: Hits, depth: Floats, clear: Floats) -> None:
        """Draw the visible chargers over the walls.

        :param frame: BGR, shape (height, width, 3)
        :param hits: of each column's ray
        :param depth: metres ahead of each hit, shape (width,)
        :param clear: share of each hit's colour that fog leaves, shape (width,)
        """
        for charger, texture in self._plates:
            hit = (hits.surface == charger.wall) & (np.abs(hits.along - charger.along) < SIDE / 2)
            columns = np.flatnonzero(hit)
            if len(columns) and self._world.faces(charger, pose.x, pose.y):
                span = slice(int(columns[0]), int(columns[-1]) + 1)
                self._draw(frame[:, span], charger, texture, _part(hits, span), depth[span], clear[span])

    def _draw(
        self, strip: Image, charger: Charger, texture: Image, hits: Hits, depth: Floats, clear: Floats
    ) -> None:
        """Draw one plate into the columns from its first to its last; columns of obstacles before it are left out."""
        focal, horizon, height = self._view
        offset = hits.along - charger.along
        hit = (hits.surface == charger.wall) & (np.abs(offset) < SIDE / 2)
        scale = focal / np.where(hit, depth, 1.0)  # pixels for each metre
        top = horizon - (MIDDLE + SIDE / 2 - height) * scale
        bottom = horizon - (MIDDLE - SIDE / 2 - height) * scale
        first, last = max(0, math.floor(top.min())), min(len(strip), math.ceil(bottom.max()))
        texels_per_row = (_TEXELS / (SIDE * scale)).astype(np.float32)
        rows = np.arange(first, last, dtype=np.float32)[:, None] + np.float32(0.5)
        down = (rows - top.astype(np.float32)) * texels_per_row - np.float32(0.5)
        # As with walls, pixels that are not of the plate must stay.
        outside = (down < -0.5) | (down > _TEXELS - 0.5) | ~hit
        np.clip(down, 0, _TEXELS - 1, out=down)
        down[outside] = -10.0
        columns = np.tile(np.arange(len(depth), dtype=np.float32), (last - first, 1))
        # Seen from the front the wall runs from right to left.
        across = np.clip((0.5 - offset / SIDE) * _TEXELS, 0, _TEXELS - 1).astype(np.int64)
        cv2.remap(
            _lit(texture[:, across], hits.facing, clear),
            columns,
            down,
            cv2.INTER_LINEAR,
            dst=strip[first:last],
            borderMode=cv2.BORDER_TRANSPARENT,
        )


def _lit(grey: Image, facing: Floats, clear: Floats) -> Image:
    """Columns of a texture, lit like walls, shape (texels, columns, 3)."""
    light = (0.45 + 0.55 * facing) * clear
    haze = np.array(textures.FOG) * (1 - clear)[:, None]
    painted: Image = np.minimum((grey * light)[:, :, None] + haze, 255.0).astype(np.uint8)
    return painted


def _part(hits: Hits, span: slice) -> Hits:
    return Hits(hits.distance[span], hits.surface[span], hits.along[span], hits.facing[span])


def _texture(number: int) -> Image:
    """A plate seen from the front, shape (texels, texels), grey."""
    side = round(_TEXELS * MARKER_SIDE / SIDE)
    marker = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(_FAMILY), number, side)
    edge = (_TEXELS - side) // 2
    plate: Image = np.full((_TEXELS, _TEXELS), _WHITE, dtype=np.uint8)
    plate[edge : edge + side, edge : edge + side] = np.where(np.asarray(marker) > 127, _WHITE, _BLACK)
    return plate
