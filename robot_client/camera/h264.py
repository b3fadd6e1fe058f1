"""H.264 for slow links, by x264 in PyAV, without B-frames and without delay.

Imported only when requested, since PyAV may be missing.
"""

from __future__ import annotations

from fractions import Fraction

import av
import cv2
from av.video.frame import PictureType

from relay_protocol.errors import Unavailable
from robot_client.camera import INSTALL
from robot_client.camera.formats import Pixels

_BASE_QUALITY = 80
_BITS_PER_PIXEL = 0.2
"""At the base quality: about a fifth of JPEG's."""
_QUALITY_OCTAVE = 20
"""Steps of quality that double the bits."""
_MIN_BIT_RATE = 16_000
"""Bits per second; x264 counts in thousands."""
_FPS_RANGE = (5.0, 60.0)
"""Least and most frames per second that are assumed."""
_DEFAULT_FPS = 15.0
_KEY_SECONDS = 10
"""Seconds between unrequested key frames at the assumed rate."""
_BUFFER_SECONDS = 0.5
"""Seconds of the bit rate that one frame may use: so long a key frame occupies the link."""
_MIN_QUANTISER = 18
"""Quantiser below which no difference is visible; a static scene needs less than its bit rate."""
_BT601 = 6
"""SMPTE 170M in ITU-T H.273: OpenCV's conversion. Without it, players guess from the size."""
_LIMITED = 1
"""Y from 16 to 235."""


class H264Encoder:
    """One stream of H.264 (Annex B), with parameter sets before every key frame. See
    :class:`~.encoder.Encoder`.

    :param width: pixels, even
    :param height: pixels, even
    :param fps: expected frames per second; 0 if unknown
    :raises Unavailable: PyAV has no x264, or the size is odd
    """

    def __init__(self, width: int, height: int, fps: float) -> None:
        if width % 2 or height % 2:
            raise Unavailable(f"H.264 can't encode {width}×{height} pixels; each side must be even")
        self._size = (height, width)
        self._fps = min(max(fps or _DEFAULT_FPS, _FPS_RANGE[0]), _FPS_RANGE[1])
        self._count = 0
        self._max_quality = 0
        self._context: av.VideoCodecContext | None = None
        try:
            av.Codec("libx264", "w")
        except av.codec.codec.UnknownCodecError:
            raise Unavailable(f"this robot's PyAV has no x264; install one that has it ({INSTALL})") from None

    def encode(self, pixels: Pixels, quality: int, key: bool) -> tuple[bytes, bool]:
        """See :class:`~.encoder.Encoder`. A quality above all earlier ones starts with a key frame."""
        if pixels.shape[:2] != self._size:
            raise Unavailable(
                f"the frame does not have the encoder's size of {self._size[1]}×{self._size[0]} pixels"
            )
        if pixels.ndim == 2:
            pixels = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR).astype(pixels.dtype, copy=False)
        planes = cv2.cvtColor(pixels, cv2.COLOR_BGR2YUV_I420).astype(pixels.dtype, copy=False)
        frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
        frame.pts = self._count
        frame.pict_type = PictureType.I if key else PictureType.NONE
        self._count += 1
        if self._context is None or quality > self._max_quality:
            self._context, self._max_quality = self._open(quality), quality
        self._context.bit_rate = self._rate(quality)
        try:
            packets = self._context.encode(frame)
        except av.FFmpegError as error:
            raise Unavailable(f"x264 can't encode the frame: {error.strerror}") from None
        return b"".join(bytes(packet) for packet in packets), any(packet.is_keyframe for packet in packets)

    def _rate(self, quality: int) -> int:
        """Bits per second."""
        height, width = self._size
        bits = _BITS_PER_PIXEL * 2 ** ((quality - _BASE_QUALITY) / _QUALITY_OCTAVE)
        return max(_MIN_BIT_RATE, int(width * height * self._fps * bits))

    def _open(self, quality: int) -> av.VideoCodecContext:
        """Open a codec context. x264 follows a changed bit rate, but not above the one it was opened with."""
        context = av.VideoCodecContext.create("libx264", "w")
        context.height, context.width = self._size
        context.pix_fmt = "yuv420p"
        context.colorspace, context.color_range = _BT601, _LIMITED
        context.framerate = Fraction(self._fps).limit_denominator(1000)
        context.time_base = 1 / context.framerate
        context.gop_size = round(self._fps * _KEY_SECONDS)
        context.max_b_frames = 0
        context.qmin = _MIN_QUANTISER
        # One thread: slices make frames larger, and other streams need the cores too.
        context.thread_count = 1
        # The bit rate is also the maximum: only then x264 follows when it changes.
        context.bit_rate = rate = self._rate(quality)
        context.options = {
            "preset": "ultrafast",
            "tune": "zerolatency",
            "forced-idr": "1",
            "maxrate": str(rate),
            "bufsize": str(int(self._rate(_BASE_QUALITY) * _BUFFER_SECONDS)),
            "x264-params": "annexb=1:repeat-headers=1",
        }
        try:
            context.open()
        except av.FFmpegError as error:
            raise Unavailable(f"x264 can't encode this size: {error.strerror}") from None
        return context
