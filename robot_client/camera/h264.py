"""H.264 for thin links, by x264 in PyAV: no picture waits for a later one, and each leaves as it is made.

Imported when it is asked for: a robot may be without PyAV.
"""

from __future__ import annotations

from fractions import Fraction

import av
import cv2
from av.video.frame import PictureType

from relay_protocol.errors import Unavailable
from robot_client.camera import INSTALL
from robot_client.camera.formats import Pixels

_USUAL = 80
_BITS = 0.2
"""Bits for each pixel at that quality: a fifth or so of the JPEG's."""
_HALVED = 20
"""Steps of quality that halve or double the bits."""
_LEAST = 16_000
"""Bits per second for the smallest pictures; x264 counts in thousands."""
_RATES = (5.0, 60.0)
"""Least and most pictures per second that are planned with."""
_GUESS = 15.0
"""Pictures per second, where nobody knows."""
_KEY_SECONDS = 10
"""Between two key frames nobody asked for, when they come at the rate that was planned with."""
_BUFFER_SECONDS = 0.5
"""How much of the rate one picture may use up: what a key frame holds the link."""
_FINEST = 18
"""Quantiser under which nobody sees a difference; a camera that shows nothing new needs less than its rate."""
_BT601 = 6
"""SMPTE 170M in T-REC-H.273: what OpenCV turns colours into, and what viewers would else guess from the size."""
_LIMITED = 1
"""Y from 16 to 235."""


class H264:
    """One stream of H.264 (Annex B), its parameter sets before every key frame. See :class:`~.encoding.Encoder`.

    :param width: pixels, even
    :param height: pixels, even
    :param fps: pictures per second that may be expected; 0 if nobody knows
    :raises Unavailable: PyAV or its x264 is not there, or the size is odd
    """

    def __init__(self, width: int, height: int, fps: float) -> None:
        if width % 2 or height % 2:
            raise Unavailable(f"H.264 has no pictures of {width}×{height} pixels; each side must be even")
        self._size = (height, width)
        self._fps = min(max(fps or _GUESS, _RATES[0]), _RATES[1])
        self._count = 0
        self._most = 0
        self._context: av.VideoCodecContext | None = None
        try:
            av.Codec("libx264", "w")
        except av.codec.codec.UnknownCodecError:
            raise Unavailable(f"this robot's PyAV has no x264; another one has ({INSTALL})") from None

    def encode(self, pixels: Pixels, quality: int, key: bool) -> tuple[bytes, bool]:
        """See :class:`~.encoding.Encoder`. Less quality needs no key frame, the most so far does."""
        if pixels.shape[:2] != self._size:
            raise Unavailable("the camera's pictures changed their size")
        if pixels.ndim == 2:
            pixels = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR).astype(pixels.dtype, copy=False)
        planes = cv2.cvtColor(pixels, cv2.COLOR_BGR2YUV_I420).astype(pixels.dtype, copy=False)
        frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
        frame.pts = self._count
        frame.pict_type = PictureType.I if key else PictureType.NONE
        self._count += 1
        if self._context is None or quality > self._most:
            self._context, self._most = self._opened(quality), quality
        self._context.bit_rate = self._rate(quality)
        try:
            packets = self._context.encode(frame)
        except av.FFmpegError as error:
            raise Unavailable(f"x264 can't encode the picture: {error.strerror}") from None
        return b"".join(bytes(packet) for packet in packets), any(packet.is_keyframe for packet in packets)

    def _rate(self, quality: int) -> int:
        """Bits per second."""
        height, width = self._size
        return max(_LEAST, int(width * height * self._fps * _BITS * 2 ** ((quality - _USUAL) / _HALVED)))

    def _opened(self, quality: int) -> av.VideoCodecContext:
        """A new beginning: x264 follows a rate that changes, but to none above the one it was opened with."""
        context = av.VideoCodecContext.create("libx264", "w")
        context.height, context.width = self._size
        context.pix_fmt = "yuv420p"
        context.colorspace, context.color_range = _BT601, _LIMITED
        context.framerate = Fraction(self._fps).limit_denominator(1000)
        context.time_base = 1 / context.framerate
        context.gop_size = round(self._fps * _KEY_SECONDS)
        context.max_b_frames = 0
        context.qmin = _FINEST
        # One thread: a picture in slices is larger, and other streams want the cores too.
        context.thread_count = 1
        # A rate that is the most at once: only then x264 follows when it changes.
        context.bit_rate = rate = self._rate(quality)
        context.options = {
            "preset": "ultrafast",
            "tune": "zerolatency",
            "forced-idr": "1",
            "maxrate": str(rate),
            "bufsize": str(int(self._rate(_USUAL) * _BUFFER_SECONDS)),
            "x264-params": "annexb=1:repeat-headers=1",
        }
        try:
            context.open()
        except av.FFmpegError as error:
            raise Unavailable(f"x264 makes no pictures of this size: {error.strerror}") from None
        return context
