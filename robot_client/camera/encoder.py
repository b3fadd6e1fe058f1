"""From a camera's frame to the bytes that are sent: transformed and encoded as JPEG, PNG or H.264."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import cv2

from relay_protocol.errors import Invalid, MalformedMessage, Unavailable
from relay_protocol.image_check import validate
from relay_protocol.limits import VIDEO_FRAME
from relay_protocol.link import VideoSettings
from robot_client.camera import INSTALL, formats
from robot_client.camera.formats import Pixels, RawImage
from robot_client.camera.frame import Encoded, EncodeRequest, Frame, FrameFormat
from robot_client.camera.images import without_orientation
from robot_client.camera.transforms import plan_transforms

_FRAME_HEAD = 13
"""Bytes of a frame before the image: kind, number, stamp (SPEC 2.1)."""

_PASS_ON_QUALITY = VideoSettings().quality
"""From this requested quality on the camera's own JPEG is passed on."""


class Encoder(Protocol):
    """Encodes the frames of one stream in order; not thread-safe."""

    def encode(self, pixels: Pixels, quality: int, key: bool) -> tuple[bytes, bool]:
        """Encode the next frame.

        :param pixels: colour (B, G, R) or grey, of the size the encoder was built for
        :param quality: 1 to 100
        :param key: whether the result must be decodable without earlier frames
        :returns: the bytes, and whether they are decodable without earlier frames
        :raises Unavailable: it can't be encoded
        """


class JpegEncoder:
    """Baseline JPEG with 4:2:0 chroma, by OpenCV. Every frame is a key frame."""

    def encode(self, pixels: Pixels, quality: int, key: bool) -> tuple[bytes, bool]:
        """See :class:`Encoder`."""
        return _encode_file(".jpg", pixels, (cv2.IMWRITE_JPEG_QUALITY, quality)), True


class PngEncoder:
    """Lossless PNG; ``quality`` has no effect. Every frame is a key frame."""

    def encode(self, pixels: Pixels, quality: int, key: bool) -> tuple[bytes, bool]:
        """See :class:`Encoder`."""
        return _encode_file(".png", pixels, ()), True


def build_encoder(codec: str, width: int, height: int, fps: float) -> Encoder:
    """The encoder of one stream.

    :param codec: ``jpeg``, ``png`` or ``h264``
    :param width: pixels; even for H.264
    :param height: pixels; even for H.264
    :param fps: expected frames per second; 0 if unknown
    :raises Unavailable: this robot has no such encoder; names what to install
    """
    if codec == "jpeg":
        return JpegEncoder()
    if codec == "png":
        return PngEncoder()
    if codec != "h264":
        raise Unavailable(f"this robot has no encoder for '{codec}'; it has jpeg, png, h264")
    try:
        from robot_client.camera.h264 import H264Encoder
    except ImportError as error:
        raise Unavailable(f"H.264 needs PyAV, which this robot can't use: {error} ({INSTALL})") from None
    return H264Encoder(width, height, fps)


def _encode_file(extension: str, pixels: Pixels, parameters: Sequence[int]) -> bytes:
    height, width = pixels.shape[:2]
    try:
        done, encoded = cv2.imencode(extension, pixels, parameters)
    except cv2.error as error:
        raise Unavailable(f"OpenCV can't encode an image of {width}×{height} pixels: {error.err}") from None
    if not done:
        raise Unavailable(f"OpenCV can't encode an image of {width}×{height} pixels")
    return encoded.tobytes()


def frame_from_message(stamp: int, arrived: float, cdr: bytes, compressed: bool) -> Frame:
    """A frame that arrived as a ROS message; see :class:`Frame` for the times.

    :param compressed: whether it is a CompressedImage
    """

    def read_format() -> FrameFormat:
        encoding, width, height = formats.message_format(cdr, compressed)
        return FrameFormat(encoding, width, height)

    def jpeg() -> bytes | None:
        found = formats.compressed_file(cdr)
        return found.file if found.kind == "jpeg" else None

    if compressed:
        return Frame(
            stamp, arrived, read_format, lambda: formats.decode_compressed(formats.compressed_file(cdr)), jpeg
        )
    return Frame(stamp, arrived, read_format, lambda: formats.decode_image(cdr))


def frame_from_pixels(stamp: int, arrived: float, pixels: Pixels) -> Frame:
    """A frame of a camera without ROS; see :class:`Frame` for the times.

    :param pixels: as in :class:`~robot_client.camera.formats.RawImage`
    """
    height, width = pixels.shape[:2]
    encoding = "bgr8" if pixels.ndim == 3 else "mono8"
    format = FrameFormat(encoding, width, height)
    return Frame(stamp, arrived, lambda: format, lambda: RawImage(encoding, width, height, pixels))


class FrameEncoder:
    """Encodes the frames of one stream in order; not thread-safe.

    :param settings: as the client requested
    """

    def __init__(self, settings: VideoSettings) -> None:
        self._settings = settings
        self._encoder: Encoder | None = None
        self._size = (0, 0)

    def encode(self, frame: Frame, request: EncodeRequest) -> Encoded:
        """Transform and encode a frame, or pass the camera's own JPEG on.

        :raises Invalid: it can't be shown like that
        :raises Unavailable: this robot can't encode it
        """
        encoded = self._passed_on(frame, request) or self._encode(frame, request)
        if len(encoded.body) + _FRAME_HEAD > VIDEO_FRAME:
            other = "of less quality" if self._settings.codec == "jpeg" else "as JPEG"
            raise Invalid(
                f"the image has {len(encoded.body)} bytes; at most {VIDEO_FRAME - _FRAME_HEAD} can be sent. "
                f"Request a smaller one, or {other}"
            )
        return encoded

    def _passed_on(self, frame: Frame, request: EncodeRequest) -> Encoded | None:
        settings = self._settings
        if request.reduced or settings.codec != "jpeg" or settings.quality < _PASS_ON_QUALITY:
            return None
        file = frame.jpeg()
        if file is None or len(file) + _FRAME_HEAD > VIDEO_FRAME:
            return None
        encoding, width, height = frame.read_format()
        if plan_transforms(settings, width, height).changes or not _is_accepted_jpeg(file):
            return None
        return Encoded(without_orientation(file), width, height, encoding)

    def _encode(self, frame: Frame, request: EncodeRequest) -> Encoded:
        raw = frame.raw()
        plan = plan_transforms(self._settings, raw.width, raw.height, request.scale)
        if self._encoder is None or (plan.width, plan.height) != self._size:
            self._encoder = build_encoder(self._settings.codec, plan.width, plan.height, request.fps)
            self._size = (plan.width, plan.height)
        pixels = plan.apply(raw.pixels, frame.stamp / 1e9) if plan.changes else raw.pixels
        body, _ = self._encoder.encode(pixels, request.quality, request.key)
        return Encoded(body, plan.width, plan.height, raw.encoding)


def _is_accepted_jpeg(file: bytes) -> bool:
    """Whether the relay accepts this JPEG. Some cameras put two files into a message, or bytes after the
    end; decoders ignore those, but browsers should not get them.
    """
    try:
        validate("jpeg", file)
    except MalformedMessage:
        return False
    return True
