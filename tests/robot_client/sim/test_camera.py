"""The simulated camera's image."""

import math

import cv2
import numpy as np
import pytest

from robot_client.sim.camera import HEIGHT, WIDTH, Image, SimCamera, draw_clock, to_jpeg, to_rgb
from robot_client.sim.world import WORLDS, Circle, Colour, Pose, Texture, WallTexture, World, box

NOON = 1_700_000_000.123
HALL = WORLDS["default"]()


@pytest.fixture(scope="module")
def camera() -> SimCamera:
    return SimCamera(HALL)


def scene(frame: Image) -> np.ndarray:
    """The image above the captions."""
    return frame[: HEIGHT - 50].astype(np.int16)


def captions(frame: Image) -> np.ndarray:
    return frame[HEIGHT - 50 :].astype(np.int16)


def share_changed(one: np.ndarray, other: np.ndarray) -> float:
    return float((np.abs(one - other).max(axis=2) > 12).mean())


def test_image_is_640_by_480_bgr(camera: SimCamera) -> None:
    frame = camera.render(HALL.start, 0.0, NOON)
    assert frame.shape == (HEIGHT, WIDTH, 3) == (480, 640, 3)
    assert frame.dtype == np.uint8


def test_larger_image_shows_the_same(camera: SimCamera) -> None:
    large = SimCamera(HALL, 2 * WIDTH, 2 * HEIGHT).render(HALL.start, 0.0, NOON)
    assert large.shape == (2 * HEIGHT, 2 * WIDTH, 3)
    halved = cv2.resize(large, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    assert np.abs(scene(halved) - scene(camera.render(HALL.start, 0.0, NOON))).mean() < 3


@pytest.mark.parametrize(
    ("width", "height"), [(1280, 720), (1920, 1080), (320, 240), (320, 1080), (1920, 240)]
)
def test_other_sizes_are_drawn_whole(width: int, height: int) -> None:
    """Sky, floor and both captions."""
    frame = SimCamera(HALL, width, height).render(HALL.start, 0.0, NOON)
    assert frame.shape == (height, width, 3)
    blue, _, red = frame[0].mean(axis=0)
    assert blue > red + 30
    bottom = frame[-1].astype(int)
    assert np.ptp(bottom.mean(axis=0)) < 20
    written = np.flatnonzero((frame[height // 2 :].min(axis=2) > 225).any(axis=0))
    assert 0 < written[0] < width / 10 < width * 0.9 < written[-1] < width - 1
    assert np.diff(written).max() > width / 4


@pytest.mark.parametrize(("width", "height"), [(640, 480), (1280, 720)])
def test_the_clock_can_be_read_back(width: int, height: int) -> None:
    seen = cv2.imdecode(
        np.frombuffer(to_jpeg(SimCamera(HALL, width, height).render(HALL.start, 0.0, NOON)), np.uint8),
        cv2.IMREAD_COLOR,
    )
    corner = slice(height * 9 // 10, None), slice(0, width // 3)

    def unlike(milliseconds: int) -> float:
        drawn = np.zeros_like(seen)
        draw_clock(drawn, milliseconds / 1000 + 0.0002)
        return float(((seen[corner] > 160) ^ (drawn[corner] > 160)).sum())

    reported = round(NOON * 1000)
    assert min(range(reported - 200, reported + 200), key=unlike) == reported


@pytest.mark.parametrize("moved", [Pose(-2.2, -0.4, 0.0), Pose(-2.4, -0.4, 0.1), Pose(-2.4, -0.2, 0.0)])
def test_image_changes_visibly_with_the_pose(camera: SimCamera, moved: Pose) -> None:
    before = scene(camera.render(HALL.start, 0.0, NOON))
    assert share_changed(before, scene(camera.render(moved, 0.0, NOON))) > 0.1


def test_same_pose_gives_the_same_image(camera: SimCamera) -> None:
    one, other = (camera.render(HALL.start, 0.0, NOON) for _ in range(2))
    assert np.array_equal(one, other)


def test_clock_shows_milliseconds(camera: SimCamera) -> None:
    one, other = camera.render(HALL.start, 0.0, NOON), camera.render(HALL.start, 0.0, NOON + 0.007)
    assert np.array_equal(scene(one), scene(other))
    left, right = slice(0, WIDTH // 2), slice(WIDTH // 2, WIDTH)
    assert not np.array_equal(captions(one)[:, left], captions(other)[:, left])
    assert np.array_equal(captions(one)[:, right], captions(other)[:, right])


def test_speed_is_written_into_the_image(camera: SimCamera) -> None:
    one, other = camera.render(HALL.start, 0.1, NOON), camera.render(HALL.start, 0.3, NOON)
    assert not np.array_equal(captions(one)[:, WIDTH // 2 :], captions(other)[:, WIDTH // 2 :])


def coloured_pillar(colour: Colour, distance: float) -> World:
    grey = WallTexture(Colour(128, 128, 128), Texture.BRICK)
    return World(
        box(0, 0, 20, 20, 0, grey),
        [Circle(distance, 0.0, 0.3, WallTexture(colour, Texture.PANEL))],
        Pose(0, 0, 0),
    )


def test_pillar_ahead_has_its_colour_in_the_middle() -> None:
    camera = SimCamera(coloured_pillar(Colour(20, 20, 230), 2.0))
    blue, _, red = camera.render(Pose(0, 0, 0), 0, NOON)[HEIGHT // 2 + 20, WIDTH // 2].astype(int)
    assert red > blue + 80
    blue, _, red = camera.render(Pose(0, 0, math.pi / 2), 0, NOON)[HEIGHT // 2 + 20, WIDTH // 2].astype(int)
    assert red < blue + 40


def width_of_red(frame: Image) -> int:
    row = frame[HEIGHT // 2 + 20].astype(int)
    return int((row[:, 2] > row[:, 0] + 60).sum())


def test_near_obstacles_are_larger() -> None:
    camera = SimCamera(coloured_pillar(Colour(20, 20, 230), 4.0))
    far, near = (width_of_red(camera.render(Pose(x, 0, 0), 0, NOON)) for x in (0.0, 2.0))
    assert near == pytest.approx(2 * far, rel=0.12)


def test_left_is_left() -> None:
    camera = SimCamera(coloured_pillar(Colour(20, 20, 230), 3.0))
    frame = camera.render(Pose(0, 0, -0.3), 0, NOON)
    assert width_of_red(frame[:, : WIDTH // 2]) > 0
    assert width_of_red(frame[:, WIDTH // 2 :]) == 0


def test_image_right_before_a_wall(camera: SimCamera) -> None:
    with np.errstate(all="raise"):
        frame = camera.render(Pose(5.999, 0.0, 0.0), 0.0, NOON)
    assert frame.shape == (HEIGHT, WIDTH, 3)


def test_jpeg_decodes_to_about_the_same(camera: SimCamera) -> None:
    frame = camera.render(HALL.start, 0.0, NOON)
    decoded = cv2.imdecode(np.frombuffer(to_jpeg(frame), np.uint8), cv2.IMREAD_COLOR)
    assert decoded.shape == frame.shape
    assert np.abs(decoded.astype(int) - frame).mean() < 6


def test_rgb_swaps_the_channels(camera: SimCamera) -> None:
    frame = camera.render(HALL.start, 0.0, NOON)
    assert np.array_equal(to_rgb(frame), frame[:, :, ::-1])
