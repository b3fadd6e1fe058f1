"""One frame of a stream, and how late frames come.

Frames that wait for one viewer, and how much of them the kernel may hold.

The newest frame counts. Each viewer has one in flight. Later ones wait here, where they can still be
replaced, and not in the kernel, where they would only grow old.
"""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Callable
from typing import Any
from urllib.parse import urlencode

import msgspec
from twisted.web.server import Request

from relay_protocol.limits import KIB, MIB
from relay_server.common.tcp import keep_little, tcp_of, unacknowledged

STALE_SECONDS = 0.5
"""Age from which a frame is not shown any more. The least delay of the network is not counted."""

FREQUENT_FPS = 0.5
"""Frames per second of a camera whose next frame comes so soon that a late one is not missed."""

SPAN_SECONDS = 10.0
"""The least delay is the least of the last one or two spans of this length."""

STEADY_DELAY_SECONDS = 2.0
STEADY_RANGE_SECONDS = 0.2
STEADY_FRAMES = 3
"""Late frames that come for STEADY_DELAY_SECONDS, at least STEADY_FRAMES of them, with delays that differ by
at most STEADY_RANGE_SECONDS, are not held up: the robot's clock was set, or the network path changed."""


class VideoFrameInfo(msgspec.Struct, frozen=True, gc=False):
    """One frame of a stream.

    :param number: counted by the robot; starts again when a stream is opened again
    :param stamp: Unix seconds at the robot, when the camera's image reached it
    :param good_until: monotonic clock of the relay, seconds; later the frame is not shown
    :param codec: ``jpeg``, ``png`` or ``h264``
    :param width: pixels
    :param height: pixels
    :param key: whether it can be decoded alone; always true for JPEG and PNG
    :param reduced: how far it is below what was requested, 0 to 1
    """

    number: int
    stamp: float
    good_until: float
    codec: str
    width: int
    height: int
    key: bool
    body: bytes
    reduced: float = 0.0


class DelayEstimator:
    """Estimates how much later than necessary a frame comes: after a stall of the network, old frames arrive
    in a burst.

    The clocks of robot and relay differ, but a frame with the least recent delay was hardly late. Frames that
    all come late by the same delay set a new measure; otherwise nothing would be shown after a clock was set.
    """

    __slots__ = ("_before", "_count", "_even_since", "_high", "_least", "_low", "_since")

    def __init__(self) -> None:
        self._since = float("-inf")
        self._least = self._before = float("inf")
        self._even_since = 0.0
        self._low = self._high = 0.0
        self._count = 0

    def delay_of(self, stamp: float, now: float) -> float:
        """Seconds by which a frame is late.

        :param stamp: the robot's clock when the camera's image reached it
        :param now: a monotonic clock
        """
        delay = now - stamp
        if now - self._since >= SPAN_SECONDS:
            self._since, self._before, self._least = now, self._least, delay
        self._least = min(self._least, delay)
        late = delay - min(self._least, self._before)
        if late <= STALE_SECONDS:
            self._count = 0
        elif self._come_evenly(delay, now):
            self._since, self._before, self._least = now, float("inf"), self._low
            self._count = 0
            return delay - self._low
        return late

    def _come_evenly(self, delay: float, now: float) -> bool:
        """Whether the last frames, all of them late, had nearly the same delay."""
        low, high = min(self._low, delay), max(self._high, delay)
        if self._count == 0 or high - low > STEADY_RANGE_SECONDS:
            self._even_since, self._count, low, high = now, 0, delay, delay
        self._low, self._high = low, high
        self._count += 1
        return self._count >= STEADY_FRAMES and now - self._even_since >= STEADY_DELAY_SECONDS


CONTENT_TYPES = {"jpeg": b"image/jpeg", "png": b"image/png"}
"""Of single images, by codec."""

STALL_SECONDS = 5.0
"""Seconds without any byte accepted after which a viewer is cut."""

FORWARDED_STALL_SECONDS = 20.0
"""The same of a viewer at another relay, which accepts more at a time, and that less often."""

CHECK_SECONDS = 1.0
"""How often stalled viewers are looked for."""

WAITING_BYTES = MIB
"""H.264 frames depend on earlier ones, so several wait. More than this, and the queue starts again at a key
frame."""

LAG_SECONDS = 0.5
"""H.264 frames that would take longer than this to reach a viewer are dropped, since later frames would grow
old behind them."""

RATE_FRAMES = 8
"""The send rate is estimated from this many sends."""

RATE_SIZE_RATIO = 1.5
"""The largest of these must be this many times the smallest, or jitter would look like a slow viewer."""

SOCKET_BYTES = 256 * KIB
"""Most bytes that the kernel holds unsent for one viewer."""

IN_FLIGHT_BYTES = 16 * KIB
"""With more than this not acknowledged, the last frame is still in flight."""

_PROBES = {"TCP_KEEPIDLE": 30, "TCP_KEEPINTVL": 10, "TCP_KEEPCNT": 3}
"""Seconds, seconds, times. While a robot is away nothing is written, and only these probes notice a viewer
that vanished (tcp(7); some systems know only some of them)."""


class FrameQueue:
    """The frames that wait for a viewer: the newest, or for H.264 all since the last key frame.

    :param seconds: the monotonic clock of ``good_until``
    :param request_keyframe: called when a frame of H.264 is dropped
    """

    __slots__ = ("_bytes", "_frames", "_rate", "_request_keyframe", "_seconds")

    def __init__(
        self, seconds: Callable[[], float], request_keyframe: Callable[[], None] = lambda: None
    ) -> None:
        self._seconds = seconds
        self._request_keyframe = request_keyframe
        self._frames: list[VideoFrameInfo] = []
        self._bytes = 0
        self._rate = SendRate()

    def __bool__(self) -> bool:
        return bool(self._frames)

    def put(self, frame: VideoFrameInfo) -> None:
        """Add a frame; it replaces all that it does not depend on."""
        if frame.key:
            self._frames.clear()
            self._bytes = 0
        self._frames.append(frame)
        self._bytes += len(frame.body)
        if self._bytes > WAITING_BYTES and len(self._frames) > 1:
            self._drop_all()

    def take(self) -> list[VideoFrameInfo]:
        """The frames to send next, once the viewer has accepted the last ones; none when they are too old.

        Several frames that would take too long are dropped, except for a key frame, so that a viewer with a
        very thin link still sees something.
        """
        now = self._seconds()
        self._rate.taken(now)
        frames = self._frames
        if frames and now > frames[0].good_until:
            frames = []
            self._drop_all()
        elif len(frames) > 1 and self._rate.seconds_for(self._bytes) > LAG_SECONDS:
            frames = [each for each in frames[:1] if each.key]
            self._drop_all()
        self._frames, self._bytes = [], 0
        if frames:
            self._rate.sent(sum(len(each.body) for each in frames), now)
        return frames

    def _drop_all(self) -> None:
        self._frames = []
        self._bytes = 0
        self._request_keyframe()


class SendRate:
    """Estimates how long the transfer of a number of bytes to a viewer takes.

    Latency is the same for few and many bytes, so only the difference between the smallest and the largest
    recent send counts. Without one the rate is not known, or stays as it was, or improves.
    """

    __slots__ = ("_bytes", "_last", "_per_byte", "_since")

    def __init__(self) -> None:
        self._last: deque[tuple[int, float]] = deque(maxlen=RATE_FRAMES)
        """Bytes, and seconds until they were accepted."""
        self._per_byte = 0.0
        self._bytes = 0
        self._since = 0.0

    def sent(self, size: int, now: float) -> None:
        self._bytes, self._since = size, now

    def taken(self, now: float) -> None:
        """The viewer has accepted all bytes that were sent."""
        if not self._bytes:
            return
        took = now - self._since
        self._last.append((self._bytes, took))
        (least, quick), (most, slow) = min(self._last), max(self._last)
        if most >= RATE_SIZE_RATIO * least:
            self._per_byte = max(slow - quick, 0.0) / (most - least)
        self._per_byte = min(self._per_byte, took / self._bytes)
        self._bytes = 0

    def seconds_for(self, size: int) -> float:
        """Seconds for so many bytes; 0 when it is not known."""
        return size * self._per_byte


class AckTracker:
    """Whether a viewer accepts the bytes that were sent, by the acknowledgements of its TCP.

    :param tcp: see :func:`limit_send_buffer`; with ``None`` everything counts as accepted at once
    :param seconds: a monotonic clock
    """

    __slots__ = ("_progress_at", "_seconds", "_tcp", "_unsent_before")

    def __init__(self, tcp: Any, seconds: Callable[[], float]) -> None:
        self._tcp = tcp
        self._seconds = seconds
        self._unsent_before = 0
        self._progress_at = seconds()

    @property
    def in_flight(self) -> bool:
        """Whether many bytes have not been acknowledged."""
        return self._tcp is not None and unacknowledged(self._tcp) > IN_FLIGHT_BYTES

    def sent(self) -> None:
        """A frame was sent just now."""
        self._unsent_before, self._progress_at = self._unsent(), self._seconds()

    def stalled_for(self) -> float:
        """Seconds since a frame was sent or something was acknowledged, as far as calls of this method show."""
        left, before = self._unsent(), self._unsent_before
        self._unsent_before = left
        # Pings add bytes too, so a growing number proves nothing.
        if left < before:
            self._progress_at = self._seconds()
        return self._seconds() - self._progress_at

    def _unsent(self) -> int:
        return 0 if self._tcp is None else unacknowledged(self._tcp)


class RenderCache:
    """Renders each frame once for all viewers that are ready at the same time."""

    def __init__(self, render: Callable[[VideoFrameInfo], bytes]) -> None:
        self._render = render
        self._of: VideoFrameInfo | None = None
        self._bytes = b""

    def rendered(self, frame: VideoFrameInfo) -> bytes:
        """The bytes of a frame."""
        if self._of is not frame:
            self._bytes = self._render(frame)
            self._of = frame
        return self._bytes


def replace_status(request: Request, other: dict[str, Any]) -> None:
    """Set the header that says in which parameters a stream differs from the requested one.

    :param other: these parameters; none removes the header
    """
    if other:
        request.setHeader(b"x-instead", urlencode(other).encode("ascii"))
    else:
        request.responseHeaders.removeHeader(b"x-instead")


def limit_send_buffer(transport: Any) -> Any:
    """Limit the unsent bytes in the kernel. Returns the TCP connection under a transport, or ``None``."""
    tcp = tcp_of(transport)
    if tcp is not None:
        handle = tcp.getHandle()
        handle.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SOCKET_BYTES)
        handle.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _PROBES.items():
            if hasattr(socket, name):
                handle.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        keep_little(tcp)
    return tcp
