"""H.264, decoded by another program's decoder and compared."""

from __future__ import annotations

import math
import re
from functools import cache

import av
import cv2
import numpy as np
import pytest

from relay_protocol.errors import Unavailable
from robot_client.camera.encoder import Encoder, JpegEncoder, build_encoder
from robot_client.camera.formats import Pixels
from robot_client.sim.camera import SimCamera
from robot_client.sim.world import WORLDS, Pose
from tests.robot_client.camera.contact_sheet import h264_decoded
from tests.worlds.image_cards import PATCHES, card, grey_of, middle_of

SLICE, IDR, SEI, SPS, PPS = 1, 5, 6, 7, 8


@cache
def drive() -> tuple[Pixels, ...]:
    """Three seconds of a robot driving a curve, by a camera with a little noise."""
    world = WORLDS["default"]()
    camera, random, start = SimCamera(world), np.random.default_rng(4), world.start
    poses = [Pose(start.x + 0.01 * i, start.y, start.heading + 0.01 * i) for i in range(45)]
    frames = [camera.render(pose, 0.2, 1_700_000_000 + i / 15) for i, pose in enumerate(poses)]
    return tuple(np.clip(each + random.normal(0, 2, each.shape), 0, 255).astype(np.uint8) for each in frames)


def encoder(width: int = 640, height: int = 480) -> Encoder:
    return build_encoder("h264", width, height, 15)


def units(picture: bytes) -> list[int]:
    """Types of the NAL units of one frame."""
    return [int(found[1][0]) & 31 for found in re.finditer(rb"\x00\x00\x01(.)", picture, re.DOTALL)]


def psnr(one: Pixels, other: Pixels) -> float:
    error = np.square(one.astype(float) - other).mean()
    return 10 * math.log10(255**2 / error) if error else math.inf


def test_a_stream_is_decoded_to_what_went_in() -> None:
    """Every frame, in order, within the loss of JPEG of the same quality; only the first is a key frame."""
    stream = encoder()
    made = [stream.encode(each, 80, False) for each in drive()]
    assert [key for _, key in made] == [True] + [False] * 44
    shown = h264_decoded([body for body, _ in made])
    assert len(shown) == 45
    assert min(psnr(one, other) for one, other in zip(drive(), shown, strict=True)) > 30


def test_it_takes_a_third_of_the_bytes_of_jpeg_or_less() -> None:
    """At the same size and quality, for a moving picture."""
    stream = encoder()
    h264 = sum(len(stream.encode(each, 80, False)[0]) for each in drive())
    jpeg = sum(len(JpegEncoder().encode(each, 80, False)[0]) for each in drive())
    assert 3 < jpeg / h264 < 7


def test_frames_come_out_at_once_as_annex_b() -> None:
    """Start code first; a key frame with its parameter sets, any other frame as one slice that refers only to
    earlier ones.
    """
    stream = encoder()
    for number, each in enumerate(drive()[:8]):
        body, key = stream.encode(each, 80, number == 5)
        assert body.startswith((b"\0\0\0\1", b"\0\0\1"))
        assert key == (number in (0, 5))
        assert [kind for kind in units(body) if kind != SEI] == ([SPS, PPS, IDR] if key else [SLICE])


def test_a_decoder_that_joins_at_a_key_frame_sees_all_from_there() -> None:
    """Later frames do not refer to earlier ones."""
    stream = encoder()
    made = [stream.encode(each, 80, number == 20)[0] for number, each in enumerate(drive()[:30])]
    shown = h264_decoded(made[20:])
    assert len(shown) == 10
    assert psnr(shown[-1], drive()[29]) > 30


def test_no_frame_refers_to_a_later_one() -> None:
    """A decoder outputs each frame at once: there is no delay."""
    stream, context = encoder(), av.VideoCodecContext.create("h264", "r")
    context.flags |= 1 << 19  # AV_CODEC_FLAG_LOW_DELAY: otherwise libavcodec waits for one more frame
    context.thread_count = 1
    shown = [len(context.decode(av.Packet(stream.encode(each, 80, False)[0]))) for each in drive()[:6]]
    assert shown == [1] * 6


def test_less_quality_is_fewer_bytes_at_once_and_without_a_key_frame() -> None:
    """The rate control lowers it when the link is full, which a key frame would fill further."""
    stream = encoder()
    fine = [stream.encode(each, 80, False) for each in drive()[:15]]
    coarse = [stream.encode(each, 40, False) for each in drive()[15:30]]
    back = [stream.encode(each, 80, False) for each in drive()[30:]]
    assert not any(key for _, key in [*fine[1:], *coarse, *back])
    sizes = [sum(len(body) for body, _ in part[5:]) for part in (fine, coarse, back)]
    assert sizes[1] < sizes[0] / 2
    assert sizes[2] > 1.5 * sizes[1]


def test_a_stream_that_began_thin_gets_as_fine_as_one_that_did_not() -> None:
    """A quality above the initial one restarts the encoder with a key frame."""
    stream, fine = encoder(), encoder()
    for each in drive()[:10]:
        stream.encode(each, 20, False)
    made = [(stream.encode(each, 80, False), fine.encode(each, 80, False)) for each in drive()[10:]]
    assert [risen[1] for risen, _ in made] == [True] + [False] * 34
    total = [sum(len(each[which][0]) for each in made) for which in (0, 1)]
    assert total[0] == pytest.approx(total[1], rel=0.2)


def test_a_still_frame_costs_next_to_nothing() -> None:
    """Unchanged content is not sent again to use up the rate."""
    stream = encoder()
    sizes = [len(stream.encode(drive()[0], 80, False)[0]) for _ in range(45)]
    assert sum(sizes[30:]) / 15 < 2000


@pytest.mark.parametrize(("width", "height"), [(320, 240), (322, 242), (2, 2), (18, 500), (1280, 720)])
def test_any_even_size_is_encoded(width: int, height: int) -> None:
    """Also sizes that do not fill its blocks."""
    picture = cv2.resize(drive()[0], (width, height), interpolation=cv2.INTER_AREA)
    body, _ = encoder(width, height).encode(picture, 80, True)
    assert h264_decoded([body])[0].shape == (height, width, 3)


def test_colours_are_those_of_the_card() -> None:
    """Within rounding and quantisation; the stream names its colour matrix."""
    body, _ = encoder(320, 240).encode(np.ascontiguousarray(card()[:, :, ::-1]), 100, True)
    context = av.VideoCodecContext.create("h264", "r")
    (frame,) = [*context.decode(av.Packet(body)), *context.decode(None)]
    assert (frame.colorspace, frame.color_range) == (6, 1)
    shown = frame.to_ndarray(format="bgr24")
    for name, (red, green, blue) in PATCHES.items():
        assert shown[middle_of(name)].tolist() == pytest.approx([blue, green, red], abs=12), name


def test_grey_is_encoded_too() -> None:
    """It has no colour afterwards either."""
    body, _ = encoder(320, 240).encode(grey_of(card()), 80, True)
    shown = h264_decoded([body])[0].astype(int)
    assert np.ptp(shown, axis=2).max() <= 3
    assert psnr(shown[:, :, 0], grey_of(card())) > 30


@pytest.mark.parametrize("size", [(63, 48), (64, 47)])
def test_odd_sizes_are_refused_with_the_reason(size: tuple[int, int]) -> None:
    """Plans make them even."""
    with pytest.raises(Unavailable, match="each side must be even"):
        encoder(*size)


def test_frames_of_another_size_are_refused() -> None:
    """A camera that changes its size needs another encoder."""
    with pytest.raises(Unavailable, match="does not have the encoder's size"):
        encoder(64, 48).encode(np.zeros((48, 62, 3), np.uint8), 80, True)


@pytest.mark.parametrize("fps", [0, 0.01, 7.5, 29.97, 1000])
def test_any_rate_is_planned_with(fps: float) -> None:
    """Bits are counted per frame, so a wrong guess has no effect."""
    stream = build_encoder("h264", 640, 480, fps)
    sizes = [len(stream.encode(each, 80, False)[0]) for each in drive()]
    assert 4000 < sum(sizes[15:]) / 30 < 9000
