"""The daemon as processes that tests start, watch and end."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path

import psutil

from tests.robot_client.ros import PATIENCE
from tests.worlds.fake_relay import FakeRelay
from tests.worlds.forked_programs import Forked, start


def until(true: Callable[[], object], timeout: float = PATIENCE) -> None:
    deadline = time.monotonic() + timeout
    while not true():
        assert time.monotonic() < deadline, f"waited {timeout} s in vain"
        time.sleep(0.02)  # the expected event comes from other processes


class Robot:
    """A state folder and the processes that use it."""

    def __init__(self, relay: FakeRelay, state: Path, environment: dict[str, str]) -> None:
        self.relay = relay
        self.state = state
        self.log = state.with_suffix(".log")
        self.environment = environment
        self._processes: list[Forked] = []

    def start(self, *arguments: str, stdin: str | None = None, program: str = "switchboard-robot") -> Forked:
        said = None
        if stdin is not None:
            said = self.state.with_suffix(".stdin")
            said.write_text(stdin)
        command = [program, *arguments, "--state", str(self.state)]
        process = start(command, self.log, self.log, env=self.environment, stdin=said)
        self._processes.append(process)
        return process

    def enroll(self) -> None:
        process = self.start(
            "enroll", "--relay", self.relay.address, "--robot", "r1", "--code", "-", stdin="code-1\n"
        )
        self.asked = self.relay.enroll()
        assert process.wait(PATIENCE) == 0, self.log.read_text()

    def run(self, *arguments: str) -> Forked:
        return self.start("run", *arguments)

    def guards(self, process: Forked) -> list[psutil.Process]:
        return self.children(process, "robot_client.motion.guard")

    def children(self, process: Forked, module: str) -> list[psutil.Process]:
        return [each for each in psutil.Process(process.pid).children() if module in each.cmdline()]

    def close(self) -> None:
        for process in self._processes:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
            process.wait(10)
