"""What is sent, made of what cameras give: as it is where that serves, else edited and encoded."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from relay_protocol.errors import Invalid
from relay_protocol.limits import PICTURE_FRAME
from relay_protocol.link import VideoSettings
from relay_protocol.pictures import look_at
from robot_client.camera import formats
from robot_client.camera.making import Maker, pixels_shot
from robot_client.camera.shot import Look, Shot, Wish

ASKED = Wish(80, 1.0, False, True, 15.0)
PIXELS = np.random.default_rng(3).integers(0, 255, (48, 64, 3), np.uint8)


def jpeg(quality: int = 97) -> bytes:
    done, encoded = cv2.imencode(".jpg", PIXELS, (cv2.IMWRITE_JPEG_QUALITY, quality))
    assert done
    return encoded.tobytes()


def file_shot(file: bytes) -> Shot:
    return Shot(5, 1.0, lambda: Look("jpeg", 64, 48), lambda: formats.decoded(file), lambda: file)


@pytest.mark.parametrize("settings", [VideoSettings(), VideoSettings(quality=100), VideoSettings(width=64)])
def test_jpeg_of_the_camera_goes_as_it_is(settings: VideoSettings) -> None:
    """Byte for byte, where nothing is asked that changes it."""
    file = jpeg()
    made = Maker(settings).make(file_shot(file), ASKED)
    assert made == (file, 64, 48, "jpeg")


@pytest.mark.parametrize(
    "odd",
    [
        lambda file: file + b"\xff\xd9",
        lambda file: file + file,
        lambda file: file[:2] + b"\xff\x01" + file[2:],
    ],
    ids=["two ends", "two pictures", "a stray marker"],
)
def test_odd_jpeg_of_the_camera_is_made_anew(odd: Callable[[bytes], bytes]) -> None:
    """Decoders don't mind, but the relay would end the stream over it."""
    file = odd(jpeg())
    made = Maker(VideoSettings()).make(file_shot(file), ASKED)
    assert made.body != file
    assert look_at("jpeg", made.body) == (64, 48, True)


@pytest.mark.parametrize(
    ("settings", "wish", "size"),
    [
        (VideoSettings(quality=30), ASKED, (64, 48)),
        (VideoSettings(invert=True), ASKED, (64, 48)),
        (VideoSettings(width=32), ASKED, (32, 24)),
        (VideoSettings(), ASKED._replace(reduced=True, quality=35), (64, 48)),
        (VideoSettings(), ASKED._replace(reduced=True, scale=0.5), (32, 24)),
    ],
)
def test_edit_or_thin_uplink_makes_another(
    settings: VideoSettings, wish: Wish, size: tuple[int, int]
) -> None:
    """Smaller than the camera's own."""
    file = jpeg()
    made = Maker(settings).make(file_shot(file), wish)
    assert (made.width, made.height) == size
    assert formats.decoded(made.body).pixels.shape[:2] == (size[1], size[0])
    assert len(made.body) < len(file)


def test_pixels_become_what_was_asked_for() -> None:
    """PNG loses nothing; the encoding told is the camera's."""
    made = Maker(VideoSettings(codec="png")).make(pixels_shot(5, 1.0, PIXELS), ASKED)
    assert (made.width, made.height, made.encoding) == (64, 48, "bgr8")
    assert np.array_equal(formats.decoded(made.body).pixels, PIXELS)


def test_picture_too_large_for_a_frame_is_refused() -> None:
    """With what to ask for instead; a camera's own JPEG of that size is encoded anew."""
    noise = np.random.default_rng(4).integers(0, 255, (1400, 1400, 3), np.uint8)
    with pytest.raises(Invalid, match="as JPEG"):
        Maker(VideoSettings(codec="png")).make(pixels_shot(5, 1.0, noise), ASKED)
    padded = jpeg() + bytes(PICTURE_FRAME)
    assert len(Maker(VideoSettings()).make(file_shot(padded), ASKED).body) < PICTURE_FRAME


def test_pixels_are_read_once_for_all_streams() -> None:
    """Several makers share what one of them has decoded."""
    read: list[int] = []

    def counted() -> formats.Raw:
        read.append(1)
        return formats.Raw("bgr8", 64, 48, PIXELS)

    shot = Shot(5, 1.0, lambda: Look("bgr8", 64, 48), counted)
    for width in (64, 32, 16):
        Maker(VideoSettings(width=width)).make(shot, ASKED)
    assert read == [1]
