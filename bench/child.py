"""The processes beside those that are measured: how they are started, talked to and ended."""

from __future__ import annotations

import json
import socket
import subprocess
from typing import Any

from bench import ROOT


def free_port() -> int:
    """A port on loopback for a process that has to be told one."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


class Child:
    """One process.

    :param streams: as :class:`subprocess.Popen` takes them, and ``env``
    """

    def __init__(self, command: list[str], **streams: Any) -> None:
        self.popen = subprocess.Popen(command, text=True, cwd=ROOT, **streams)

    @property
    def pid(self) -> int:
        """Its process."""
        return self.popen.pid

    def line(self) -> str:
        """The next line it prints."""
        assert self.popen.stdout is not None
        return self.popen.stdout.readline()

    def ready(self, fault: Exception) -> list[str]:
        """The words of its first line, which begins with ``READY``.

        :param fault: raised when it says anything else, or ends
        """
        words = self.line().split()
        if words[:1] != ["READY"]:
            self.stop()
            raise fault
        return words

    def ask(self) -> dict[str, Any]:
        """What it prints, as JSON, for an empty line."""
        assert self.popen.stdin is not None
        self.popen.stdin.write("\n")
        self.popen.stdin.flush()
        return dict(json.loads(self.line()))

    def stop(self) -> None:
        """End and reap it: one that reads ends with its standard input, any other by SIGTERM."""
        if self.popen.stdin is None:
            self.popen.terminate()
        else:
            self.popen.stdin.close()
        try:
            self.popen.wait(10)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            self.popen.wait()
        if self.popen.stdout is not None:
            self.popen.stdout.close()
