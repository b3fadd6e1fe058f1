"""A child process with input on its standard input."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from tests.worlds.processes import Process
from tests.worlds.waiting import PATIENCE


class PipedProcess(Process):
    """A process whose standard input is a pipe.

    :ivar feed: the file descriptor of the pipe's other end
    """

    def __init__(
        self, command: list[str], folder: Path, name: str, env: dict[str, str] | None = None
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        pipe = folder / f"{name}.in"
        pipe.unlink(missing_ok=True)
        os.mkfifo(pipe)
        # It is open on both sides until the child has it, so that neither blocks.
        self.feed = os.open(pipe, os.O_RDWR)
        super().__init__(["sh", "-c", 'exec "$@" <"$0"', str(pipe), *command], folder, name, env)
        self._pipe = pipe

    def wait_to_say(self, start: str) -> str:
        """Waits for a line with this beginning, and returns it."""
        line = super().wait_to_say(start)
        if self._pipe.exists():
            both, self.feed = self.feed, os.open(self._pipe, os.O_WRONLY)
            os.close(both)
            self._pipe.unlink()
        return line

    def tell(self, line: str) -> None:
        """Writes a line to its standard input."""
        os.write(self.feed, line.encode() + b"\n")

    def stop(self, seconds: float = PATIENCE) -> int:
        """SIGTERM, reap, and return the exit code."""
        code = super().stop(seconds)
        with contextlib.suppress(OSError):
            os.close(self.feed)
        return code
