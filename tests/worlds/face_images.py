"""Faces for recognition in tests: the images in scikit-image's wheel."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from skimage import data

Grey = npt.NDArray[np.uint8]

EILEEN: Grey = np.asarray(cv2.cvtColor(data.astronaut(), cv2.COLOR_RGB2GRAY))[:300, 80:380]
"""The astronaut Eileen Collins, by NASA: 300 × 300 pixels, of which her face has some 100."""

STRANGERS: Grey = np.rint(data.lfw_subset()[:100] * 255).astype(np.uint8)
"""A hundred faces of Labeled Faces in the Wild, 25 × 25 pixels each."""


def people(folder: Path) -> Path:
    """A folder with Eileen for the service ``faces``."""
    folder.mkdir()
    assert cv2.imwrite(str(folder / "eileen.png"), EILEEN)
    return folder


def scene(person: Grey, factor: float, at: tuple[int, int], light: float = 1.0) -> Grey:
    """An image of 640 × 480 pixels with a face in it.

    :param factor: enlargement of the given picture
    :param at: column and row of the upper left corner; parts outside are cut off
    :param light: factor of brightness
    """
    drawn = cv2.resize(person, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    lit = np.clip(np.asarray(drawn, dtype=np.float64) * light, 0, 255).astype(np.uint8)
    found = np.full((480, 640), 110, dtype=np.uint8)
    left, top = at
    height, width = min(lit.shape[0], 480 - top), min(lit.shape[1], 640 - left)
    found[top : top + height, left : left + width] = lit[:height, :width]
    return found


def stranger(number: int, side: int = 160) -> Grey:
    """An unknown face of this size, with a margin: the pictures end at the edges of the faces."""
    face = cv2.resize(STRANGERS[number], (side, side), interpolation=cv2.INTER_CUBIC)
    edge = side // 3
    return np.asarray(cv2.copyMakeBorder(face, edge, edge, edge, edge, cv2.BORDER_REPLICATE))
