"""The camera's picture: form, what is seen in it, and that it changes with pose, time and speed."""

import math

import cv2
import numpy as np
import pytest

from robot_client.sim.camera import HEIGHT, WIDTH, Image, SimCamera, draw_clock, to_jpeg, to_rgb
from robot_client.sim.world import Circle, Colour, Pose, Texture, WallTexture, World, box
from robot_client.sim.worlds import WORLDS

NOON = 1_700_000_000.123
HALL = WORLDS["default"]()


@pytest.fixture(scope="module")
def camera() -> SimCamera:
    return SimCamera(HALL)


def scene(frame: Image) -> np.ndarray:
    """The picture above the captions."""
    return frame[: HEIGHT - 50].astype(np.int16)


def captions(frame: Image) -> np.ndarray:
    return frame[HEIGHT - 50 :].astype(np.int16)


def share_changed(one: np.ndarray, other: np.ndarray) -> float:
    return float((np.abs(one - other).max(axis=2) > 12).mean())


def test_picture_is_640_by_480_bgr(camera: SimCamera) -> None:
    """The form is what the topics announce."""
    frame = camera.render(HALL.start, 0.0, NOON)
    assert frame.shape == (HEIGHT, WIDTH, 3) == (480, 640, 3)
    assert frame.dtype == np.uint8


def test_a_larger_picture_shows_the_same(camera: SimCamera) -> None:
    """Twice the size halved again is nearly the usual picture."""
    large = SimCamera(HALL, 2 * WIDTH, 2 * HEIGHT).render(HALL.start, 0.0, NOON)
    assert large.shape == (2 * HEIGHT, 2 * WIDTH, 3)
    halved = cv2.resize(large, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    assert np.abs(scene(halved) - scene(camera.render(HALL.start, 0.0, NOON))).mean() < 3


@pytest.mark.parametrize(
    ("width", "height"), [(1280, 720), (1920, 1080), (320, 240), (320, 1080), (1920, 240)]
)
def test_other_sizes_are_drawn_whole(width: int, height: int) -> None:
    """Of any form: sky above, floor below, and both captions within the picture, apart from each other."""
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
    """Of clocks drawn for a second's milliseconds, the one in a picture that was encoded is found again."""
    seen = cv2.imdecode(
        np.frombuffer(to_jpeg(SimCamera(HALL, width, height).render(HALL.start, 0.0, NOON)), np.uint8),
        cv2.IMREAD_COLOR,
    )
    corner = slice(height * 9 // 10, None), slice(0, width // 3)

    def unlike(milliseconds: int) -> float:
        drawn = np.zeros_like(seen)
        draw_clock(drawn, milliseconds / 1000 + 0.0002)
        return float(((seen[corner] > 160) ^ (drawn[corner] > 160)).sum())

    told = round(NOON * 1000)
    assert min(range(told - 200, told + 200), key=unlike) == told


@pytest.mark.parametrize("moved", [Pose(-2.2, -0.4, 0.0), Pose(-2.4, -0.4, 0.1), Pose(-2.4, -0.2, 0.0)])
def test_picture_changes_visibly_with_pose(camera: SimCamera, moved: Pose) -> None:
    """Twenty centimetres or six degrees change at least a tenth of the picture."""
    before = scene(camera.render(HALL.start, 0.0, NOON))
    assert share_changed(before, scene(camera.render(moved, 0.0, NOON))) > 0.1


def test_same_pose_same_picture(camera: SimCamera) -> None:
    """Nothing flickers: a standing robot sends the same scene."""
    one, other = (camera.render(HALL.start, 0.0, NOON) for _ in range(2))
    assert np.array_equal(one, other)


def test_clock_shows_milliseconds(camera: SimCamera) -> None:
    """Seven milliseconds later only the clock differs."""
    one, other = camera.render(HALL.start, 0.0, NOON), camera.render(HALL.start, 0.0, NOON + 0.007)
    assert np.array_equal(scene(one), scene(other))
    left, right = slice(0, WIDTH // 2), slice(WIDTH // 2, WIDTH)
    assert not np.array_equal(captions(one)[:, left], captions(other)[:, left])
    assert np.array_equal(captions(one)[:, right], captions(other)[:, right])


def test_speed_is_written_in(camera: SimCamera) -> None:
    """Another speed changes the right caption."""
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
    """A red pillar is red in the picture, and out of it when the robot looks away."""
    camera = SimCamera(coloured_pillar(Colour(20, 20, 230), 2.0))
    blue, _, red = camera.render(Pose(0, 0, 0), 0, NOON)[HEIGHT // 2 + 20, WIDTH // 2].astype(int)
    assert red > blue + 80
    blue, _, red = camera.render(Pose(0, 0, math.pi / 2), 0, NOON)[HEIGHT // 2 + 20, WIDTH // 2].astype(int)
    assert red < blue + 40


def width_of_red(frame: Image) -> int:
    row = frame[HEIGHT // 2 + 20].astype(int)
    return int((row[:, 2] > row[:, 0] + 60).sum())


def test_near_things_are_larger() -> None:
    """At half the distance a pillar is about twice as wide."""
    camera = SimCamera(coloured_pillar(Colour(20, 20, 230), 4.0))
    far, near = (width_of_red(camera.render(Pose(x, 0, 0), 0, NOON)) for x in (0.0, 2.0))
    assert near == pytest.approx(2 * far, rel=0.12)


def test_left_is_left() -> None:
    """A thing to the left of the heading appears in the left half."""
    camera = SimCamera(coloured_pillar(Colour(20, 20, 230), 3.0))
    frame = camera.render(Pose(0, 0, -0.3), 0, NOON)
    assert width_of_red(frame[:, : WIDTH // 2]) > 0
    assert width_of_red(frame[:, WIDTH // 2 :]) == 0


def test_touching_a_wall_still_draws(camera: SimCamera) -> None:
    """With the wall right before the lens the picture is wall from top to bottom, and no number overflows."""
    with np.errstate(all="raise"):
        frame = camera.render(Pose(5.999, 0.0, 0.0), 0.0, NOON)
    assert frame.shape == (HEIGHT, WIDTH, 3)


def test_jpeg_decodes_to_about_the_same(camera: SimCamera) -> None:
    """Encoding keeps the form and nearly the colours."""
    frame = camera.render(HALL.start, 0.0, NOON)
    decoded = cv2.imdecode(np.frombuffer(to_jpeg(frame), np.uint8), cv2.IMREAD_COLOR)
    assert decoded.shape == frame.shape
    assert np.abs(decoded.astype(int) - frame).mean() < 6


def test_rgb_turns_the_channels_round(camera: SimCamera) -> None:
    """The raw topic is announced as rgb8."""
    frame = camera.render(HALL.start, 0.0, NOON)
    assert np.array_equal(to_rgb(frame), frame[:, :, ::-1])
