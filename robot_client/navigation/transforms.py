"""Transforms between coordinate frames, as /tf and /tf_static carry them (REP 105). Pure.

tf2_ros is not available as a wheel; a navigator needs no more than this.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from relay_protocol.errors import Unavailable
from robot_client.navigation.grid import Floats

_MOST_FRAMES = 1000
_HISTORY = 150
"""Transforms that are remembered for each frame: 3 s at 50 Hz."""
_DEEPEST = 50
"""Longest chain of frames; a longer one is a circle."""


class _StampedTransform(NamedTuple):
    stamp: float
    matrix: Floats


class TransformTree:
    """The newest transforms of each frame to its parent."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}
        self._samples: dict[str, deque[_StampedTransform]] = {}
        self._arrivals: dict[str, float] = {}

    def set(self, parent: str, child: str, stamp: float, matrix: Floats, at: float = math.inf) -> None:
        """Note a transform.

        :param stamp: seconds
        :param matrix: maps points of ``child`` to points of ``parent``, shape (4, 4)
        :param at: when it came, seconds of any clock; infinite: it is static, so it is never too old
        """
        if child not in self._samples and len(self._samples) >= _MOST_FRAMES:
            return
        if self._parents.get(child) != parent or math.isinf(at):
            self._samples[child] = deque(maxlen=_HISTORY)
        self._parents[child] = parent
        self._arrivals[child] = at
        self._samples[child].append(_StampedTransform(stamp, matrix))

    def lookup(self, target: str, source: str, stamp: float | None = None) -> Floats:
        """The matrix that maps points of ``source`` to points of ``target``.

        :param stamp: seconds; of each frame the transform nearest in time counts; ``None``: the newest
        :raises Unavailable: they are not connected
        """
        up, down = self._to_root(source, stamp), self._to_root(target, stamp)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            raise Unavailable(f"no transforms connect the frames '{target}' and '{source}'")
        matrix: Floats = np.linalg.inv(down[common]) @ up[common]
        return matrix

    def arrivals(self, target: str, source: str) -> list[float]:
        """When each transform between two connected frames last came, from that at ``source`` to that at ``target``."""
        up, down = list(self._to_root(source, None)), list(self._to_root(target, None))
        common = next(frame for frame in up if frame in down)
        frames = up[: up.index(common)] + down[: down.index(common)][::-1]
        return [self._arrivals[frame] for frame in frames]

    def _to_root(self, frame: str, stamp: float | None) -> dict[str, Floats]:
        """Matrices from a frame to itself and to each frame above it, the nearest first."""
        matrix = np.eye(4)
        found = {frame: matrix}
        while frame in self._parents and len(found) < _DEEPEST:
            matrix = self._nearest(frame, stamp) @ matrix
            frame = self._parents[frame]
            if frame in found:
                break
            found[frame] = matrix
        return found

    def _nearest(self, frame: str, stamp: float | None) -> Floats:
        samples = self._samples[frame]
        if stamp is None:
            return samples[-1].matrix
        return min(samples, key=lambda each: abs(each.stamp - stamp)).matrix


def matrix_of(
    translation: tuple[float, float, float], quaternion: tuple[float, float, float, float]
) -> Floats:
    """The matrix of a transform.

    :param translation: metres
    :param quaternion: x, y, z, w; of any length but 0
    :raises Unavailable: the quaternion is zero, or a number is not finite
    """
    x, y, z, w = quaternion
    norm = x * x + y * y + z * z + w * w
    if not (norm > 0 and np.isfinite((norm, *translation)).all()):
        raise Unavailable(f"a rotation of {quaternion} at {translation} is invalid")
    s = 2 / norm
    matrix = np.eye(4)
    matrix[:3, :3] = (
        (1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)),
        (s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)),
        (s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)),
    )
    matrix[:3, 3] = translation
    return matrix
