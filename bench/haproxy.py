"""HAProxy in http mode, between the same ends."""

from __future__ import annotations

import shutil
import socket
import subprocess
import time
from pathlib import Path

from bench.child import Child, free_port
from bench.report import Unavailable
from bench.wire import End, Loop, TcpEnd, WebEnd

CONFIGURATION = """\
global
    nbthread 1
    maxconn 100
defaults
    mode http
    timeout connect 5s
    timeout client 60s
    timeout server 60s
    timeout tunnel 60s
    option http-no-delay
frontend in
    bind 127.0.0.1:{port}
    default_backend out
backend out
    server one 127.0.0.1:{target}
"""
_ANSWER = (
    b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Accept: BACScCJPNqyz+UBoqMH89VmURoA=\r\n\r\n"
)


def executable() -> str:
    """Where HAProxy is.

    :raises Unavailable: nowhere
    """
    found = shutil.which("haproxy") or shutil.which("haproxy", path="/usr/sbin:/usr/local/sbin")
    if found is None:
        raise Unavailable("no HAProxy (Debian: apt install haproxy)")
    return found


class HAProxy(Child):
    """HAProxy with a websocket client of ours in front and a TCP end that answered the handshake behind.

    :param size: bytes of one message, frame and all, as the server sees it
    """

    def __init__(self, loop: Loop, folder: Path, size: int) -> None:
        command = executable()
        port = free_port()
        with socket.create_server(("127.0.0.1", 0)) as target:
            configuration = folder / "haproxy.cfg"
            configuration.write_text(CONFIGURATION.format(port=port, target=target.getsockname()[1]))
            quiet = subprocess.DEVNULL
            super().__init__([command, "-db", "-f", str(configuration)], stdout=quiet, stderr=quiet)
            try:
                self.client, self.server = self._open(loop, port, target, size)
            except BaseException:
                self.stop()
                raise

    def _open(self, loop: Loop, port: int, target: socket.socket, size: int) -> tuple[WebEnd, End]:
        target.settimeout(10)
        end = time.monotonic() + 10
        while True:
            try:
                opening = socket.create_connection(("127.0.0.1", port), timeout=10)
                break
            except ConnectionRefusedError:
                assert time.monotonic() < end, "HAProxy does not listen"
                time.sleep(0.05)  # it does not say when it listens
        client = WebEnd.begin(opening, "/")
        server, _ = target.accept()
        request = b""
        while b"\r\n\r\n" not in request:
            request += server.recv(4096)
        server.sendall(_ANSWER)
        return WebEnd.opened(loop, client), TcpEnd(loop, server, size)
