"""Edits, checked by pixels, and invalid sizes."""

from __future__ import annotations

import numpy as np
import pytest

from relay_protocol.errors import Invalid
from relay_protocol.link import VideoSettings
from robot_client.camera.encoder import JpegEncoder
from robot_client.camera.formats import Pixels, decode_file
from robot_client.camera.transforms import plan_transforms

NOON = 1_763_726_400.789
"""2025-11-21 12:00:00.789 UTC."""


def numbered(width: int = 8, height: int = 6) -> Pixels:
    """Every pixel has its own colour: its row, its column, 9. Not writable, like a message's pixels."""
    rows, columns = np.mgrid[0:height, 0:width]
    picture = np.stack((rows, columns, np.full_like(rows, 9)), axis=2).astype(np.uint8)
    picture.flags.writeable = False
    return picture


def edited(picture: Pixels, scale: float = 1.0, **settings: object) -> Pixels:
    """The image after its edits, in the planned size."""
    planned = plan_transforms(VideoSettings(**settings), picture.shape[1], picture.shape[0], scale)
    shown = planned.apply(picture, NOON)
    assert shown.shape[1::-1] == (planned.width, planned.height)
    assert shown.dtype == np.uint8
    return shown


def corners(picture: Pixels) -> list[tuple[int, int]]:
    """Row and column in the original: upper left, upper right, lower left, lower right."""
    return [tuple(picture[row, column, :2].tolist()) for row in (0, -1) for column in (0, -1)]


@pytest.mark.parametrize(
    "settings", [{}, {"width": 8}, {"height": 6}, {"crop": (0, 0, 8, 6)}, {"quality": 5}]
)
def test_empty_plan_does_nothing(settings: dict[str, object]) -> None:
    """The pixels are the same, and the file of a CompressedImage may be sent unchanged."""
    planned = plan_transforms(VideoSettings(**settings), 8, 6)
    assert not planned.changes
    assert np.shares_memory(planned.apply(picture := numbered(), NOON), picture)


@pytest.mark.parametrize(
    "settings",
    [{"width": 7}, {"crop": (0, 0, 8, 5)}, {"rotate": 180}, {"invert": True}, {"stamp": True}, {"width": 16}],
)
def test_anything_to_do_touches(settings: dict[str, object]) -> None:
    """Then a CompressedImage has to be decoded."""
    assert plan_transforms(VideoSettings(**settings), 8, 6).changes


def test_turned_twice_by_half_is_not_touched() -> None:
    """Rotated by 180 and inverted it is unchanged."""
    assert not plan_transforms(VideoSettings(rotate=180, invert=True), 8, 6).changes


def test_crop_shows_its_part() -> None:
    """x, y, width, height, in pixels of the camera."""
    assert np.array_equal(edited(numbered(), crop=(2, 1, 4, 3)), numbered()[1:4, 2:6])


def test_crop_is_clipped_to_the_image() -> None:
    """Parts outside are cut off."""
    assert np.array_equal(edited(numbered(), crop=(5, 4, 100, 100)), numbered()[4:, 5:])


@pytest.mark.parametrize(
    ("crop", "words"),
    [
        ((8, 0, 2, 2), "outside the camera's image of 8×6 pixels"),
        ((0, 6, 2, 2), "outside the camera's image of 8×6 pixels"),
        ((1, 1, 0, 2), "width 0 or height 0"),
        ((1, 1, 2, 0), "width 0 or height 0"),
    ],
)
def test_crop_of_nothing_is_refused_with_the_reason(crop: tuple[int, int, int, int], words: str) -> None:
    """The error has the camera's size."""
    with pytest.raises(Invalid, match=words):
        plan_transforms(VideoSettings(crop=crop), 8, 6)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"rotate": 90}, [(5, 0), (0, 0), (5, 7), (0, 7)]),
        ({"rotate": 180}, [(5, 7), (5, 0), (0, 7), (0, 0)]),
        ({"invert": True}, [(5, 7), (5, 0), (0, 7), (0, 0)]),
        ({"rotate": 270}, [(0, 7), (5, 7), (0, 0), (5, 0)]),
        ({"rotate": 90, "invert": True}, [(0, 7), (5, 7), (0, 0), (5, 0)]),
        ({"rotate": 270, "invert": True}, [(5, 0), (0, 0), (5, 7), (0, 7)]),
    ],
)
def test_turns_are_clockwise(settings: dict[str, object], expected: list[tuple[int, int]]) -> None:
    """Checked by the positions of the corners."""
    assert corners(edited(numbered(), **settings)) == expected


def test_crop_comes_before_turning() -> None:
    """The crop is in the camera's coordinates, for any rotation."""
    assert np.array_equal(edited(numbered(), crop=(0, 0, 3, 2), invert=True), numbered()[1::-1, 2::-1])


@pytest.mark.parametrize(
    ("settings", "size"),
    [
        ({"width": 320}, (320, 240)),
        ({"height": 120}, (160, 120)),
        ({"width": 100, "height": 100}, (100, 100)),
        ({"width": 1280}, (1280, 960)),
        ({"rotate": 90, "width": 240}, (240, 320)),
        ({"crop": (0, 0, 100, 200), "height": 100}, (50, 100)),
        ({"width": 1}, (1, 1)),
        ({"width": 333, "codec": "h264"}, (332, 250)),
        ({"width": 1, "codec": "h264"}, (2, 2)),
    ],
)
def test_sizes_come_out_as_asked(settings: dict[str, object], size: tuple[int, int]) -> None:
    """A missing side is computed after rotation; H.264 has only even sides."""
    shown = edited(np.zeros((480, 640, 3), np.uint8), **settings)
    assert shown.shape[1::-1] == size


def test_the_pace_makes_it_smaller_never_larger() -> None:
    """Its scale refers to the requested size."""
    black = np.zeros((480, 640, 3), np.uint8)
    assert edited(black, 0.5, width=320).shape == (120, 160, 3)
    assert edited(black, 0.5).shape == (240, 320, 3)
    assert edited(black, 3.0, width=320).shape == (240, 320, 3)
    assert edited(black, 0.0001).shape == (1, 1, 3)


def test_shrinking_averages() -> None:
    """A fine checkerboard becomes grey, not black or white."""
    board = (np.indices((40, 60)).sum(axis=0) % 2 * 255).astype(np.uint8)
    assert np.unique(edited(board, width=30)).tolist() in ([127], [128])


def test_growing_interpolates() -> None:
    """Values between two pixels lie between them."""
    step = np.repeat(np.array([[0, 200]], np.uint8), 2, axis=0)
    assert len(np.unique(edited(step, width=16))) > 4


def test_scaling_after_turning_gives_the_same() -> None:
    """The order is free: a rotated image is scaled as well."""
    picture = np.random.default_rng(5).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    turned = edited(edited(picture, rotate=90), width=15)
    assert np.abs(edited(picture, rotate=90, width=15).astype(int) - turned).max() <= 1


@pytest.mark.parametrize("settings", [{"width": 8192}, {"crop": (0, 0, 1, 100), "width": 100}])
def test_a_side_that_would_get_too_long_is_refused(settings: dict[str, object]) -> None:
    """A computed side has the same limit."""
    with pytest.raises(Invalid, match="at most 8192"):
        plan_transforms(VideoSettings(**settings), 100, 1000)


def test_images_are_not_enlarged_without_bound() -> None:
    """8192×8192 needs 200 MB for each stream; a camera of that size may be shown."""
    with pytest.raises(Invalid, match="after enlarging"):
        plan_transforms(VideoSettings(width=8192, height=8192), 64, 48)
    assert plan_transforms(VideoSettings(width=3840, height=2160), 64, 48).changes
    assert not plan_transforms(VideoSettings(), 8192, 8192).changes


@pytest.mark.parametrize("shape", [(480, 640, 3), (480, 640), (1, 1, 3), (3, 3000)])
def test_time_is_burned_into_a_copy(shape: tuple[int, ...]) -> None:
    """Only in the upper left corner; the camera's own pixels stay, and grey stays grey."""
    picture = np.full(shape, 100, np.uint8)
    shown = edited(picture, stamp=True)
    assert shown.shape == shape
    assert (picture == 100).all()
    assert not (shown == 100).all()
    assert (shown[40:] == 100).all()


STAMP_ROWS = 80


def clocks(width: int, height: int, place: float) -> list[Pixels]:
    """The top of a picture, where the stamp is, with each digit in one place of the time.

    It is on noise, after JPEG of medium quality.
    """
    noise = np.random.default_rng(2).integers(0, 256, (height, width, 3), dtype=np.uint8)
    planned = plan_transforms(VideoSettings(stamp=True), width, height)
    return [
        decode_file(JpegEncoder().encode(planned.apply(noise, NOON + digit * place), 60, True)[0])
        .pixels[:STAMP_ROWS]
        .astype(np.int16)
        for digit in range(10)
    ]


@pytest.mark.parametrize(
    ("size", "place"),
    [((64, 48), 1), ((96, 72), 1), ((160, 120), 0.01), ((640, 480), 0.001), ((1920, 1080), 0.001)],
)
def test_digits_can_be_distinguished_in_small_images(size: tuple[int, int], place: float) -> None:
    """Any two digits differ in several pixels by more than JPEG changes: seconds at 64 pixels, then more."""
    shown = clocks(*size, place)
    for one in range(10):
        for other in range(one):
            clearly = np.abs(shown[one] - shown[other]).min(axis=2) > 60
            assert clearly.sum() >= 3, (other, one)


def test_more_of_the_time_is_shown_where_there_is_room() -> None:
    """From seconds to date and zone; never wider than the picture."""
    plates = []
    for width in (64, 100, 150, 400):
        shown = edited(np.full((width, width), 100, np.uint8), stamp=True)
        plates.append(int((shown != 100).any(axis=0).sum()))
        assert plates[-1] <= width
    assert plates == sorted(plates)
    assert plates[-1] > 3 * plates[0]


def test_time_is_upright_for_any_rotation() -> None:
    """It is added last, at the top of the final picture."""
    grey = np.full((480, 640), 100, np.uint8)
    for rotate in (0, 90, 180, 270):
        shown = edited(grey, rotate=rotate, stamp=True)
        assert shown[0, 0] < 20
        assert (shown[40:] == 100).all()
    assert np.array_equal(edited(grey, invert=True, stamp=True), edited(grey, stamp=True))


def test_stamp_takes_its_size_from_what_is_shown() -> None:
    """It is added after scaling, so it is sharp in a small picture."""
    large, small = np.full((480, 640), 100, np.uint8), np.full((120, 160), 100, np.uint8)
    assert np.array_equal(edited(large, width=160, stamp=True), edited(small, stamp=True))
