"""What all viewers have in common: which picture is next, what it is made into, how much of it the kernel may hold.

The newest picture counts. Each viewer has one under way; whatever comes meanwhile waits here, where it can still be
replaced, and not in the kernel, where it would only grow old.
"""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Callable
from typing import Any
from urllib.parse import urlencode

from twisted.web.server import Request

from relay_protocol.limits import KIB, MIB
from relay_server.common.tcp import keep_little, tcp_of, unacknowledged
from relay_server.video.frames import VideoFrameInfo

CONTENT_TYPES = {"jpeg": b"image/jpeg", "png": b"image/png"}
"""Of single pictures, by their codec."""

STALL_SECONDS = 5.0
"""A viewer that takes nothing for so long is cut."""

LOOK_SECONDS = 1.0
"""How often that is looked at."""

WAITING_BYTES = MIB
"""Pictures of H.264 need those before them, so that several wait; more than this and it begins anew."""

LAG_SECONDS = 0.5
"""Pictures of H.264 that would take longer on their way to a viewer are left out; behind them others would grow old."""

PACE_PICTURES = 8
"""How fast a viewer takes what he is sent is told by so many of the last times."""

APART = 1.5
"""The most of these must be so many times the least, or the network's wavering would seem to be slowness."""

SOCKET_BYTES = 256 * KIB
"""What the kernel holds for a viewer."""

UNDER_WAY_BYTES = 16 * KIB
"""With more than this not acknowledged yet, the last picture is still under way."""

_PROBES = {"TCP_KEEPIDLE": 30, "TCP_KEEPINTVL": 10, "TCP_KEEPCNT": 3}
"""Seconds, seconds, times: while a robot is away nothing is written, and these alone notice a viewer who vanished
(tcp(7); some systems know only some of them)."""


class FrameQueue:
    """The pictures that wait for a viewer's turn: the newest, or of H.264 all since the last that stands alone.

    :param seconds: a monotonic clock, the one pictures are dated by
    :param start_anew: called when a picture of H.264 is left out, without which the following are no use
    """

    __slots__ = ("_bytes", "_pace", "_pictures", "_seconds", "_start_anew")

    def __init__(self, seconds: Callable[[], float], start_anew: Callable[[], None] = lambda: None) -> None:
        self._seconds = seconds
        self._start_anew = start_anew
        self._pictures: list[VideoFrameInfo] = []
        self._bytes = 0
        self._pace = SendRate()

    def __bool__(self) -> bool:
        return bool(self._pictures)

    def put(self, picture: VideoFrameInfo) -> None:
        """A new picture, which takes the place of all that it does not need."""
        if picture.key:
            self._pictures.clear()
            self._bytes = 0
        self._pictures.append(picture)
        self._bytes += len(picture.body)
        if self._bytes > WAITING_BYTES and len(self._pictures) > 1:
            self._leave_out()

    def take(self) -> list[VideoFrameInfo]:
        """What goes to the viewer, who has taken what went before; nothing when it is too old.

        Several that he would take too long for are left out, but for one that stands alone: a viewer whose link is thin
        for any of these still sees something.
        """
        now = self._seconds()
        self._pace.taken(now)
        pictures = self._pictures
        if pictures and now > pictures[0].good_until:
            pictures = []
            self._leave_out()
        elif len(pictures) > 1 and self._pace.needs(self._bytes) > LAG_SECONDS:
            pictures = [each for each in pictures[:1] if each.key]
            self._leave_out()
        self._pictures, self._bytes = [], 0
        if pictures:
            self._pace.sent(sum(len(each.body) for each in pictures), now)
        return pictures

    def _leave_out(self) -> None:
        self._pictures = []
        self._bytes = 0
        self._start_anew()


class SendRate:
    """How long a viewer needs for what he is sent.

    What is the same for little and for much, as the time on the way, is not counted: it is the difference between the
    least and the most of late that tells. Before there is one nothing is known; where there is none any more it is as
    it was, or better.
    """

    __slots__ = ("_bytes", "_last", "_per_byte", "_since")

    def __init__(self) -> None:
        self._last: deque[tuple[int, float]] = deque(maxlen=PACE_PICTURES)
        """Bytes, and seconds until they were taken."""
        self._per_byte = 0.0
        self._bytes = 0
        self._since = 0.0

    def sent(self, size: int, now: float) -> None:
        """So many bytes went to him."""
        self._bytes, self._since = size, now

    def taken(self, now: float) -> None:
        """He has taken them."""
        if not self._bytes:
            return
        took = now - self._since
        self._last.append((self._bytes, took))
        (least, quick), (most, slow) = min(self._last), max(self._last)
        if most >= APART * least:
            self._per_byte = max(slow - quick, 0.0) / (most - least)
        self._per_byte = min(self._per_byte, took / self._bytes)
        self._bytes = 0

    def needs(self, size: int) -> float:
        """Seconds he takes for so many bytes; 0: it is not known."""
        return size * self._per_byte


class AckTracker:
    """Whether a viewer takes what was sent: by what his end has acknowledged.

    :param tcp: his connection, see :func:`limit_send_buffer`; ``None`` takes everything at once
    :param seconds: a monotonic clock
    """

    __slots__ = ("_left", "_moved", "_seconds", "_tcp")

    def __init__(self, tcp: Any, seconds: Callable[[], float]) -> None:
        self._tcp = tcp
        self._seconds = seconds
        self._left = 0
        self._moved = seconds()

    @property
    def under_way(self) -> bool:
        """Whether much of what was sent has not arrived yet."""
        return self._tcp is not None and unacknowledged(self._tcp) > UNDER_WAY_BYTES

    def sent(self) -> None:
        """A picture was sent just now."""
        self._left, self._moved = self._unsent(), self._seconds()

    def stands(self) -> float:
        """Seconds since a picture was sent, or something of it acknowledged, as far as looks like this one tell."""
        left, before = self._unsent(), self._left
        self._left = left
        # More than before there is by pings, which say nothing of the other end.
        if left < before:
            self._moved = self._seconds()
        return self._seconds() - self._moved

    def _unsent(self) -> int:
        return 0 if self._tcp is None else unacknowledged(self._tcp)


class RenderCache:
    """What was made of a picture last: all viewers that are ready get it at the same time, and the same bytes."""

    def __init__(self, make: Callable[[VideoFrameInfo], bytes]) -> None:
        self._make = make
        self._of: VideoFrameInfo | None = None
        self._bytes = b""

    def of(self, picture: VideoFrameInfo) -> bytes:
        """The bytes for a picture."""
        if self._of is not picture:
            self._bytes = self._make(picture)
            self._of = picture
        return self._bytes


def replace_status(request: Request, other: dict[str, Any]) -> None:
    """Have the head of an answer tell that another form of a camera is shown than was asked for.

    :param other: the parameters by which it differs, if any
    """
    if other:
        request.setHeader(b"x-instead", urlencode(other).encode("ascii"))
    else:
        request.responseHeaders.removeHeader(b"x-instead")


def limit_send_buffer(transport: Any) -> Any:
    """Keep what waits for a viewer out of the kernel; returns the TCP connection under a transport, if there is one."""
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
