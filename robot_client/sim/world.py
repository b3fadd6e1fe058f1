"""The flat world of the simulated robot: walls (segments) and pillars (circles), and rays cast through them.

Metres and radians, x to the right, y up, angles counter-clockwise from x. Nothing here knows of time or ROS.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_PARALLEL = 1e-12
_BEYOND_END = 1e-9
"""Rays that pass through the very corner of two walls must hit one of them."""


class Texture(enum.IntEnum):
    """What a surface looks like to the camera; the value is a row of its texture table."""

    BRICK = 0
    PANEL = 1
    STRIPES = 2
    CHEVRON = 3


class Colour(NamedTuple):
    """0 to 255 each, in the order OpenCV uses."""

    blue: int
    green: int
    red: int


class Pose(NamedTuple):
    """Where a robot stands: metres, metres, radians."""

    x: float
    y: float
    heading: float


class WallTexture(NamedTuple):
    """How an obstacle is painted."""

    colour: Colour
    texture: Texture


class Segment(NamedTuple):
    """A straight wall from one point to another."""

    x1: float
    y1: float
    x2: float
    y2: float
    look: WallTexture


class Circle(NamedTuple):
    """A round pillar."""

    x: float
    y: float
    radius: float
    look: WallTexture


class Charger(NamedTuple):
    """A plate on a wall with a marker on it; what stands before it is charged.

    :ivar wall: number of the segment; the plate looks to the left of the way from its beginning to its end, which is
        into a room
    :ivar along: metres from the wall's beginning to the plate's middle
    :ivar marker: number of the marker, of the family that OpenCV names 4X4_50
    """

    wall: int
    along: float
    marker: int


CHARGER_REACH = 0.6
"""Metres from the middle of a charger within which it charges."""


@dataclass(frozen=True)
class Hits:
    """What a fan of rays met, one entry per ray.

    :ivar distance: metres; ``inf`` where nothing was met
    :ivar surface: number of the obstacle (segments first, then circles), -1 where nothing was met
    :ivar along: metres along the surface from its beginning, for painting; 0 where nothing was met
    :ivar facing: cosine between ray and surface normal, 0 (grazing) to 1 (head-on)
    """

    distance: Floats
    surface: Ints
    along: Floats
    facing: Floats


class Contact(NamedTuple):
    """The obstacle nearest to a point: its distance in metres and the unit direction away from it."""

    distance: float
    away_x: float
    away_y: float


class World:
    """Obstacles, packed for numpy, and the place where a robot starts.

    :param segments: walls; at least one obstacle is needed in all
    :param circles: pillars
    :param start: pose of a robot at its beginning and after a reset
    :param chargers: on the walls
    """

    def __init__(
        self,
        segments: list[Segment],
        circles: list[Circle],
        start: Pose,
        chargers: tuple[Charger, ...] = (),
    ) -> None:
        self.segments = tuple(segments)
        self.circles = tuple(circles)
        self.start = start
        self.chargers = chargers
        self.looks = tuple(wall.look for wall in segments) + tuple(pillar.look for pillar in circles)
        ends = np.array([each[:4] for each in segments], dtype=np.float64).reshape(-1, 4)
        rounds = np.array([each[:3] for each in circles], dtype=np.float64).reshape(-1, 3)
        self._begin = ends[:, :2]
        self._run = ends[:, 2:] - ends[:, :2]
        self._length = np.hypot(self._run[:, 0], self._run[:, 1])
        self._centre = rounds[:, :2]
        self._radius = rounds[:, 2]

    def cast(self, x: float, y: float, angles: Floats) -> Hits:
        """Send rays from a point and tell what each meets first.

        :param x: metres
        :param y: metres
        :param angles: absolute direction of each ray, radians, shape (n,)
        """
        direction = np.stack((np.cos(angles), np.sin(angles)), axis=1)
        to_walls, position = self._to_segments(np.array((x, y)), direction)
        to_pillars = self._to_circles(np.array((x, y)), direction)
        every = np.concatenate((to_walls, to_pillars), axis=1)
        rays = np.arange(len(angles))
        surface = np.argmin(every, axis=1)
        distance = every[rays, surface]
        surface = np.where(np.isfinite(distance), surface, -1)
        hits = Hits(distance, surface, np.zeros(len(angles)), np.zeros(len(angles)))
        self._describe_walls(direction, position, hits)
        self._describe_pillars(np.array((x, y)), direction, hits)
        return hits

    def nearest(self, x: float, y: float) -> Contact:
        """The obstacle surface nearest to a point; inside a pillar the distance is negative."""
        point = np.array((x, y))
        share = np.einsum("ij,ij->i", point - self._begin, self._run) / np.maximum(self._length**2, _PARALLEL)
        foot = self._begin + np.clip(share, 0.0, 1.0)[:, None] * self._run
        offset = np.concatenate((point - foot, point - self._centre))
        reach = np.hypot(offset[:, 0], offset[:, 1])
        gap = reach.copy()
        gap[len(foot) :] -= self._radius
        best = int(np.argmin(gap))
        if reach[best] < _PARALLEL:  # exactly on a wall or in a pillar's centre: any way out is as good
            return Contact(float(gap[best]), 1.0, 0.0)
        away = offset[best] / reach[best]
        return Contact(float(gap[best]), float(away[0]), float(away[1]))

    def charges(self, x: float, y: float) -> bool:
        """Whether a robot that stands at a point, metres, is charged."""
        return any(self._charged_by(each, x, y) for each in self.chargers)

    def looks_at(self, charger: Charger, x: float, y: float) -> bool:
        """Whether a point, metres, is on the side to which a charger looks."""
        wall = self.segments[charger.wall]
        return (wall.x2 - wall.x1) * (y - wall.y1) > (wall.y2 - wall.y1) * (x - wall.x1)

    def _charged_by(self, charger: Charger, x: float, y: float) -> bool:
        wall = self.segments[charger.wall]
        share = charger.along / math.hypot(wall.x2 - wall.x1, wall.y2 - wall.y1)
        middle_x, middle_y = wall.x1 + share * (wall.x2 - wall.x1), wall.y1 + share * (wall.y2 - wall.y1)
        return math.hypot(x - middle_x, y - middle_y) <= CHARGER_REACH and self.looks_at(charger, x, y)

    def _to_segments(self, origin: Floats, direction: Floats) -> tuple[Floats, Floats]:
        """Solve origin + t·direction = begin + s·run for every ray and wall; t and s, rays × walls."""
        offset = self._begin - origin
        cross = direction[:, :1] * self._run[:, 1] - direction[:, 1:] * self._run[:, 0]
        solvable = np.abs(cross) > _PARALLEL
        divisor = np.where(solvable, cross, 1.0)
        reach = (offset[:, 0] * self._run[:, 1] - offset[:, 1] * self._run[:, 0]) / divisor
        position = (offset[:, 0] * direction[:, 1:] - offset[:, 1] * direction[:, :1]) / divisor
        hit = solvable & (reach >= 0) & (position >= -_BEYOND_END) & (position <= 1 + _BEYOND_END)
        return np.where(hit, reach, np.inf), position

    def _to_circles(self, origin: Floats, direction: Floats) -> Floats:
        """The nearer root of |origin + t·direction - centre| = radius, shape (n, pillars)."""
        offset = self._centre - origin
        middle = direction @ offset.T
        inside = middle**2 - (np.einsum("ij,ij->i", offset, offset) - self._radius**2)
        reach = middle - np.sqrt(np.maximum(inside, 0.0))
        return np.where((inside >= 0) & (reach >= 0), reach, np.inf)

    def _describe_walls(self, direction: Floats, position: Floats, hits: Hits) -> None:
        rays = np.nonzero((hits.surface >= 0) & (hits.surface < len(self.segments)))[0]
        which = hits.surface[rays]
        hits.along[rays] = position[rays, which] * self._length[which]
        run = self._run[which] / self._length[which, None]
        hits.facing[rays] = np.abs(direction[rays, 0] * run[:, 1] - direction[rays, 1] * run[:, 0])

    def _describe_pillars(self, origin: Floats, direction: Floats, hits: Hits) -> None:
        rays = np.nonzero(hits.surface >= len(self.segments))[0]
        which = hits.surface[rays] - len(self.segments)
        radius = self._radius[which]
        met = origin + hits.distance[rays, None] * direction[rays]
        normal = (met - self._centre[which]) / radius[:, None]
        hits.along[rays] = (np.arctan2(normal[:, 1], normal[:, 0]) + np.pi) * radius
        hits.facing[rays] = np.abs(np.einsum("ij,ij->i", normal, direction[rays]))


def box(x: float, y: float, width: float, depth: float, turn: float, look: WallTexture) -> list[Segment]:
    """Four walls around a rectangle.

    :param x: centre, metres
    :param y: centre, metres
    :param width: metres, along the box's own x axis
    :param depth: metres
    :param turn: radians, counter-clockwise
    """
    return polygon(x, y, [(-width / 2, -depth / 2), (width / 2, -depth / 2), (width / 2, depth / 2),
                          (-width / 2, depth / 2)], turn, look)  # fmt: skip


def polygon(
    x: float, y: float, corners: list[tuple[float, float]], turn: float, look: WallTexture
) -> list[Segment]:
    """A closed ring of walls through corners given around (x, y), turned by so many radians."""
    cos, sin = float(np.cos(turn)), float(np.sin(turn))
    points = [(x + cos * cx - sin * cy, y + sin * cx + cos * cy) for cx, cy in corners]
    return [Segment(*points[i - 1], *points[i], look) for i in range(len(points))]
