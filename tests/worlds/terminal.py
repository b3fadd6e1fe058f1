"""``switchboard`` in a terminal of its own."""

from __future__ import annotations

import fcntl
import os
import struct
import subprocess
import termios
from contextlib import suppress
from typing import Any

from tests.worlds.processes import BIN

ROWS, COLUMNS = 40, 200


class Terminal:
    """A pseudo terminal that ``switchboard`` controls, so that its Ctrl-C is a signal.

    :param arguments: of the command
    """

    def __init__(self, *arguments: str) -> None:
        self._mine, self._its = os.openpty()
        fcntl.ioctl(self._its, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
        os.set_blocking(self._mine, False)
        self.settings_before = self.settings()
        # Ctrl-C must also end it if the tests run in a script's background, which ignores it.
        command = ["setsid", "--ctty", "env", "--default-signal=INT", str(BIN / "switchboard"), *arguments]
        self.process = subprocess.Popen(
            command,
            stdin=self._its,
            stdout=self._its,
            stderr=self._its,
            env={**os.environ, "TERM": "xterm"},
        )
        self._read = bytearray()

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._mine)
        os.close(self._its)

    def settings(self) -> list[Any]:
        """Those of termios(3)."""
        return termios.tcgetattr(self._its)

    def type(self, keys: str) -> None:
        """Presses keys."""
        os.write(self._mine, keys.encode())

    def shown(self) -> str:
        """All output so far, with its control sequences."""
        with suppress(BlockingIOError, OSError):
            while part := os.read(self._mine, 65536):
                self._read.extend(part)
        return self._read.decode(errors="replace")
