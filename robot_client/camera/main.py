"""The camera process: ``python -m robot_client.camera.main``, started by the daemon, which sends messages
on its standard input. The process exits at the end of its standard input, also if the daemon died.
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

from robot_client.camera.ipc import (
    CameraAlive,
    CameraMessage,
    CameraSettings,
    LogLine,
    daemon_decoder,
    encode,
)
from robot_client.camera.stream_manager import StreamManager
from robot_client.logs import text
from robot_client.twisted_types import monotonic_reactor

ALIVE_EVERY = 1.0
MAX_LINE = 65536

NICE = 5
"""Increment of the niceness, since commands and samples are more urgent than frames."""

CLOSE_SECONDS = 0.3
"""Seconds for the last messages on the links."""


class DaemonPipe(LineReceiver):
    """The pipes to the daemon.

    :param reactor: its clock must be monotonic
    """

    transport: Any
    delimiter = b"\n"
    MAX_LENGTH = MAX_LINE

    def __init__(self, reactor: Any) -> None:
        self._reactor = reactor
        self._streams: StreamManager | None = None
        self._alive = LoopingCall(self.send, CameraAlive())

    def connectionMade(self) -> None:
        self._alive.start(ALIVE_EVERY)

    def lineReceived(self, data: bytes) -> None:
        message = daemon_decoder.decode(data)
        if isinstance(message, CameraSettings):
            self._streams = StreamManager(self._reactor, message, self.send)
        elif self._streams is not None:
            self._streams.handle(message)

    def connectionLost(self, reason: Failure = connectionDone) -> None:
        """The daemon has died or closed the pipe: close all streams and exit."""
        self._alive.stop()
        if self._streams is not None:
            self._streams.stop("the robot closed its camera process")
        self._reactor.callLater(CLOSE_SECONDS, self._reactor.stop)

    def send(self, message: CameraMessage) -> None:
        """Send a message to the daemon; from the reactor's thread."""
        if self.transport is not None:
            self.transport.write(encode(message))

    def log(self, event: LogEvent) -> None:
        """Send a log event to the daemon; from any thread."""
        level = event.get("log_level")
        line = LogLine(level=level.name if level is not None else "info", text=text(event))
        self._reactor.callFromThread(self.send, line)


def _reserve_stdout() -> int:
    """Reserve standard output for messages: libraries write to standard error instead, as ROS can be set to
    log to standard output (RCUTILS_LOGGING_USE_STDOUT).
    """
    descriptor = os.dup(1)
    os.dup2(2, 1)
    return descriptor


def main() -> None:
    """Run until standard input ends."""
    os.nice(NICE)
    # Read when OpenCV is loaded. It would warn at each attempt to open a camera; Capture logs that once.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    for for_the_daemon in (
        signal.SIGINT,
        signal.SIGTERM,
    ):  # this process ends when the daemon closes the pipe
        signal.signal(for_the_daemon, signal.SIG_IGN)
    stdout = _reserve_stdout()
    reactor = monotonic_reactor()
    daemon = DaemonPipe(reactor)
    quiet: Any = LogLevelFilterPredicate(defaultLogLevel=LogLevel.info)
    for chatter in ("twisted", "stdout", "log_legacy"):
        quiet.setLogLevelForNamespace(chatter, LogLevel.warn)
    log: Any = daemon.log
    observer: Any = FilteringLogObserver(log, [quiet])
    globalLogBeginner.beginLoggingTo([observer], redirectStandardIO=False)
    pipes: Any = stdio  # mypy reads the variant of another system
    pipes.StandardIO(daemon, stdin=0, stdout=stdout)
    reactor.run(installSignalHandlers=False)
    # Not sys.exit: a thread that reads a network camera may block for half a minute.
    os._exit(0)


if __name__ == "__main__":
    main()
