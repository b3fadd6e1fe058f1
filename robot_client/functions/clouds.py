"""Point clouds."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from msgspec import Meta

from relay_protocol.errors import Invalid
from relay_protocol.functions import function


@function(repeatable=True)
def downsample_cloud(points: np.ndarray, voxel: Annotated[float, Meta(gt=0)]) -> np.ndarray:
    """One point for each cube of space that has any: their mean.

    :param points: shape (n, 3 or more), float; x, y, z first. Further columns are averaged too, and points that
        are not finite are left out
    :param voxel: side of a cube, metres
    """
    if points.ndim != 2 or points.shape[1] < 3 or points.dtype.kind != "f":
        raise Invalid(f"points are floats of the shape (n, 3 or more), not {points.shape} of {points.dtype}")
    finite: np.ndarray = points[np.isfinite(points[:, :3]).all(axis=1)]
    if not len(finite):
        return finite
    cells = np.floor(finite[:, :3] / voxel).astype(np.int64)
    _, cube, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros((len(counts), finite.shape[1]), dtype=np.float64)
    np.add.at(sums, cube.ravel(), finite)
    return np.asarray(sums / counts[:, None], points.dtype)
