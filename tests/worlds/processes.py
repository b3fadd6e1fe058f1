"""Child processes with their output in files; each is reaped by its ``stop``, and none survives the tests."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.worlds.forked_programs import STACKS_SIGNAL, Forked, forkable, start
from tests.worlds.waiting import PATIENCE, freeze, wait_for

BIN = Path(sys.executable).parent
START_SECONDS = 60.0

forking = False
"""Whether our programs are forked from one that has imported what they need, which saves a second or two each. Tests
turn it on; what measures leaves it off.
"""


def ros_environment(domain: int) -> dict[str, str]:
    """Variables that isolate a ROS process."""
    return {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def mortal(command: list[str]) -> list[str]:
    """The same command, ended by SIGTERM as soon as the starting thread has ended for any reason.

    So a killed test run leaves no robots and relays. Ctrl-C ends it even if the run itself was started in the
    background of a script, which ignores it.
    """
    command = ["env", "--default-signal=INT", *command]
    setpriv = shutil.which("setpriv")
    return [setpriv, "--pdeathsig", "TERM", "--", *command] if setpriv else command


class Process:
    """One child process with its output in files."""

    def __init__(
        self, command: list[str], folder: Path, name: str, env: dict[str, str] | None = None
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.name = name
        self.out = folder / f"{name}.out"
        self.log = folder / f"{name}.log"
        self.popen: subprocess.Popen[bytes] | Forked
        with self.out.open("ab") as out, self.log.open("ab") as log:
            self._start = out.tell()
            if forking and forkable(command, env or os.environ):
                self.popen = start(command, self.out, self.log, env=env)
                return
            self.popen = subprocess.Popen(
                mortal(command),
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=log,
                env=env,
                start_new_session=True,
            )

    def said(self) -> str:
        """Its output since this start."""
        return self.out.read_bytes()[self._start :].decode(errors="replace")

    def wait_to_say(self, start: str) -> str:
        """Waits for a line with this beginning, and returns it."""

        def line() -> str | None:
            if self.popen.poll() is not None:
                raise AssertionError(
                    f"{self.name} ended with {self.popen.returncode}: {self.log.read_text()[-2000:]}"
                )
            return next((each for each in self.said().splitlines() if each.startswith(start)), None)

        return str(wait_for(f"{self.name} prints {start}", line, START_SECONDS))

    def explanation(self) -> str:
        """What it is doing, for a test that fails: its end or its stacks, and the last part of its log."""
        if isinstance(self.popen, Forked) and self.popen.poll() is None:
            before = self.log.stat().st_size
            self.popen.send_signal(STACKS_SIGNAL)
            with contextlib.suppress(AssertionError):
                wait_for("its stacks are written", lambda: self.log.stat().st_size > before, 2.0)
                time.sleep(0.2)  # the rest of them
        code = self.popen.poll()
        return (
            f"{self.name} {'runs' if code is None else f'ended with {code}'}: {self.log.read_text()[-6000:]}"
        )

    def signal(self, number: int) -> None:
        """Send a signal."""
        self.popen.send_signal(number)

    def freeze(self) -> None:
        """SIGSTOP; it stands still when this returns."""
        freeze(self.popen.pid)

    def kill(self) -> None:
        """kill -9, and reap."""
        self.popen.kill()
        self.popen.wait(PATIENCE)

    def stop(self, seconds: float = PATIENCE) -> int:
        """SIGTERM (also to a frozen one), reap, and return the exit code."""
        if self.popen.poll() is None:
            self.popen.send_signal(signal.SIGTERM)
            self.popen.send_signal(signal.SIGCONT)
            try:
                self.popen.wait(seconds)
            except subprocess.TimeoutExpired:
                self.popen.kill()
                self.popen.wait(PATIENCE)
        return int(self.popen.returncode)


@contextlib.contextmanager
def running(*things: Any) -> Iterator[None]:
    """Stops these at the end, last one first."""
    try:
        yield
    finally:
        for each in reversed(things):
            each.stop()
