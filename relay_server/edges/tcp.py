"""The TCP connection below a transport: how much of it the kernel holds, and how little it shall keep unsent."""

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
