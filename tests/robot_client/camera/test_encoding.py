"""JPEG and PNG, and what can't be encoded."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from relay_protocol.errors import Unavailable
from robot_client.camera.encoding import Jpeg, Png, make_encoder
from robot_client.camera.formats import Pixels, decoded
from tests.robot_client.camera.cards import card, grey_of


def bgr() -> Pixels:
    return np.ascontiguousarray(card()[:, :, ::-1])


@pytest.mark.parametrize("codec", ["jpeg", "png"])
@pytest.mark.parametrize("picture", [bgr(), grey_of(card())], ids=["colour", "grey"])
def test_files_are_read_again(codec: str, picture: Pixels) -> None:
    """Each picture stands alone; PNG loses nothing, JPEG little."""
    body, key = make_encoder(codec, 320, 240, 0).encode(picture, 90, False)
    raw = decoded(body)
    assert key
    assert raw.encoding == codec
    assert raw.pixels.shape == picture.shape
    assert np.abs(raw.pixels.astype(int) - picture).mean() < (3 if codec == "jpeg" else 1e-9)


def test_quality_costs_bytes() -> None:
    """The pace counts on it."""
    sizes = [len(Jpeg().encode(bgr(), quality, True)[0]) for quality in (1, 30, 60, 90, 100)]
    assert sizes == sorted(sizes)
    assert sizes[-1] > 2 * sizes[0]


def test_a_part_of_a_picture_is_encoded() -> None:
    """What a crop leaves lies in rows that are longer than it."""
    part = bgr()[10:60, 20:100]
    assert np.array_equal(decoded(Png().encode(part, 80, True)[0]).pixels, part)


def test_a_picture_too_wide_for_jpeg_is_refused_in_words() -> None:
    """JPEG counts to 65535."""
    with pytest.raises(Unavailable, match="can't encode a picture of 70000×1 pixels"):
        Jpeg().encode(np.zeros((1, 70_000), np.uint8), 80, True)


def test_an_unknown_codec_is_refused_with_those_there_are() -> None:
    """A newer relay may ask for more."""
    with pytest.raises(Unavailable, match="no encoder for 'av1'; it has jpeg, png, h264"):
        make_encoder("av1", 64, 48, 15)


def test_without_pyav_the_rest_works(monkeypatch: pytest.MonkeyPatch) -> None:
    """H.264 says what is missing and how to get it."""
    monkeypatch.setitem(sys.modules, "av", None)
    monkeypatch.delitem(sys.modules, "robot_client.camera.h264", raising=False)
    with pytest.raises(Unavailable, match=r"H\.264 needs PyAV.*robot-switchboard\[video\]"):
        make_encoder("h264", 64, 48, 15)
    assert make_encoder("jpeg", 320, 240, 15).encode(bgr(), 80, True)
