"""Chains of coordinate frames."""

from __future__ import annotations

import math

import numpy as np
import pytest

from relay_protocol.errors import Unavailable
from robot_client.navigation.grid import Floats
from robot_client.navigation.transforms import TransformTree, matrix_of


def at(x: float, y: float, heading: float = 0.0) -> Floats:
    return matrix_of((x, y, 0.0), (0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)))


@pytest.fixture
def tree() -> TransformTree:
    made = TransformTree()
    made.set("map", "odom", 0.0, at(10.0, 0.0))
    for second in range(3):
        made.set("odom", "base", float(second), at(float(second), 0.0, math.pi / 2), 0.0)
    made.set("base", "laser", 0.0, at(0.5, 0.0))
    made.set("shelf", "box", 0.0, at(0.0, 0.0))
    return made


@pytest.mark.parametrize(
    ("target", "source", "stamp", "expected"),
    [
        ("map", "laser", None, (12.0, 0.5)),
        ("map", "laser", 1.2, (11.0, 0.5)),
        ("map", "laser", -5.0, (10.0, 0.5)),
        ("laser", "laser", None, (0.0, 0.0)),
        ("laser", "odom", None, (-0.5, 2.0)),
    ],
)
def test_lookup(
    tree: TransformTree, target: str, source: str, stamp: float | None, expected: tuple[float, float]
) -> None:
    assert tree.lookup(target, source, stamp)[:2, 3].tolist() == pytest.approx(list(expected))


@pytest.mark.parametrize("source", ["box", "nowhere", ""])
def test_frames_that_are_not_connected(tree: TransformTree, source: str) -> None:
    with pytest.raises(Unavailable, match="no transforms connect"):
        tree.lookup("map", source)


def test_a_static_transform_replaces_the_one_before() -> None:
    tree = TransformTree()
    tree.set("base", "camera", 5.0, at(1.0, 0.0))
    tree.set("base", "camera", 5.0, at(2.0, 0.0))
    assert tree.lookup("base", "camera", 4.0)[0, 3] == 2.0


def test_a_circle_of_frames_ends() -> None:
    tree = TransformTree()
    tree.set("a", "b", 0.0, np.eye(4))
    tree.set("b", "a", 0.0, np.eye(4))
    assert tree.lookup("a", "b").tolist() == np.eye(4).tolist()


def test_optical_frame_looks_ahead() -> None:
    matrix = matrix_of((0.0, 0.0, 0.38), (-0.5, 0.5, -0.5, 0.5))
    assert matrix[:3, 2].tolist() == pytest.approx([1.0, 0.0, 0.0])  # z of the camera is x of the robot
    assert matrix[:3, 1].tolist() == pytest.approx([0.0, 0.0, -1.0])


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0)])
def test_invalid_rotations(quaternion: tuple[float, float, float, float]) -> None:
    with pytest.raises(Unavailable, match="invalid"):
        matrix_of((0.0, 0.0, 0.0), quaternion)
