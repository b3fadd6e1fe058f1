"""Encoding of camera images: unchanged if possible, otherwise edited and encoded."""

from __future__ import annotations

import struct
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from relay_protocol.errors import Invalid
from relay_protocol.image_check import validate
from relay_protocol.limits import VIDEO_FRAME
from relay_protocol.link import VideoSettings
from robot_client.camera import formats
from robot_client.camera.encoder import FrameEncoder, frame_from_message, frame_from_pixels
from robot_client.camera.frame import EncodeRequest, Frame, FrameFormat
from robot_client.camera.images import DamagedImage
from tests.worlds.image_cards import coded, compressed_cdr, depth_files, image_cdr

ASKED = EncodeRequest(80, 1.0, False, True, 15.0)
MAX_PIXELS = np.random.default_rng(3).integers(0, 255, (48, 64, 3), np.uint8)


def jpeg(quality: int = 97) -> bytes:
    done, encoded = cv2.imencode(".jpg", MAX_PIXELS, (cv2.IMWRITE_JPEG_QUALITY, quality))
    assert done
    return encoded.tobytes()


def file_shot(file: bytes) -> Frame:
    return Frame(5, 1.0, lambda: FrameFormat("jpeg", 64, 48), lambda: formats.decode_file(file), lambda: file)


@pytest.mark.parametrize("settings", [VideoSettings(), VideoSettings(quality=100), VideoSettings(width=64)])
def test_jpeg_of_the_camera_goes_as_it_is(settings: VideoSettings) -> None:
    """Byte for byte, if the request does not change it."""
    file = jpeg()
    made = FrameEncoder(settings).encode(file_shot(file), ASKED)
    assert made == (file, 64, 48, "jpeg")


def exif(orientation: int, order: str = "<") -> bytes:
    """An APP1 segment with the camera's maker and the orientation (Exif 2.32)."""
    tiff = {"<": b"II", ">": b"MM"}[order] + struct.pack(order + "HIH", 42, 8, 2)
    tiff += struct.pack(order + "HHI4s", 0x010F, 2, 4, b"abc")
    tiff += struct.pack(order + "HHIHH", 0x0112, 3, 1, orientation, 0) + bytes(4)
    return b"\xff\xe1" + struct.pack(">H", len(tiff) + 8) + b"Exif\0\0" + tiff


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_how_a_jpeg_wants_to_be_turned_does_not_go_out(orientation: int, order: str) -> None:
    """Browsers would follow it, and the picture would turn with a slower uplink; the pixels are the camera's
    own.
    """
    plain = jpeg()
    file = plain[:20] + exif(orientation, order) + plain[20:]
    made = FrameEncoder(VideoSettings()).encode(file_shot(file), ASKED)
    assert made.body == (file if orientation == 1 else plain)
    assert validate("jpeg", made.body) == (64, 48, True)
    thin = FrameEncoder(VideoSettings()).encode(file_shot(file), ASKED._replace(reduced=True))
    assert (thin.width, thin.height) == (made.width, made.height)
    for body in (made.body, thin.body):
        shown = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)
        assert shown is not None and shown.shape[:2] == (48, 64)


@pytest.mark.parametrize(
    "segment",
    [
        b"",
        b"Exif\0\0",
        b"Exif\0\0II*\0\xff\xff\xff\xff",
        b"Exif\0\0II*\0\x08\0\0\0\xff\xff",
        b"Exif\0\0XX*\0\x08\0\0\0\1\0",
        b"http://ns.adobe.com/xap/1.0/\0<x/>",
    ],
    ids=["nothing", "empty", "beyond the end", "too many entries", "no byte order", "XMP"],
)
def test_other_segments_go_as_they_are(segment: bytes) -> None:
    """This includes broken Exif, which has no effect."""
    plain = jpeg()
    file = plain[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + plain[2:]
    assert FrameEncoder(VideoSettings()).encode(file_shot(file), ASKED).body == file


@pytest.mark.parametrize(
    "odd",
    [
        lambda file: file + b"\xff\xd9",
        lambda file: file + file,
        lambda file: file[:2] + b"\xff\x01" + file[2:],
    ],
    ids=["two ends", "two pictures", "a stray marker"],
)
def test_odd_jpeg_of_the_camera_is_encoded_again(odd: Callable[[bytes], bytes]) -> None:
    """Decoders accept it, but the relay would end the stream."""
    file = odd(jpeg())
    made = FrameEncoder(VideoSettings()).encode(file_shot(file), ASKED)
    assert made.body != file
    assert validate("jpeg", made.body) == (64, 48, True)


@pytest.mark.parametrize(
    ("settings", "wanted", "size"),
    [
        (VideoSettings(quality=30), ASKED, (64, 48)),
        (VideoSettings(invert=True), ASKED, (64, 48)),
        (VideoSettings(width=32), ASKED, (32, 24)),
        (VideoSettings(), ASKED._replace(reduced=True, quality=35), (64, 48)),
        (VideoSettings(), ASKED._replace(reduced=True, scale=0.5), (32, 24)),
    ],
)
def test_edit_or_thin_uplink_makes_another(
    settings: VideoSettings, wanted: EncodeRequest, size: tuple[int, int]
) -> None:
    """It is smaller than the camera's own."""
    file = jpeg()
    made = FrameEncoder(settings).encode(file_shot(file), wanted)
    assert (made.width, made.height) == size
    assert formats.decode_file(made.body).pixels.shape[:2] == (size[1], size[0])
    assert len(made.body) < len(file)


def test_pixels_become_what_was_asked_for() -> None:
    """PNG is lossless; the reported encoding is the camera's."""
    made = FrameEncoder(VideoSettings(codec="png")).encode(frame_from_pixels(5, 1.0, MAX_PIXELS), ASKED)
    assert (made.width, made.height, made.encoding) == (64, 48, "bgr8")
    assert np.array_equal(formats.decode_file(made.body).pixels, MAX_PIXELS)


@pytest.mark.parametrize("codec", ["jpeg", "png"])
@pytest.mark.parametrize("format_", depth_files())
def test_depth_in_a_png_goes_out_in_colours(format_: str, codec: str) -> None:
    """With either codec, and never unchanged: a viewer would see black."""
    encoding = format_.partition(";")[0]
    file = compressed_cdr(depth_files()[format_], format_)
    wanted = frame_from_message(5, 1.0, image_cdr(coded(encoding)), False).raw().pixels
    shot = frame_from_message(5, 1.0, file, True)
    assert shot.jpeg() is None
    assert shot.read_format() == (encoding, 320, 240)
    made = FrameEncoder(VideoSettings(codec=codec)).encode(shot, ASKED)
    assert made.encoding == encoding
    off = np.abs(formats.decode_file(made.body).pixels.astype(int) - wanted).mean()
    assert off < (3 if codec == "jpeg" or encoding == "32FC1" else 1e-9)


def test_jpeg_that_breaks_off_is_called_damaged() -> None:
    """Even if it would be sent unchanged."""
    for settings in (VideoSettings(), VideoSettings(width=32)):
        with pytest.raises(DamagedImage, match="is cut off"):
            FrameEncoder(settings).encode(
                frame_from_message(5, 1.0, compressed_cdr(jpeg()[:-300]), True), ASKED
            )


def test_image_too_large_for_a_frame_is_refused() -> None:
    """The error suggests other settings; a camera's own JPEG of that size is encoded again."""
    noise = np.random.default_rng(4).integers(0, 255, (1400, 1400, 3), np.uint8)
    with pytest.raises(Invalid, match="as JPEG"):
        FrameEncoder(VideoSettings(codec="png")).encode(frame_from_pixels(5, 1.0, noise), ASKED)
    noise = np.random.default_rng(5).integers(0, 255, (2400, 2400, 3), np.uint8)
    with pytest.raises(Invalid, match="of less quality"):
        FrameEncoder(VideoSettings(quality=100)).encode(
            frame_from_pixels(5, 1.0, noise), ASKED._replace(quality=100)
        )
    padded = jpeg() + bytes(VIDEO_FRAME)
    assert len(FrameEncoder(VideoSettings()).encode(file_shot(padded), ASKED).body) < VIDEO_FRAME


def test_pixels_are_read_once_for_all_streams() -> None:
    """Several encoders share one decoded image."""
    read: list[int] = []

    def counted() -> formats.RawImage:
        read.append(1)
        return formats.RawImage("bgr8", 64, 48, MAX_PIXELS)

    shot = Frame(5, 1.0, lambda: FrameFormat("bgr8", 64, 48), counted)
    for width in (64, 32, 16):
        FrameEncoder(VideoSettings(width=width)).encode(shot, ASKED)
    assert read == [1]
