"""Child processes in memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet.error import ProcessTerminated
from twisted.internet.task import Clock
from twisted.python.failure import Failure


class Process:
    """The transport of a process without effects."""

    def __init__(self, protocol: Any, decode: Callable[[bytes], Any]) -> None:
        self.pid = 1
        self.protocol = protocol
        self._decode = decode
        self.lines: list[Any] = []
        self.closed = False
        self.signals: list[str] = []

    def write(self, data: bytes) -> None:
        self.lines += [self._decode(line) for line in data.splitlines()]

    def closeStdin(self) -> None:
        self.closed = True

    def signalProcess(self, name: str) -> None:
        self.signals.append(name)
        self.end()

    def end(self) -> None:
        self.protocol.processEnded(Failure(ProcessTerminated(signal=9)))


class Reactor(Clock):
    """A clock that starts such processes.

    :param decode: decodes the lines on their input
    """

    def __init__(self, decode: Callable[[bytes], Any]) -> None:
        super().__init__()
        self._decode = decode
        self.processes: list[Process] = []

    def spawnProcess(self, protocol: Any, executable: str, args: list[str], **options: Any) -> None:
        protocol.transport = Process(protocol, self._decode)
        self.processes.append(protocol.transport)
