"""A Python process that the daemon starts and exchanges lines with."""

from __future__ import annotations

import os
import sys
from typing import Any, Protocol

from twisted.internet.error import ProcessExitedAlready
from twisted.internet.protocol import ProcessProtocol
from twisted.python.failure import Failure

MAX_LINE = 16384
"""Longest line that is accepted from the process, bytes."""


class ChildProcessOwner(Protocol):
    """The part of the daemon that started the process."""

    def on_line(self, line: bytes) -> None:
        """The process, or a library in it, wrote a line to its standard output."""

    def on_exit(self, reason: str) -> None:
        """The process has ended and was reaped."""


class ChildProcess(ProcessProtocol):
    """One process. It must exit at the end of its standard input, which also means that the daemon has died."""

    transport: Any

    def __init__(self, owner: ChildProcessOwner) -> None:
        self._owner = owner
        self._unfinished_line = b""

    def start(self, reactor: Any, arguments: list[str]) -> None:
        """Start the process.

        :param arguments: of the Python interpreter
        :raises OSError: it can't be started
        """
        reactor.spawnProcess(
            self,
            sys.executable,
            [sys.executable, *arguments],
            # The whole environment: it holds ROS's library path, and the DDS domain must be the same.
            env=dict(os.environ),
            childFDs={0: "w", 1: "r", 2: 2},
        )

    def send(self, line: bytes) -> None:
        """Write a line, with its end, to the process."""
        self.transport.write(line)

    def close(self) -> None:
        """Close the standard input of the process, which asks it to exit."""
        self.transport.closeStdin()

    def kill(self) -> None:
        """Send SIGKILL; nothing happens if the process has exited."""
        try:
            self.transport.signalProcess("KILL")
        except ProcessExitedAlready:
            return

    def outReceived(self, data: bytes) -> None:
        *lines, unfinished = (self._unfinished_line + data).split(b"\n")
        self._unfinished_line = unfinished[-MAX_LINE:]
        for line in lines:
            self._owner.on_line(line)

    def processEnded(self, reason: Failure) -> None:
        self._owner.on_exit(reason.getErrorMessage())
