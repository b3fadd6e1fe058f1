"""Depth as colours: red is near, blue is far. The scale is fixed, so that nothing flickers."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

NEAREST, FARTHEST = 250, 16_000
"""Millimetres; depth is red up to the first and blue from the second. In between every doubling of the distance takes
as many colours as the last, with green in the middle, at 2 m. What was not measured is black."""

_MOST = 65_535
"""Millimetres in sixteen bits."""

_COLOURS = (235, 20)
"""Part of OpenCV's palette Turbo that is used, near to far: its ends are nearly black."""


def coloured(millimetres: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint8]:
    """BGR of depth; 0 is what was not measured."""
    return np.take(_DEPTH, millimetres, axis=0)


def whole_millimetres(metres: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.uint16]:
    """Millimetres of depth in metres, which is NaN or infinite where nothing was measured (REP 118)."""
    measured = np.isfinite(metres) & (metres > 0)
    nothing = np.zeros(metres.shape, metres.dtype)
    nearer = np.minimum(metres, _MOST / 1000, where=measured, out=nothing)
    return np.asarray(nearer * 1000).astype(np.uint16)


def coloured_inverse(
    values: npt.NDArray[np.uint16], numerator: float, offset: float
) -> npt.NDArray[np.uint8]:
    """BGR of depth that was quantised by its inverse, as compressed_depth_image_transport does it for ``32FC1``.

    Metres are ``numerator / (value - offset)``; 0 is what was not measured.

    :param numerator: finite
    :param offset: finite
    """
    steps = np.arange(_MOST + 1) - offset
    metres = np.divide(numerator, steps, where=steps > 0, out=np.zeros(steps.shape))
    metres[0] = 0
    return np.take(coloured(whole_millimetres(metres)), values, axis=0)


def _depth_colours() -> npt.NDArray[np.uint8]:
    """BGR for each millimetre."""
    octaves = np.log2(np.maximum(np.arange(_MOST + 1), 1) / NEAREST) / np.log2(FARTHEST / NEAREST)
    shade = _COLOURS[0] + (_COLOURS[1] - _COLOURS[0]) * np.clip(octaves, 0, 1)
    # A square, because releases of OpenCV disagree on what comes of a single row.
    square = np.rint(shade).astype(np.uint8).reshape(256, 256)
    colours: npt.NDArray[np.uint8] = (
        cv2.applyColorMap(square, cv2.COLORMAP_TURBO).astype(np.uint8).reshape(-1, 3)
    )
    colours[0] = 0
    return colours


_DEPTH = _depth_colours()
