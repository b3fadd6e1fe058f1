"""Connections whose other end has vanished without a word: the kernel is to find that out soon (tcp(7))."""

from __future__ import annotations

import socket
from typing import Any

from relay_server.edges.tcp import tcp_of

NOTICED_SECONDS = 6
"""An end that has vanished is noticed within so long, also while nothing is sent."""

_OPTIONS = {
    "TCP_KEEPIDLE": NOTICED_SECONDS // 2,
    "TCP_KEEPINTVL": 1,
    "TCP_KEEPCNT": NOTICED_SECONDS // 2,
    "TCP_USER_TIMEOUT": NOTICED_SECONDS * 1000,
}
"""Seconds, seconds, times, milliseconds; some systems know only some of them."""


def notice(transport: Any) -> None:
    """Have a connection end when its other end is gone, from now on."""
    tcp = tcp_of(transport)
    if tcp is None:
        return
    handle = tcp.getHandle()
    handle.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _OPTIONS.items():
        if hasattr(socket, name):
            handle.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
