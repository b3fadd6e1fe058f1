"""The world of the simulated robot: walls (segments), pillars (circles) and tables, and rays cast through them.

Walls and pillars are flat: the same at every height up to their top. A table is a plate on four thin legs.
Metres and radians, x to the right, y up, angles counter-clockwise from x. Nothing here knows of time or ROS.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_PARALLEL = 1e-12
_BEYOND_END = 1e-9
"""Rays that pass through the very corner of two walls must hit one of them."""


class Texture(enum.IntEnum):
    """Texture of a surface; the value is a row of the camera's texture table."""

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
    """Pose of a robot: metres, metres, radians."""

    x: float
    y: float
    heading: float


class WallTexture(NamedTuple):
    """Appearance of an obstacle."""

    colour: Colour
    texture: Texture


class Segment(NamedTuple):
    """A straight wall from one point to another."""

    x1: float
    y1: float
    x2: float
    y2: float
    appearance: WallTexture


class Circle(NamedTuple):
    """A round pillar."""

    x: float
    y: float
    radius: float
    appearance: WallTexture


class Table(NamedTuple):
    """A rectangular plate on four round legs.

    :ivar x: its middle, metres
    :ivar y: its middle, metres
    :ivar length: metres, along the table's own x axis
    :ivar width: metres
    :ivar turn: radians, counter-clockwise
    :ivar underside: height of the plate's lower face, metres
    :ivar top: height of its upper face, metres
    :ivar leg_radius: metres
    :ivar leg_inset: metres from the plate's edges to a leg's middle
    """

    x: float
    y: float
    length: float
    width: float
    turn: float
    appearance: WallTexture
    underside: float = 0.38
    top: float = 0.42
    leg_radius: float = 0.02
    leg_inset: float = 0.05

    def legs(self) -> list[Circle]:
        """The four legs, as circles."""
        along, across = self.length / 2 - self.leg_inset, self.width / 2 - self.leg_inset
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        return [
            Circle(self.x + cos * u - sin * v, self.y + sin * u + cos * v, self.leg_radius, self.appearance)
            for u, v in ((along, across), (-along, across), (-along, -across), (along, -across))
        ]

    def edges(self) -> list[Segment]:
        """The four edges of the plate."""
        return box(self.x, self.y, self.length, self.width, self.turn, self.appearance)


class Charger(NamedTuple):
    """A plate with a marker on a wall. It charges a robot in front of it.

    :ivar wall: number of the segment; the plate faces to the left of the wall's direction, which is into the room
    :ivar along: metres from the wall's beginning to the plate's middle
    :ivar marker: number of the marker, of the family that OpenCV names 4X4_50
    """

    wall: int
    along: float
    marker: int


BODY_HEIGHT = 0.5
"""Height of a robot, metres: it fits under plates that are higher than this."""

CHARGER_REACH = 0.6
"""Metres from the middle of a charger within which it charges."""


@dataclass(frozen=True)
class Hits:
    """Hits of a fan of rays, one entry per ray.

    :ivar distance: metres; ``inf`` without a hit
    :ivar surface: number of the obstacle (segments first, then circles), -1 without a hit
    :ivar along: metres along the surface from its beginning, for textures; 0 without a hit
    :ivar facing: cosine between ray and surface normal, 0 (grazing) to 1 (head-on)
    """

    distance: Floats
    surface: Ints
    along: Floats
    facing: Floats


@dataclass(frozen=True)
class PlateHits:
    """Where rays pass over or under the plate of a table, one entry per ray.

    :ivar table: the table
    :ivar enter: metres to the plate's near edge; ``inf`` without a hit
    :ivar leave: metres to its far edge; ``-inf`` without a hit
    :ivar leg: metres to the nearest of its legs; ``inf`` without a hit
    """

    table: Table
    enter: Floats
    leave: Floats
    leg: Floats


class Contact(NamedTuple):
    """The obstacle nearest to a point: its distance in metres and the unit direction away from it."""

    distance: float
    away_x: float
    away_y: float


class World:
    """Obstacles, packed for numpy, and the start pose of a robot.

    :param segments: walls; at least one obstacle is needed in all
    :param circles: pillars
    :param start: pose of a robot at the start and after a reset
    :param chargers: on the walls
    :param tables: furniture; it is on no map
    """

    def __init__(
        self,
        segments: list[Segment],
        circles: list[Circle],
        start: Pose,
        chargers: tuple[Charger, ...] = (),
        tables: tuple[Table, ...] = (),
    ) -> None:
        self.segments = tuple(segments)
        self.circles = tuple(circles)
        self.start = start
        self.chargers = chargers
        self.tables = tables
        self.appearances = tuple(wall.appearance for wall in segments) + tuple(
            pillar.appearance for pillar in circles
        )
        self._walls = _PackedSegments(segments)
        self._pillars = _PackedCircles(circles)
        legs = [leg for table in tables for leg in table.legs()]
        self._legs = _PackedCircles(legs)
        low = [edge for table in tables if table.underside < BODY_HEIGHT for edge in table.edges()]
        self._solid_walls = _PackedSegments([*segments, *low])
        self._solid_circles = _PackedCircles([*circles, *legs])

    def cast(self, x: float, y: float, angles: Floats) -> Hits:
        """Cast rays from a point and return their first hits of walls and pillars.

        :param x: metres
        :param y: metres
        :param angles: absolute direction of each ray, radians, shape (n,)
        """
        direction = np.stack((np.cos(angles), np.sin(angles)), axis=1)
        to_walls, position = self._walls.cast(np.array((x, y)), direction)
        to_pillars = self._pillars.cast(np.array((x, y)), direction)
        every = np.concatenate((to_walls, to_pillars), axis=1)
        rays = np.arange(len(angles))
        surface = np.argmin(every, axis=1)
        distance = every[rays, surface]
        surface = np.where(np.isfinite(distance), surface, -1)
        hits = Hits(distance, surface, np.zeros(len(angles)), np.zeros(len(angles)))
        self._describe_walls(direction, position, hits)
        self._describe_pillars(np.array((x, y)), direction, hits)
        return hits

    def scan(self, x: float, y: float, angles: Floats) -> Floats:
        """Distances of what a flat scanner below all plates meets, tables' legs included, metres, shape (n,)."""
        distance = self.cast(x, y, angles).distance
        if not self.tables:
            return distance
        direction = np.stack((np.cos(angles), np.sin(angles)), axis=1)
        to_legs: Floats = self._legs.cast(np.array((x, y)), direction).min(axis=1)
        return np.minimum(distance, to_legs)

    def cast_tables(self, x: float, y: float, angles: Floats) -> list[PlateHits]:
        """Where rays from a point meet tables; walls before them are not looked at.

        :param angles: absolute direction of each ray, radians, shape (n,)
        """
        direction, origin = np.stack((np.cos(angles), np.sin(angles)), axis=1), np.array((x, y))
        found = []
        for number, table in enumerate(self.tables):
            legs = self._legs.cast(origin, direction)[:, 4 * number : 4 * number + 4].min(axis=1)
            enter, leave = _through_plate(table, x, y, angles)
            found.append(PlateHits(table, enter, leave, legs))
        return found

    def nearest(self, x: float, y: float) -> Contact:
        """The surface nearest to a point that a robot's body meets; inside a pillar the distance is negative."""
        point = np.array((x, y))
        foot = self._solid_walls.nearest(point)
        offset = np.concatenate((point - foot, point - self._solid_circles.centre))
        reach = np.hypot(offset[:, 0], offset[:, 1])
        gap = reach.copy()
        gap[len(foot) :] -= self._solid_circles.radius
        best = int(np.argmin(gap))
        if reach[best] < _PARALLEL:  # exactly on a wall or in a pillar's centre: any direction is as good
            return Contact(float(gap[best]), 1.0, 0.0)
        away = offset[best] / reach[best]
        return Contact(float(gap[best]), float(away[0]), float(away[1]))

    def bounds(self) -> tuple[Floats, Floats]:
        """The lower left and the upper right corner of all walls and pillars, metres."""
        begin, end = self._walls.begin, self._walls.begin + self._walls.run
        centre, radius = self._pillars.centre, self._pillars.radius[:, None]
        points = np.concatenate((begin, end, centre - radius, centre + radius))
        return points.min(axis=0), points.max(axis=0)

    def wall_distance(self, points: Floats) -> Floats:
        """Metres from points, shape (n, 2), to the nearest wall or pillar; negative inside a pillar."""
        to_walls = np.full(len(points), np.inf)
        for begin, run, length in zip(self._walls.begin, self._walls.run, self._walls.length, strict=True):
            share = np.clip((points - begin) @ run / max(float(length) ** 2, _PARALLEL), 0.0, 1.0)
            offset = points - begin - share[:, None] * run
            np.minimum(to_walls, np.hypot(offset[:, 0], offset[:, 1]), out=to_walls)
        for centre, radius in zip(self._pillars.centre, self._pillars.radius, strict=True):
            offset = points - centre
            np.minimum(to_walls, np.hypot(offset[:, 0], offset[:, 1]) - radius, out=to_walls)
        return to_walls

    def charges(self, x: float, y: float) -> bool:
        """Whether a robot at a point, metres, is charged."""
        return any(self._charged_by(each, x, y) for each in self.chargers)

    def faces(self, charger: Charger, x: float, y: float) -> bool:
        """Whether a point, metres, is on the side that a charger faces."""
        wall = self.segments[charger.wall]
        return (wall.x2 - wall.x1) * (y - wall.y1) > (wall.y2 - wall.y1) * (x - wall.x1)

    def _charged_by(self, charger: Charger, x: float, y: float) -> bool:
        wall = self.segments[charger.wall]
        share = charger.along / math.hypot(wall.x2 - wall.x1, wall.y2 - wall.y1)
        middle_x, middle_y = wall.x1 + share * (wall.x2 - wall.x1), wall.y1 + share * (wall.y2 - wall.y1)
        return math.hypot(x - middle_x, y - middle_y) <= CHARGER_REACH and self.faces(charger, x, y)

    def _describe_walls(self, direction: Floats, position: Floats, hits: Hits) -> None:
        rays = np.nonzero((hits.surface >= 0) & (hits.surface < len(self.segments)))[0]
        which = hits.surface[rays]
        hits.along[rays] = position[rays, which] * self._walls.length[which]
        run = self._walls.run[which] / self._walls.length[which, None]
        hits.facing[rays] = np.abs(direction[rays, 0] * run[:, 1] - direction[rays, 1] * run[:, 0])

    def _describe_pillars(self, origin: Floats, direction: Floats, hits: Hits) -> None:
        rays = np.nonzero(hits.surface >= len(self.segments))[0]
        which = hits.surface[rays] - len(self.segments)
        radius = self._pillars.radius[which]
        met = origin + hits.distance[rays, None] * direction[rays]
        normal = (met - self._pillars.centre[which]) / radius[:, None]
        hits.along[rays] = (np.arctan2(normal[:, 1], normal[:, 0]) + np.pi) * radius
        hits.facing[rays] = np.abs(np.einsum("ij,ij->i", normal, direction[rays]))


class _PackedSegments:
    """Segments as arrays."""

    def __init__(self, segments: list[Segment]) -> None:
        ends = np.array([each[:4] for each in segments], dtype=np.float64).reshape(-1, 4)
        self.begin = ends[:, :2]
        self.run = ends[:, 2:] - ends[:, :2]
        self.length = np.hypot(self.run[:, 0], self.run[:, 1])

    def cast(self, origin: Floats, direction: Floats) -> tuple[Floats, Floats]:
        """Solve origin + t·direction = begin + s·run for every ray and wall; t and s, rays × walls."""
        offset = self.begin - origin
        cross = direction[:, :1] * self.run[:, 1] - direction[:, 1:] * self.run[:, 0]
        solvable = np.abs(cross) > _PARALLEL
        divisor = np.where(solvable, cross, 1.0)
        reach = (offset[:, 0] * self.run[:, 1] - offset[:, 1] * self.run[:, 0]) / divisor
        position = (offset[:, 0] * direction[:, 1:] - offset[:, 1] * direction[:, :1]) / divisor
        hit = solvable & (reach >= 0) & (position >= -_BEYOND_END) & (position <= 1 + _BEYOND_END)
        return np.where(hit, reach, np.inf), position

    def nearest(self, point: Floats) -> Floats:
        """The point of each segment that is nearest to a point, shape (segments, 2)."""
        share = np.einsum("ij,ij->i", point - self.begin, self.run) / np.maximum(self.length**2, _PARALLEL)
        foot: Floats = self.begin + np.clip(share, 0.0, 1.0)[:, None] * self.run
        return foot


class _PackedCircles:
    """Circles as arrays."""

    def __init__(self, circles: list[Circle]) -> None:
        rounds = np.array([each[:3] for each in circles], dtype=np.float64).reshape(-1, 3)
        self.centre = rounds[:, :2]
        self.radius = rounds[:, 2]

    def cast(self, origin: Floats, direction: Floats) -> Floats:
        """The nearer root of |origin + t·direction - centre| = radius, shape (rays, circles)."""
        offset = self.centre - origin
        middle = direction @ offset.T
        inside = middle**2 - (np.einsum("ij,ij->i", offset, offset) - self.radius**2)
        reach = middle - np.sqrt(np.maximum(inside, 0.0))
        return np.where((inside >= 0) & (reach >= 0), reach, np.inf)


def _through_plate(table: Table, x: float, y: float, angles: Floats) -> tuple[Floats, Floats]:
    """Metres at which rays enter and leave the area of a plate (slab method, in the table's own axes)."""
    cos, sin = math.cos(table.turn), math.sin(table.turn)
    start = np.array((cos * (x - table.x) + sin * (y - table.y), cos * (y - table.y) - sin * (x - table.x)))
    own = np.stack((np.cos(angles - table.turn), np.sin(angles - table.turn)), axis=1)
    own = np.where(np.abs(own) < _PARALLEL, _PARALLEL, own)
    half = np.array((table.length, table.width)) / 2
    one, other = (-half - start) / own, (half - start) / own
    enter = np.maximum(np.minimum(one, other).max(axis=1), 0.0)
    leave = np.maximum(one, other).min(axis=1)
    met = leave > enter
    return np.where(met, enter, np.inf), np.where(met, leave, -np.inf)


def box(
    x: float, y: float, width: float, depth: float, turn: float, appearance: WallTexture
) -> list[Segment]:
    """Four walls around a rectangle.

    :param x: centre, metres
    :param y: centre, metres
    :param width: metres, along the box's own x axis
    :param depth: metres
    :param turn: radians, counter-clockwise
    """
    return polygon(x, y, [(-width / 2, -depth / 2), (width / 2, -depth / 2), (width / 2, depth / 2),
                          (-width / 2, depth / 2)], turn, appearance)  # fmt: skip


def polygon(
    x: float, y: float, corners: list[tuple[float, float]], turn: float, appearance: WallTexture
) -> list[Segment]:
    """A closed ring of walls through corners given around (x, y), rotated by ``turn`` radians."""
    cos, sin = float(np.cos(turn)), float(np.sin(turn))
    points = [(x + cos * cx - sin * cy, y + sin * cx + cos * cy) for cx, cy in corners]
    walls = []
    for (x1, y1), (x2, y2) in zip([points[-1], *points[:-1]], points, strict=True):
        walls.append(Segment(x1, y1, x2, y2, appearance))
    return walls


_BRICKS = WallTexture(Colour(92, 112, 168), Texture.BRICK)
_PLASTER = WallTexture(Colour(176, 190, 196), Texture.PANEL)
_RED = WallTexture(Colour(58, 64, 214), Texture.STRIPES)
_GREEN = WallTexture(Colour(86, 170, 74), Texture.PANEL)
_BLUE = WallTexture(Colour(206, 128, 52), Texture.PANEL)
_YELLOW = WallTexture(Colour(60, 196, 240), Texture.CHEVRON)
_TEAL = WallTexture(Colour(160, 164, 40), Texture.STRIPES)
_VIOLET = WallTexture(Colour(190, 86, 148), Texture.STRIPES)
_ORANGE = WallTexture(Colour(40, 132, 240), Texture.CHEVRON)
_WOOD = WallTexture(Colour(70, 120, 180), Texture.PANEL)


@cache
def default() -> World:
    """A room of 12 × 9 m: an inner room behind a doorway, crates, a wedge, pillars, a charger and a table."""
    segments = [
        *box(0.0, 0.0, 12.0, 9.0, 0.0, _BRICKS),
        # a room in the north-east with a doorway of 1.2 m
        Segment(2.2, 4.5, 2.2, 2.9, _PLASTER),
        Segment(2.2, 1.7, 2.2, 0.9, _PLASTER),
        Segment(2.2, 0.9, 6.0, 0.9, _PLASTER),
        *box(4.7, 3.4, 0.8, 0.8, math.radians(20), _ORANGE),
        *box(-3.4, 2.6, 1.2, 0.7, math.radians(-15), _BLUE),
        *box(-1.2, -2.9, 0.9, 0.9, math.radians(40), _YELLOW),
        *box(4.4, -3.3, 1.6, 0.6, 0.0, _GREEN),
        *polygon(-4.6, -2.6, [(0.75, 0.0), (-0.4, 0.65), (-0.4, -0.65)], math.radians(25), _TEAL),
        Segment(-0.9, 4.5, 0.5, 2.9, _VIOLET),
    ]
    circles = [
        Circle(2.3, -0.9, 0.28, _RED),
        Circle(-0.6, 1.7, 0.22, _VIOLET),
        Circle(2.1, -2.5, 0.35, _TEAL),
        Circle(-5.1, 0.2, 0.30, _YELLOW),
    ]
    # On the south wall; the path from the start is free.
    return World(
        segments,
        circles,
        Pose(-2.4, -0.4, 0.0),
        chargers=(Charger(wall=1, along=3.3, marker=7),),
        tables=(Table(4.2, -1.0, 1.4, 0.8, 0.0, _WOOD),),
    )


@cache
def open_field() -> World:
    """A field of 80 × 80 m with a ring of far pillars: no obstacle within 15 m."""
    ring = [
        Circle(16 * math.cos(angle), 16 * math.sin(angle), 0.6, appearance)
        for angle, appearance in zip(
            (math.tau * n / 8 for n in range(8)),
            (_RED, _YELLOW, _GREEN, _BLUE, _VIOLET, _ORANGE, _TEAL, _YELLOW),
            strict=True,
        )
    ]
    return World(box(0.0, 0.0, 80.0, 80.0, 0.0, _BRICKS), ring, Pose(0.0, 0.0, 0.0))


@cache
def room() -> World:
    """A bare room of 6 × 4 m."""
    return World(box(0.0, 0.0, 6.0, 4.0, 0.0, _BRICKS), [], Pose(-1.5, 0.0, 0.0))


WORLDS: dict[str, Callable[[], World]] = {"default": default, "open": open_field, "room": room}
