"""Faces in images of real people: positions and names."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from skimage import data

from relay_protocol.errors import Invalid, SwitchboardError, Unavailable
from robot_client.services.camera_model import of_view
from robot_client.services.faces import (
    FACE,
    Box,
    FaceFinder,
    KnownFaces,
    find_faces,
    histograms,
    likeness,
    read_grey_image,
    read_people,
)
from tests.worlds.face_images import EILEEN, people, scene, stranger

LENS = of_view(640, 480, 75)
FACE_AT = (144, 113)
"""Column and row of the middle of Eileen's face."""


@pytest.fixture(scope="module")
def finder() -> FaceFinder:
    return FaceFinder()


@pytest.fixture
def known(finder: FaceFinder, tmp_path: Path) -> KnownFaces:
    return read_people(people(tmp_path / "people"), finder)


@pytest.mark.parametrize(("factor", "at"), [(0.9, (100, 20)), (0.6, (300, 100)), (0.45, (20, 200))])
def test_face_is_found_at_its_position(finder: FaceFinder, factor: float, at: tuple[int, int]) -> None:
    (box,) = finder.find(scene(EILEEN, factor, at))
    middle = (box.left + box.side / 2, box.top + box.side / 2)
    expected = (at[0] + factor * FACE_AT[0], at[1] + factor * FACE_AT[1])
    assert middle == pytest.approx(expected, abs=25 * factor)
    assert 70 * factor < box.side < 170 * factor


@pytest.mark.parametrize("name", ["coffee", "brick", "grass", "gravel", "coins", "page"])
def test_no_face_is_found_in_other_images(finder: FaceFinder, name: str) -> None:
    pixels = getattr(data, name)()
    grey = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    assert finder.find(np.asarray(grey)) == []


@pytest.mark.parametrize("shape", [(1, 1), (20, 640), (24, 24), (480, 1), (1, 1000)])
def test_images_of_any_size_are_accepted(finder: FaceFinder, shape: tuple[int, int]) -> None:
    assert finder.find(np.zeros(shape, np.uint8)) == []


@pytest.mark.parametrize(("factor", "light"), [(1.0, 1.0), (0.8, 1.0), (0.7, 0.6), (0.8, 1.3), (0.6, 1.0)])
def test_known_person_is_recognised(
    finder: FaceFinder, known: KnownFaces, factor: float, light: float
) -> None:
    """At other distances and brightness, and with noise."""
    picture = scene(EILEEN, factor, (60, 20), light).astype(float)
    picture += np.random.default_rng(1).normal(0, 3, picture.shape)
    pixels = cv2.cvtColor(np.clip(picture, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)
    seen = find_faces(np.asarray(pixels, np.uint8), LENS, finder, known)[0]
    assert (seen.name, known.names) == ("eileen", ["eileen"])
    assert 0.7 < seen.similarity <= 1.0


def test_strangers_are_not_recognised(finder: FaceFinder, known: KnownFaces) -> None:
    found = [find_faces(scene(stranger(n), 1.0, (150, 100)), LENS, finder, known) for n in range(40)]
    assert sum(1 for each in found if each) >= 30
    assert not [seen for each in found for seen in each if seen.name]


def test_people_are_recognised_by_name(finder: FaceFinder, known: KnownFaces) -> None:
    picture = scene(stranger(3), 1.0, (150, 100))
    (box,) = finder.find(picture)
    known.add("a stranger", picture, box)
    assert known.recognise(picture, box) == ("a stranger", pytest.approx(1.0))
    (seen,) = find_faces(scene(EILEEN, 0.8, (50, 20)), LENS, finder, known)
    assert seen.name == "eileen"
    assert known.names == ["a stranger", "eileen"]


def test_no_face_is_recognised_without_known_persons(finder: FaceFinder) -> None:
    (seen,) = find_faces(scene(EILEEN, 0.8, (50, 20)), LENS, finder, KnownFaces())
    assert (seen.name, seen.similarity) == (None, 0.0)


def test_distance_and_bearing_follow_from_the_size(finder: FaceFinder) -> None:
    (near,) = find_faces(scene(EILEEN, 0.8, (0, 20)), LENS, finder, KnownFaces())
    (far,) = find_faces(scene(EILEEN, 0.4, (0, 20)), LENS, finder, KnownFaces())
    assert near.position[2] == pytest.approx(LENS.fx * FACE / near.box.side)
    assert far.distance == pytest.approx(2 * near.distance, rel=0.25)
    middle = near.box.left + near.box.side / 2
    assert near.bearing == pytest.approx(math.atan2(LENS.cx - middle, LENS.fx))
    assert far.bearing > near.bearing > 0


def test_face_at_the_edge_can_be_compared() -> None:
    """Outside the image its edge is repeated."""
    found = histograms(EILEEN, Box(-20, -20, 120))
    assert found.shape == (49 * 59,)
    assert found.sum() == pytest.approx(49.0)
    assert likeness(found[None], found)[0] == pytest.approx(1.0)
    assert 0.0 <= likeness(found[None], histograms(EILEEN, Box(450, 450, 120)))[0] < 1.0


def test_folder_may_have_several_images_of_a_person(finder: FaceFinder, tmp_path: Path) -> None:
    folder = people(tmp_path / "people")
    (folder / "valentina").mkdir()
    for number in (1, 2):
        cv2.imwrite(str(folder / "valentina" / f"{number}.JPG"), EILEEN)
    (folder / "notes.txt").write_text("not looked at")
    assert read_people(folder, finder).names == ["eileen", "valentina"]


@pytest.mark.parametrize(
    ("name", "what", "error", "words"),
    [
        ("", b"", Unavailable, "the folder has no images"),
        ("a.jpg", b"no picture", Invalid, "a.jpg"),
        ("a.png", "grey", Invalid, "no face found"),
        ("x" * 65 + ".png", "grey", Invalid, "is no name of 1 to"),
    ],
)
def test_unusable_folders_are_reported(
    finder: FaceFinder,
    tmp_path: Path,
    name: str,
    what: bytes | str,
    error: type[SwitchboardError],
    words: str,
) -> None:
    grey = cv2.imencode(".png", np.full((100, 100), 128, np.uint8))[1].tobytes()
    if name:
        (tmp_path / name).write_bytes(grey if isinstance(what, str) else what)
    with pytest.raises(error, match=words):
        read_people(tmp_path, finder)


def test_unreadable_files_are_reported(finder: FaceFinder, tmp_path: Path) -> None:
    with pytest.raises(Unavailable, match="nowhere: No such file"):
        read_people(tmp_path / "nowhere", finder)
    with pytest.raises(Unavailable, match=r"gone\.png: No such file"):
        read_grey_image(tmp_path / "gone.png")
    (tmp_path / "large.png").write_bytes(bytes(20_000_001))
    with pytest.raises(Invalid, match="larger than 20 MB"):
        read_grey_image(tmp_path / "large.png")
