"""H.264, decoded again by another program's decoder and compared."""

from __future__ import annotations

import math
import re
from functools import cache

import av
import cv2
import numpy as np
import pytest

from relay_protocol.errors import Unavailable
from robot_client.camera.encoding import Encoder, Jpeg, make_encoder
from robot_client.camera.formats import Pixels
from robot_client.sim.camera import SimCamera
from robot_client.sim.world import Pose
from robot_client.sim.worlds import WORLDS
from tests.robot_client.camera.cards import PATCHES, card, grey_of, middle_of
from tests.robot_client.camera.contact_sheet import h264_decoded

SLICE, IDR, SEI, SPS, PPS = 1, 5, 6, 7, 8


@cache
def drive() -> tuple[Pixels, ...]:
    """Three seconds of a robot that drives a curve, as a camera with a little noise sees them."""
    world = WORLDS["default"]()
    camera, random, start = SimCamera(world), np.random.default_rng(4), world.start
    poses = [Pose(start.x + 0.01 * i, start.y, start.heading + 0.01 * i) for i in range(45)]
    frames = [camera.render(pose, 0.2, 1_700_000_000 + i / 15) for i, pose in enumerate(poses)]
    return tuple(np.clip(each + random.normal(0, 2, each.shape), 0, 255).astype(np.uint8) for each in frames)


def encoder(width: int = 640, height: int = 480) -> Encoder:
    return make_encoder("h264", width, height, 15)


def units(picture: bytes) -> list[int]:
    """Types of the NAL units of one picture."""
    return [int(found[1][0]) & 31 for found in re.finditer(rb"\x00\x00\x01(.)", picture, re.DOTALL)]


def psnr(one: Pixels, other: Pixels) -> float:
    error = np.square(one.astype(float) - other).mean()
    return 10 * math.log10(255**2 / error) if error else math.inf


def test_a_stream_is_decoded_to_what_went_in() -> None:
    """Every picture, in order, within what JPEG of the same quality loses; the first is a key frame, no other."""
    stream = encoder()
    made = [stream.encode(each, 80, False) for each in drive()]
    assert [key for _, key in made] == [True] + [False] * 44
    shown = h264_decoded([body for body, _ in made])
    assert len(shown) == 45
    assert min(psnr(one, other) for one, other in zip(drive(), shown, strict=True)) > 30


def test_it_takes_a_third_of_the_bytes_of_jpeg_or_less() -> None:
    """At the same size and quality, for a picture that moves."""
    stream = encoder()
    h264 = sum(len(stream.encode(each, 80, False)[0]) for each in drive())
    jpeg = sum(len(Jpeg().encode(each, 80, False)[0]) for each in drive())
    assert 3 < jpeg / h264 < 7


def test_each_picture_comes_out_at_once_as_annex_b() -> None:
    """Start code first; a key frame with its parameter sets, any other one slice that looks back only."""
    stream = encoder()
    for number, each in enumerate(drive()[:8]):
        body, key = stream.encode(each, 80, number == 5)
        assert body.startswith((b"\0\0\0\1", b"\0\0\1"))
        assert key == (number in (0, 5))
        assert [kind for kind in units(body) if kind != SEI] == ([SPS, PPS, IDR] if key else [SLICE])


def test_a_decoder_that_joins_at_a_key_frame_sees_all_from_there() -> None:
    """Nothing after it looks back behind it."""
    stream = encoder()
    made = [stream.encode(each, 80, number == 20)[0] for number, each in enumerate(drive()[:30])]
    shown = h264_decoded(made[20:])
    assert len(shown) == 10
    assert psnr(shown[-1], drive()[29]) > 30


def test_no_picture_refers_to_a_later_one() -> None:
    """A decoder gives each picture as it gets it: no delay is built in."""
    stream, context = encoder(), av.VideoCodecContext.create("h264", "r")
    context.flags |= 1 << 19  # AV_CODEC_FLAG_LOW_DELAY: libavcodec else waits for one more picture
    context.thread_count = 1
    shown = [len(context.decode(av.Packet(stream.encode(each, 80, False)[0]))) for each in drive()[:6]]
    assert shown == [1] * 6


def test_less_quality_is_fewer_bytes_at_once_and_without_a_key_frame() -> None:
    """The pace lowers it when the link is full, which a key frame would make fuller."""
    stream = encoder()
    fine = [stream.encode(each, 80, False) for each in drive()[:15]]
    coarse = [stream.encode(each, 40, False) for each in drive()[15:30]]
    back = [stream.encode(each, 80, False) for each in drive()[30:]]
    assert not any(key for _, key in [*fine[1:], *coarse, *back])
    sizes = [sum(len(body) for body, _ in part[5:]) for part in (fine, coarse, back)]
    assert sizes[1] < sizes[0] / 2
    assert sizes[2] > 1.5 * sizes[1]


def test_a_stream_that_began_thin_gets_as_fine_as_one_that_did_not() -> None:
    """More than it began with begins anew, with a key frame."""
    stream, fine = encoder(), encoder()
    for each in drive()[:10]:
        stream.encode(each, 20, False)
    made = [(stream.encode(each, 80, False), fine.encode(each, 80, False)) for each in drive()[10:]]
    assert [risen[1] for risen, _ in made] == [True] + [False] * 34
    total = [sum(len(each[which][0]) for each in made) for which in (0, 1)]
    assert total[0] == pytest.approx(total[1], rel=0.2)


def test_a_still_picture_costs_next_to_nothing() -> None:
    """What doesn't change is not sent again to use the rate up."""
    stream = encoder()
    sizes = [len(stream.encode(drive()[0], 80, False)[0]) for _ in range(45)]
    assert sum(sizes[30:]) / 15 < 2000


@pytest.mark.parametrize(("width", "height"), [(320, 240), (322, 242), (2, 2), (18, 500), (1280, 720)])
def test_any_even_size_is_encoded(width: int, height: int) -> None:
    """Also such as don't fill its blocks."""
    picture = cv2.resize(drive()[0], (width, height), interpolation=cv2.INTER_AREA)
    body, _ = encoder(width, height).encode(picture, 80, True)
    assert h264_decoded([body])[0].shape == (height, width, 3)


def test_colours_are_those_of_the_card() -> None:
    """Within what rounding and quantising change; the stream says by which matrix they were made."""
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
def test_odd_sizes_are_refused_in_words(size: tuple[int, int]) -> None:
    """Plans make them even."""
    with pytest.raises(Unavailable, match="each side must be even"):
        encoder(*size)


def test_pictures_of_another_size_are_refused() -> None:
    """A camera that changes its size needs another encoder."""
    with pytest.raises(Unavailable, match="changed their size"):
        encoder(64, 48).encode(np.zeros((48, 62, 3), np.uint8), 80, True)


@pytest.mark.parametrize("fps", [0, 0.01, 7.5, 29.97, 1000])
def test_any_rate_is_planned_with(fps: float) -> None:
    """The bits are counted by the picture, so a wrong guess is harmless."""
    stream = make_encoder("h264", 640, 480, fps)
    sizes = [len(stream.encode(each, 80, False)[0]) for each in drive()]
    assert 4000 < sum(sizes[15:]) / 30 < 9000
