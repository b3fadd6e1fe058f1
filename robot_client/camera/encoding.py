"""Pixels to the bytes that travel: JPEG, PNG, H.264."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import cv2

from relay_protocol.errors import Unavailable
from robot_client.camera import INSTALL
from robot_client.camera.formats import Pixels


class Encoder(Protocol):
    """Makes one stream's pictures, one after the other; serves one thread at a time."""

    def encode(self, pixels: Pixels, quality: int, key: bool) -> tuple[bytes, bool]:
        """Encode the next picture.

        :param pixels: colour (B, G, R) or grey, of the size the encoder was made for
        :param quality: 1 to 100
        :param key: whether it must stand alone
        :returns: the picture, and whether it does stand alone
        :raises Unavailable: it can't be encoded; says why
        """


class Jpeg:
    """Baseline JPEG with a quarter of the colour's pixels, as OpenCV does it."""

    def encode(self, pixels: Pixels, quality: int, key: bool) -> tuple[bytes, bool]:
        """See :class:`Encoder`; every picture stands alone."""
        return _file(".jpg", pixels, (cv2.IMWRITE_JPEG_QUALITY, quality)), True


class Png:
    """PNG, which loses nothing: ``quality`` changes nothing."""

    def encode(self, pixels: Pixels, quality: int, key: bool) -> tuple[bytes, bool]:
        """See :class:`Encoder`; every picture stands alone."""
        return _file(".png", pixels, ()), True


def make_encoder(codec: str, width: int, height: int, fps: float) -> Encoder:
    """The encoder of one stream.

    :param codec: ``jpeg``, ``png`` or ``h264``
    :param width: pixels; even for H.264
    :param height: pixels; even for H.264
    :param fps: pictures per second that may be expected; 0 if nobody knows
    :raises Unavailable: this robot has no such encoder; says what to install
    """
    if codec == "jpeg":
        return Jpeg()
    if codec == "png":
        return Png()
    if codec == "h264":
        return _h264(width, height, fps)
    raise Unavailable(f"this robot has no encoder for '{codec}'; it has jpeg, png, h264")


def _h264(width: int, height: int, fps: float) -> Encoder:
    try:
        from robot_client.camera.h264 import H264
    except ImportError as error:
        raise Unavailable(f"H.264 needs PyAV, which this robot can't use: {error} ({INSTALL})") from None
    return H264(width, height, fps)


def _file(ending: str, pixels: Pixels, parameters: Sequence[int]) -> bytes:
    high, wide = pixels.shape[:2]
    try:
        done, encoded = cv2.imencode(ending, pixels, parameters)
    except cv2.error as error:
        raise Unavailable(f"OpenCV can't encode a picture of {wide}×{high} pixels: {error.err}") from None
    if not done:
        raise Unavailable(f"OpenCV can't encode a picture of {wide}×{high} pixels")
    return encoded.tobytes()
