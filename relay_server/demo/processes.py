"""Processes that the demo starts."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from relay_protocol.errors import SwitchboardError, Unavailable

STOP_SECONDS = 3.0
RESTART_SECONDS = 1.0
"""Seconds between two looks for programs that are to be started again."""


@dataclass
class _StartedProcess:
    """A program that was started.

    :param name: of its log, without ending
    :param restarts: whether it is started again when it has ended
    """

    command: list[str]
    name: str
    environment: dict[str, str]
    restarts: bool
    process: subprocess.Popen[bytes]


class DemoProcesses:
    """Processes with a log each, all ended when the demo ends.

    :param logs: folder of the logs
    """

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._programs: list[_StartedProcess] = []
        self._stopping = False

    def start(
        self, command: list[str], name: str, environment: dict[str, str], *, restarts: bool = False
    ) -> subprocess.Popen[bytes]:
        """Start one.

        :param name: of its log, without ending
        :param restarts: whether :meth:`restart` starts it again, as systemd would
        :raises Unavailable: all are being ended
        """
        process = self._start(command, name, environment)
        self._programs.append(_StartedProcess(command, name, environment, restarts, process))
        return process

    def restart(self) -> list[str]:
        """Start again the programs that have ended and are to be restarted; returns their names."""
        if self._stopping:
            return []
        ended = [each for each in self._programs if each.restarts and each.process.poll() is not None]
        for each in ended:
            each.process = self._start(each.command, each.name, each.environment)
        return [each.name for each in ended]

    def _start(self, command: list[str], name: str, environment: dict[str, str]) -> subprocess.Popen[bytes]:
        if self._stopping:
            raise Unavailable("the demo is being ended")
        self._logs.mkdir(exist_ok=True)
        with self.log(name).open("ab") as log:
            # A session of its own, so that Ctrl-C goes to the demo alone, which ends the rest in order.
            return subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=environment,
                start_new_session=True,
            )

    def log(self, name: str) -> Path:
        """The log of a process."""
        return self._logs / f"{name}.log"

    def unexpected_end(self) -> str | None:
        """Which program has ended by itself, and how, in words; ``None`` if all run."""
        for each in self._programs:
            code = each.process.poll()
            if code is not None and not self._stopping:
                return f"{Path(each.command[0]).name} ended with code {code}"
        return None

    def stop(self, by: signal.Signals = signal.SIGTERM) -> None:
        """End all processes by a signal and wait for them. Those that do not react are killed."""
        self._stopping = True
        processes = [each.process for each in self._programs]
        for process in reversed(processes):
            if process.poll() is None:
                process.send_signal(by)
        until = time.monotonic() + STOP_SECONDS
        for process in processes:
            try:
                process.wait(max(0.0, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def command_path(name: str) -> str:
    """A command of this project, installed beside this Python."""
    path = Path(sys.executable).parent / name
    if not path.exists():
        raise SwitchboardError(f"{name} is not installed; install 'robot-switchboard[server,robot,sim,ros]'")
    return str(path)
