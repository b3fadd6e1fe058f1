"""Draws tables into the camera's image: plates and legs, by columns like the walls."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from robot_client.sim import textures
from robot_client.sim.charger_plates import CameraView
from robot_client.sim.world import Floats, PlateHits, World

_NEAREST = 0.05
_PLATE_LIGHT, _LEG_LIGHT = 0.95, 0.6

Image = npt.NDArray[np.uint8]


def draw_tables(
    frame: Image, world: World, view: CameraView, origin: tuple[float, float], angles: Floats, depth: Floats
) -> None:
    """Draw the visible tables over the walls, the farthest first.

    :param frame: BGR, shape (height, width, 3)
    :param origin: of the camera, metres
    :param angles: absolute direction of each column, radians
    :param depth: metres to the wall of each column, along its ray
    """
    tables = world.cast_tables(*origin, angles)
    for hits in sorted(tables, key=lambda each: -float(each.enter.min())):
        _draw_table(frame, view, hits, np.cos(angles - angles[len(angles) // 2]), depth)


def _draw_table(frame: Image, view: CameraView, hits: PlateHits, straighten: Floats, depth: Floats) -> None:
    table = hits.table
    legs = np.flatnonzero(hits.leg < depth)
    if len(legs):
        near = np.maximum(hits.leg[legs] * straighten[legs], _NEAREST)
        rows = _row(view, table.underside, near), _row(view, 0.0, near)
        _fill(frame, legs, *rows, _colour(hits, hits.leg[legs], _LEG_LIGHT))
    columns = np.flatnonzero(hits.enter < depth)
    if len(columns):
        faces = [
            _row(view, height, np.maximum(reach[columns] * straighten[columns], _NEAREST))
            for height in (table.underside, table.top)
            for reach in (hits.enter, np.minimum(hits.leave, depth))
        ]
        top, bottom = np.minimum.reduce(faces), np.maximum.reduce(faces)
        _fill(frame, columns, top, bottom, _colour(hits, hits.enter[columns], _PLATE_LIGHT))


def _row(view: CameraView, height: float, depth: Floats) -> Floats:
    return view.horizon - (height - view.height) * view.focal / depth


def _colour(hits: PlateHits, distance: Floats, light: float) -> Floats:
    """Colour of each column, fading with the distance, shape (columns, 3)."""
    clear = np.exp(-distance / textures.FOG_LENGTH)[:, None]
    colour: Floats = np.array(hits.table.appearance.colour) * light * clear + np.array(textures.FOG) * (
        1 - clear
    )
    return colour


def _fill(frame: Image, columns: npt.NDArray[np.intp], top: Floats, bottom: Floats, colour: Floats) -> None:
    """Fill the rows from ``top`` to ``bottom`` of some columns, at least one row each."""
    first, last = max(0, int(top.min())), min(len(frame), int(bottom.max()) + 2)
    rows = np.arange(first, last)[:, None]
    inside = (rows >= np.floor(top)) & (rows < np.maximum(np.floor(bottom), np.floor(top) + 1))
    block = frame[first:last, columns]
    frame[first:last, columns] = np.where(inside[:, :, None], colour.astype(np.uint8), block)
