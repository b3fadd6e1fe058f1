"""websockify, the proxy from websockets to TCP that most browsers' remote desktops go through."""

from __future__ import annotations

import importlib.util
import socket
import subprocess
import sys
import time

from bench.child import Child, free_port
from bench.report import Unavailable
from bench.wire import End, Loop, TcpEnd, WebEnd


class Websockify(Child):
    """websockify in front of a TCP end of ours: ``client`` ⇄ websockify ⇄ ``server``.

    Each connection is a child process of its own.
    """

    def __init__(self, loop: Loop, size: int) -> None:
        if importlib.util.find_spec("websockify") is None:
            raise Unavailable("websockify is not installed (scripts/setup.sh bench)")
        self.name = "websockify"
        self.port = free_port()
        with socket.create_server(("127.0.0.1", 0)) as target:
            ends = [f"127.0.0.1:{self.port}", f"127.0.0.1:{target.getsockname()[1]}"]
            quiet = subprocess.DEVNULL
            super().__init__([sys.executable, "-m", "websockify", *ends], stdout=quiet, stderr=quiet)
            try:
                self.client = self._connect(loop)
                target.settimeout(10)
                self.server: End = TcpEnd(loop, target.accept()[0], size)
            except BaseException:
                self.stop()
                raise

    def _connect(self, loop: Loop) -> WebEnd:
        end = time.monotonic() + 20
        while True:
            try:
                return WebEnd(loop, self.port, "/websockify")
            except OSError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.1)  # it does not say when it listens
