"""JPEG and PNG, and images that cannot be encoded."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from relay_protocol.errors import Unavailable
from robot_client.camera.encoder import JpegEncoder, PngEncoder, build_encoder
from robot_client.camera.formats import Pixels, decode_file
from tests.worlds.image_cards import card, grey_of


def bgr() -> Pixels:
    return np.ascontiguousarray(card()[:, :, ::-1])


@pytest.mark.parametrize("codec", ["jpeg", "png"])
@pytest.mark.parametrize("picture", [bgr(), grey_of(card())], ids=["colour", "grey"])
def test_files_are_read_again(codec: str, picture: Pixels) -> None:
    """Each is independent; PNG is lossless, JPEG nearly so."""
    body, key = build_encoder(codec, 320, 240, 0).encode(picture, 90, False)
    raw = decode_file(body)
    assert key
    assert raw.encoding == codec
    assert raw.pixels.shape == picture.shape
    assert np.abs(raw.pixels.astype(int) - picture).mean() < (3 if codec == "jpeg" else 1e-9)


def test_quality_costs_bytes() -> None:
    """The rate control relies on it."""
    sizes = [len(JpegEncoder().encode(bgr(), quality, True)[0]) for quality in (1, 30, 60, 90, 100)]
    assert sizes == sorted(sizes)
    assert sizes[-1] > 2 * sizes[0]


def test_a_part_of_an_image_is_encoded() -> None:
    """Rows of a crop are parts of longer rows."""
    part = bgr()[10:60, 20:100]
    assert np.array_equal(decode_file(PngEncoder().encode(part, 80, True)[0]).pixels, part)


def test_an_image_too_wide_for_jpeg_is_refused_with_the_reason() -> None:
    """JPEG's limit is 65535."""
    with pytest.raises(Unavailable, match="can't encode an image of 70000×1 pixels"):
        JpegEncoder().encode(np.zeros((1, 70_000), np.uint8), 80, True)


def test_an_unknown_codec_is_refused_with_those_there_are() -> None:
    """A newer relay may request others."""
    with pytest.raises(Unavailable, match="no encoder for 'av1'; it has jpeg, png, h264"):
        build_encoder("av1", 64, 48, 15)


def test_without_pyav_the_rest_works(monkeypatch: pytest.MonkeyPatch) -> None:
    """For H.264 the error says what is missing and how to install it."""
    monkeypatch.setitem(sys.modules, "av", None)
    monkeypatch.delitem(sys.modules, "robot_client.camera.h264", raising=False)
    with pytest.raises(Unavailable, match=r"H\.264 needs PyAV.*robot-switchboard\[video\]"):
        build_encoder("h264", 64, 48, 15)
    assert build_encoder("jpeg", 320, 240, 15).encode(bgr(), 80, True)
