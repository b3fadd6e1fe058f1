"""TCP options (tcp(7)), and Twisted's push producers for writers that must know whether the transport takes bytes."""

from __future__ import annotations

import fcntl
import socket
import struct
import sys
import termios
from typing import Any, Protocol

from relay_protocol.limits import KIB
from relay_server.common.clock import Clock, Timer, cancel

UNSENT_BYTES = 16 * KIB
"""Most unsent bytes in the kernel; more would only add delay."""

# Python 3.11 knows the name only where its C library did.
_TCP_NOTSENT_LOWAT = getattr(socket, "TCP_NOTSENT_LOWAT", 25 if sys.platform == "linux" else None)


def tcp_of(transport: Any) -> Any:
    """The TCP connection under a transport, through TLS; ``None`` in memory."""
    while transport is not None:
        handle = getattr(transport, "getHandle", lambda: None)()
        if isinstance(handle, socket.socket):
            return transport
        transport = getattr(transport, "transport", None)
    return None


def keep_little(tcp: Any, unsent: int = UNSENT_BYTES) -> None:
    """Bound the unsent bytes in the kernel (tcp(7), TCP_NOTSENT_LOWAT).

    Bytes in flight are not limited, so downloads stay fast.
    """
    handle = tcp.getHandle()
    if _TCP_NOTSENT_LOWAT is not None and isinstance(handle, socket.socket):
        handle.setsockopt(socket.IPPROTO_TCP, _TCP_NOTSENT_LOWAT, unsent)


def unacknowledged(tcp: Any) -> int:
    """Bytes the peer has not acknowledged, in Twisted's buffers and the kernel's."""
    left = int(tcp._tempDataLen + len(tcp.dataBuffer) - tcp.offset)
    try:
        # Linux counts unacknowledged bytes (tcp(7), SIOCOUTQ), other systems unsent ones.
        answer = fcntl.ioctl(tcp.fileno(), termios.TIOCOUTQ, bytes(4))
    except (OSError, ValueError):
        # Closed meanwhile.
        return left
    return left + int(struct.unpack("i", answer)[0])


NOTICED_SECONDS = 6
"""Seconds within which a dead peer is detected, also while nothing is sent."""

_OPTIONS = {
    "TCP_KEEPIDLE": NOTICED_SECONDS // 2,
    "TCP_KEEPINTVL": 1,
    "TCP_KEEPCNT": NOTICED_SECONDS // 2,
    "TCP_USER_TIMEOUT": NOTICED_SECONDS * 1000,
}
"""In seconds, seconds, probes and milliseconds. Some systems have only some of them."""


def enable_tcp_keepalive(transport: Any) -> None:
    """Let the kernel detect a dead peer of this connection."""
    tcp = tcp_of(transport)
    if tcp is None:
        return
    handle = tcp.getHandle()
    handle.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _OPTIONS.items():
        if hasattr(socket, name):
            handle.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


UNDER_WAY_BYTES = 16 * 1024
"""A stream of updates counts as full while more bytes than this are unacknowledged: the next ones would be late."""

AGAIN_SECONDS = 0.02
"""Seconds between checks of the unacknowledged bytes; the kernel does not notify."""


class Pausable(Protocol):
    """A writer to a transport."""

    def pause(self) -> None:
        """The transport's buffer is full."""

    def resume(self) -> None:
        """The transport's buffer has room again."""


class PushProducer:
    """A streaming producer that pauses and resumes a writer."""

    __slots__ = ("_writes",)

    def __init__(self, writes: Pausable) -> None:
        self._writes = writes

    def pauseProducing(self) -> None:
        """See ``IPushProducer``."""
        self._writes.pause()

    def resumeProducing(self) -> None:
        """See ``IPushProducer``."""
        self._writes.resume()

    def stopProducing(self) -> None:
        """The connection is gone; its protocol is notified too."""


class NewsFlow(PushProducer):
    """The same for a stream whose newest update counts: bytes in the kernel and in the network make it full too.

    :param transport: of the request
    """

    __slots__ = ("_clock", "_left", "_tcp", "_timer")

    def __init__(self, writes: Pausable, clock: Clock, transport: Any) -> None:
        super().__init__(writes)
        self._clock = clock
        self._tcp = tcp_of(transport)
        self._timer: Timer | None = None
        self._left = 0
        if self._tcp is not None:
            keep_little(self._tcp)

    def made_progress(self) -> bool:
        """Whether the reader has accepted bytes since the last call."""
        left, self._left = self._left, 0 if self._tcp is None else unacknowledged(self._tcp)
        return self._left < left

    def pauseProducing(self) -> None:
        """See ``IPushProducer``."""
        cancel(self._timer)
        self._timer = None
        self.made_progress()
        super().pauseProducing()

    def resumeProducing(self) -> None:
        """Twisted's buffer is empty; wait until the reader has nearly everything."""
        if self._tcp is not None and unacknowledged(self._tcp) > UNDER_WAY_BYTES:
            self._timer = self._clock.callLater(AGAIN_SECONDS, self.resumeProducing)
        else:
            self._timer = None
            super().resumeProducing()

    def stopProducing(self) -> None:
        """The connection is gone."""
        self.end()

    def end(self) -> None:
        """The stream is over."""
        cancel(self._timer)
        self._timer = None
