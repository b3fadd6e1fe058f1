"""The TCP connection below a transport."""

from __future__ import annotations

import socket
from typing import Any


def tcp_of(transport: Any) -> Any:
    """The connection itself, through TLS; ``None`` in memory."""
    while transport is not None:
        handle = getattr(transport, "getHandle", lambda: None)()
        if isinstance(handle, socket.socket):
            return transport
        transport = getattr(transport, "transport", None)
    return None
