"""The worlds one can choose by name."""

from __future__ import annotations

import math
from collections.abc import Callable

from robot_client.sim.world import (
    Charger,
    Circle,
    Colour,
    Pose,
    Segment,
    Texture,
    WallTexture,
    World,
    box,
    polygon,
)

_BRICKS = WallTexture(Colour(92, 112, 168), Texture.BRICK)
_PLASTER = WallTexture(Colour(176, 190, 196), Texture.PANEL)
_RED = WallTexture(Colour(58, 64, 214), Texture.STRIPES)
_GREEN = WallTexture(Colour(86, 170, 74), Texture.PANEL)
_BLUE = WallTexture(Colour(206, 128, 52), Texture.PANEL)
_YELLOW = WallTexture(Colour(60, 196, 240), Texture.CHEVRON)
_TEAL = WallTexture(Colour(160, 164, 40), Texture.STRIPES)
_VIOLET = WallTexture(Colour(190, 86, 148), Texture.STRIPES)
_ORANGE = WallTexture(Colour(40, 132, 240), Texture.CHEVRON)


def default() -> World:
    """A hall of 12 × 9 m: a room behind a doorway, crates, a wedge, a slanted wall, pillars and a charger."""
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
    # On the wall in the south, where the way from the start is free.
    return World(segments, circles, Pose(-2.4, -0.4, 0.0), (Charger(wall=1, along=3.3, marker=7),))


def open_field() -> World:
    """A field of 80 × 80 m with a ring of far pillars: nothing in the way for 15 m."""
    ring = [
        Circle(16 * math.cos(angle), 16 * math.sin(angle), 0.6, look)
        for angle, look in zip(
            (math.tau * n / 8 for n in range(8)),
            (_RED, _YELLOW, _GREEN, _BLUE, _VIOLET, _ORANGE, _TEAL, _YELLOW),
            strict=True,
        )
    ]
    return World(box(0.0, 0.0, 80.0, 80.0, 0.0, _BRICKS), ring, Pose(0.0, 0.0, 0.0))


def room() -> World:
    """A bare room of 6 × 4 m."""
    return World(box(0.0, 0.0, 6.0, 4.0, 0.0, _BRICKS), [], Pose(-1.5, 0.0, 0.0))


WORLDS: dict[str, Callable[[], World]] = {"default": default, "open": open_field, "room": room}
