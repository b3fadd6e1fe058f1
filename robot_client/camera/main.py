"""The camera process: ``python -m robot_client.camera.main``, started by the daemon, told what to do by lines on its
standard input. The end of that pipe is the end of the daemon, and its own.
"""

from __future__ import annotations

import os
import signal
from typing import Any

from twisted.internet import stdio
from twisted.internet.protocol import connectionDone
from twisted.internet.task import LoopingCall
from twisted.logger import (
    FilteringLogObserver,
    LogEvent,
    LogLevel,
    LogLevelFilterPredicate,
    globalLogBeginner,
)
from twisted.protocols.basic import LineReceiver
from twisted.python.failure import Failure

from robot_client.camera.ipc import Answer, CameraAlive, CameraSettings, LogLine, decoder, encode
from robot_client.camera.stream_manager import StreamManager
from robot_client.logs import text
from robot_client.twisted_types import monotonic_reactor

ALIVE_EVERY = 1.0
MAX_LINE = 65536

NICE = 5
"""Steps by which this process gives way to others: commands and samples go before pictures."""

FAREWELL = 0.3
"""Seconds for the last words on the links."""


class DaemonPipe(LineReceiver):
    """The daemon that started this process.

    :param reactor: its clock must be monotonic
    """

    transport: Any
    delimiter = b"\n"
    MAX_LENGTH = MAX_LINE

    def __init__(self, reactor: Any) -> None:
        self._reactor = reactor
        self._studio: StreamManager | None = None
        self._alive = LoopingCall(self.tell, CameraAlive())

    def connectionMade(self) -> None:
        """The pipes are open."""
        self._alive.start(ALIVE_EVERY)

    def lineReceived(self, data: bytes) -> None:
        """The daemon says something."""
        line = decoder.decode(data)
        if isinstance(line, CameraSettings):
            self._studio = StreamManager(self._reactor, line, self.tell)
        elif self._studio is not None:
            self._studio.take(line)

    def connectionLost(self, reason: Failure = connectionDone) -> None:
        """The daemon is gone, or wants no more pictures."""
        self._alive.stop()
        if self._studio is not None:
            self._studio.stop("the robot shows no more pictures")
        self._reactor.callLater(FAREWELL, self._reactor.stop)

    def tell(self, answer: Answer) -> None:
        """Say something to the daemon; from the reactor's thread."""
        if self.transport is not None:
            self.transport.write(encode(answer))

    def log(self, event: LogEvent) -> None:
        """Have the daemon log something; from any thread."""
        level = event.get("log_level")
        line = LogLine(level=level.name if level is not None else "info", text=text(event))
        self._reactor.callFromThread(self.tell, line)


def _own_stdout() -> int:
    """Take standard output for answers alone: ROS can be told to log there (RCUTILS_LOGGING_USE_STDOUT)."""
    outlet = os.dup(1)
    os.dup2(2, 1)
    return outlet


def main() -> None:
    """Show cameras until standard input ends."""
    os.nice(NICE)
    # OpenCV, which reads it when it is loaded, would warn at each attempt to open a camera; Capture tells it once.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    for meant_for_the_daemon in (signal.SIGINT, signal.SIGTERM):  # it says when it is time, or its pipe ends
        signal.signal(meant_for_the_daemon, signal.SIG_IGN)
    outlet = _own_stdout()
    reactor = monotonic_reactor()
    daemon = DaemonPipe(reactor)
    quiet: Any = LogLevelFilterPredicate(defaultLogLevel=LogLevel.info)
    for chatter in ("twisted", "stdout", "log_legacy"):
        quiet.setLogLevelForNamespace(chatter, LogLevel.warn)
    log: Any = daemon.log
    observer: Any = FilteringLogObserver(log, [quiet])
    globalLogBeginner.beginLoggingTo([observer], redirectStandardIO=False)
    pipes: Any = stdio  # of two systems, of which mypy reads the other
    pipes.StandardIO(daemon, stdin=0, stdout=outlet)
    reactor.run(installSignalHandlers=False)
    # A thread that reads a camera over a network may need half a minute to notice.
    os._exit(0)


if __name__ == "__main__":
    main()
