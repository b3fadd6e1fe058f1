"""Connections whose other end has vanished without a word: the kernel is to find that out soon (tcp(7))."""

from __future__ import annotations

import fcntl
import socket
import struct
import sys
import termios
from typing import Any

from relay_protocol.limits import KIB

UNSENT_BYTES = 16 * KIB
"""Bytes the kernel may hold that have not gone over the network yet; more would only add delay."""

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
    """Have the kernel take no more bytes than it can send at once (tcp(7), TCP_NOTSENT_LOWAT).

    What has left for the network is not limited by this, so that downloads stay fast.
    """
    handle = tcp.getHandle()
    if _TCP_NOTSENT_LOWAT is not None and isinstance(handle, socket.socket):
        handle.setsockopt(socket.IPPROTO_TCP, _TCP_NOTSENT_LOWAT, unsent)


def unacknowledged(tcp: Any) -> int:
    """Bytes the peer has not acknowledged: Twisted's, which are only read here, and the kernel's."""
    left = int(tcp._tempDataLen + len(tcp.dataBuffer) - tcp.offset)
    try:
        # On Linux what is not acknowledged (tcp(7), SIOCOUTQ), elsewhere what is not sent.
        answer = fcntl.ioctl(tcp.fileno(), termios.TIOCOUTQ, bytes(4))
    except (OSError, ValueError):
        # Closed meanwhile.
        return left
    return left + int(struct.unpack("i", answer)[0])


NOTICED_SECONDS = 6
"""An end that has vanished is noticed within so long, also while nothing is sent."""

_OPTIONS = {
    "TCP_KEEPIDLE": NOTICED_SECONDS // 2,
    "TCP_KEEPINTVL": 1,
    "TCP_KEEPCNT": NOTICED_SECONDS // 2,
    "TCP_USER_TIMEOUT": NOTICED_SECONDS * 1000,
}
"""Seconds, seconds, times, milliseconds; some systems know only some of them."""


def enable_tcp_keepalive(transport: Any) -> None:
    """Have a connection end when its other end is gone, from now on."""
    tcp = tcp_of(transport)
    if tcp is None:
        return
    handle = tcp.getHandle()
    handle.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _OPTIONS.items():
        if hasattr(socket, name):
            handle.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
