"""websockify, the proxy from websockets to TCP that most browsers' remote desktops go through."""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
import time

from bench.report import Unavailable
from bench.wire import End, Loop, TcpEnd, WebEnd


class Websockify:
    """websockify in front of a TCP end of ours: ``client`` ⇄ websockify ⇄ ``server``."""

    def __init__(self, loop: Loop, size: int) -> None:
        if importlib.util.find_spec("websockify") is None:
            raise Unavailable("websockify is not installed (scripts/setup.sh bench)")
        self.name = "websockify"
        with socket.create_server(("127.0.0.1", 0)) as probe:
            self.port = probe.getsockname()[1]
        with socket.create_server(("127.0.0.1", 0)) as target:
            self.popen = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "websockify",
                    f"127.0.0.1:{self.port}",
                    f"127.0.0.1:{target.getsockname()[1]}",
                ],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env={**os.environ},
            )
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
                time.sleep(0.1)

    @property
    def pid(self) -> int:
        """Its process; each connection has a child."""
        return self.popen.pid

    def stop(self) -> None:
        """End and reap it."""
        self.popen.terminate()
        try:
            self.popen.wait(5)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            self.popen.wait()
