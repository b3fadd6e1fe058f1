"""Textures of the simulated camera: walls, floor tiles and the panorama behind the walls."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from robot_client.sim.world import Texture

Image = npt.NDArray[np.uint8]

TEXELS = 64
"""Rows and columns of a wall texture."""

FOG = (214, 206, 196)
"""BGR that far things fade to."""

FOG_LENGTH = 26.0
"""Metres after which fog hides about two thirds of a colour."""

FLOOR_TINT = (10, 6, 0)
"""BGR that is added to the floor's brightness."""

_RIDGES = (
    (5, 0.16, 0.9, (172, 160, 140)),
    (9, 0.11, 2.1, (150, 146, 112)),
    (14, 0.06, 4.0, (118, 132, 88)),
)
"""Hills from far to near: waves around the horizon, share of the sky's height, phase, BGR."""


def wall_textures() -> npt.NDArray[np.float32]:
    """Brightness factors, shape (textures, columns along the wall, rows from top to bottom)."""
    along, down = np.meshgrid(np.arange(TEXELS), np.arange(TEXELS), indexing="ij")
    table = np.empty((len(Texture), TEXELS, TEXELS), dtype=np.float32)
    grain = np.random.default_rng(7).uniform(0.94, 1.04, (TEXELS, TEXELS))
    course = down // 8
    joint = (down % 8 == 0) | ((along + 8 * (course % 2)) % 16 == 0)
    table[Texture.BRICK] = np.where(joint, 0.72, 1.0 - 0.10 * ((course * 5 + (along // 16) * 3) % 3) / 2)
    seam = (along % 32 < 1) | (down == 20)
    table[Texture.PANEL] = np.where(seam, 0.70, np.where(down < 20, 1.06, 0.95))
    table[Texture.STRIPES] = np.where((along // 8) % 2 == 0, 1.0, 0.66)
    band = (down >= 20) & (down < 44)
    arrow = ((along + np.abs(down - 32)) // 8) % 2 == 0
    table[Texture.CHEVRON] = np.where(band & arrow, 0.35, 1.0)
    table *= grain
    table[:, :, -6:] *= 0.55  # skirting
    table[:, :, :2] *= 1.18  # lit upper edge
    return table


def floor_tiles(size: int = 256) -> Image:
    """Eight by eight tiles of slightly different brightness, seamless in both directions, shape (size, size)."""
    tile = size // 8
    random = np.random.default_rng(11)
    shade = random.uniform(-7, 7, (8, 8)) + np.where(np.indices((8, 8)).sum(axis=0) % 2 == 0, 9, -9)
    grey = 122 + np.kron(shade, np.ones((tile, tile))) + random.normal(0, 2.5, (size, size))
    lines = np.arange(size) % tile < 2
    grey[lines, :] -= 26
    grey[:, lines] -= 26
    return grey.astype(np.uint8)


def panorama(columns: int, rows: int) -> Image:
    """Sky, clouds and hills once around the horizon, shape (rows, columns, 3), seamless left to right."""
    angle = np.linspace(0, math.tau, columns, endpoint=False)[None, :]
    height = np.linspace(1, 0, rows)[:, None]  # 0 at the horizon
    top, bottom = np.array((208, 150, 92)), np.array(FOG)
    sky = bottom + (top - bottom) * np.sqrt(height)[..., None] * np.ones((1, columns, 1))
    puffs = np.zeros((rows, columns))
    random = np.random.default_rng(3)
    for octave in range(1, 7):
        phase = random.uniform(0, math.tau, 3)
        wave = np.sin(3 * 2 ** (octave - 1) * angle + phase[0])
        puffs += wave * np.sin(9 * octave * height + phase[1] + np.sin(2 * angle + phase[2])) / octave
    cloud = np.clip(puffs * 0.9 - 0.25, 0, 1) * np.clip(height * 3, 0, 1) * 0.75
    sky += (np.array((250, 248, 246)) - sky) * cloud[..., None]
    for waves, level, shift, colour in _RIDGES:
        ridge = level * (1 + 0.35 * np.sin(waves * angle + shift) + 0.2 * np.sin(2 * waves * angle + 1))
        sky = np.where((height < ridge)[..., None], np.array(colour), sky)
    strip: Image = np.clip(sky, 0, 255).astype(np.uint8)
    return strip
