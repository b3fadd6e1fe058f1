"""Connections whose peer is unreachable, on a real socket."""

from __future__ import annotations

import socket
from typing import Any

import pytest

from relay_server.common.tcp import NOTICED_SECONDS, enable_tcp_keepalive


class Wrapped:
    """TLS over a connection, as Twisted shows it."""

    def __init__(self, transport: Any) -> None:
        self.transport = transport

    def getHandle(self) -> object:
        """Not the socket."""
        return object()


class Connection:
    """A connection, as Twisted shows it."""

    def __init__(self, handle: socket.socket) -> None:
        self._handle = handle

    def getHandle(self) -> socket.socket:
        """The socket."""
        return self._handle


@pytest.mark.parametrize("wrap", [lambda transport: transport, Wrapped])
def test_the_kernel_probes_the_peer_soon(wrap: Any) -> None:
    """Also through TLS, and with unsent bytes."""
    with socket.socket() as handle:
        enable_tcp_keepalive(wrap(Connection(handle)))
        assert handle.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        idle, interval, times = (
            handle.getsockopt(socket.IPPROTO_TCP, option)
            for option in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
        )
        assert idle + interval * times <= NOTICED_SECONDS
        unacknowledged = handle.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT)
        assert unacknowledged <= NOTICED_SECONDS * 1000


def test_a_transport_in_memory_is_left_alone() -> None:
    enable_tcp_keepalive(Wrapped(None))
