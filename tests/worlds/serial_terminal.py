"""A serial device of a test, on a pseudo terminal."""

from __future__ import annotations

import os
import select
import tty
from pathlib import Path

from tests.worlds.waiting import PATIENCE


class SerialTerminal:
    """A pseudo terminal whose other end is a device with a fixed name, which can be unplugged."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "ttyTEST"
        self.path.unlink(missing_ok=True)
        self.plug()

    def plug(self) -> None:
        self._received = b""
        self.own, self._other = os.openpty()
        tty.setraw(self._other)
        self.path.symlink_to(os.ttyname(self._other))

    def unplug(self) -> None:
        self.path.unlink()
        # With both ends closed, unplugging hangs up.
        os.close(self._other)
        os.close(self.own)

    def send(self, data: bytes) -> None:
        os.write(self.own, data)

    def reads(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            data += self._read(count - len(data), data)
        return data

    def waiting(self) -> bytes:
        """What has come."""
        return os.read(self.own, 1000) if select.select([self.own], [], [], 0)[0] else b""

    def until(self, text: bytes) -> None:
        """Reads until this has come."""
        while text not in self._received:
            self._received += self._read(1000, self._received)
        self._received = b""

    def _read(self, most: int, before: bytes) -> bytes:
        assert select.select([self.own], [], [], PATIENCE)[0], f"only {before!r} came"
        return os.read(self.own, most)
