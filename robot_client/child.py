"""A Python process of the daemon's that is told lines and answers in lines."""

from __future__ import annotations

import os
import sys
from typing import Any, Protocol

from twisted.internet.error import ProcessExitedAlready
from twisted.internet.protocol import ProcessProtocol
from twisted.python.failure import Failure

MAX_LINE = 16384
"""Longest line that is taken from it, bytes."""


class Keeper(Protocol):
    """Who has started it."""

    def heard(self, line: bytes) -> None:
        """It said something, or something in its process wrote where it speaks."""

    def lost(self, why: str) -> None:
        """It is gone and reaped."""


class Child(ProcessProtocol):
    """One such process; the end of its standard input is the end of the daemon."""

    transport: Any

    def __init__(self, keeper: Keeper) -> None:
        self._keeper = keeper
        self._said = b""

    def start(self, reactor: Any, arguments: list[str]) -> None:
        """Start it.

        :param reactor: for processes
        :param arguments: of Python
        :raises OSError: it can't be started
        """
        reactor.spawnProcess(
            self,
            sys.executable,
            [sys.executable, *arguments],
            # Whole: the wheels of ROS keep their library path in it, and the domain must be the same.
            env=dict(os.environ),
            childFDs={0: "w", 1: "r", 2: 2},
        )

    def tell(self, line: bytes) -> None:
        """Write a line to it."""
        self.transport.write(line)

    def leave(self) -> None:
        """Tell it no more, which means that it is to leave."""
        self.transport.closeStdin()

    def kill(self) -> None:
        """End it the hard way."""
        try:
            self.transport.signalProcess("KILL")
        except ProcessExitedAlready:
            return

    def outReceived(self, data: bytes) -> None:
        """It said something."""
        *lines, rest = (self._said + data).split(b"\n")
        self._said = rest[-MAX_LINE:]
        for line in lines:
            self._keeper.heard(line)

    def processEnded(self, reason: Failure) -> None:
        """It is gone and reaped."""
        self._keeper.lost(reason.getErrorMessage())
