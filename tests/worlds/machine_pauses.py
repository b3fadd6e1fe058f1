"""Stalls of the machine that runs tests, to be subtracted from measured times."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType

import psutil

BEAT = 0.02
"""Seconds between two beats."""

NOTICED = 0.1
"""Seconds by which a beat is late that says something about the machine."""


class Pulse(threading.Thread):
    """Beats in a thread of its own, and sums up the delays of its beats.

    It also knows how long the processes of the test have waited for a CPU.
    """

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._end = threading.Event()
        self._last = time.monotonic()
        self._lost = 0.0
        self._processes = {psutil.Process()}
        self._waits: dict[Path, int] = {}
        """Nanoseconds for which each thread has waited for a CPU; threads that have ended are kept."""
        self._waited_before = self._waited()

    def __enter__(self) -> Pulse:
        self._last = time.monotonic()
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def run(self) -> None:
        """Beats until stopped."""
        while not self._end.wait(BEAT):
            late, self._last = self._late(), time.monotonic()
            self._lost += late

    def lost(self) -> float:
        """Seconds of all stalls so far, including one that has just ended."""
        return self._lost + self._late()

    def held_up(self) -> float:
        """Seconds so far for which the machine may have held up this process and those that it started: all
        stalls, and all time in which one of their threads was ready to run and had no CPU (proc(5), schedstat).
        """
        return self.lost() + self._waited() - self._waited_before

    def _waited(self) -> float:
        # A process whose parent is gone is no descendant any more.
        self._processes.update(psutil.Process().children(recursive=True))
        for each in self._processes:
            for thread in Path(f"/proc/{each.pid}/task").glob("*/schedstat"):
                with suppress(OSError):  # it has ended
                    self._waits[thread] = max(self._waits.get(thread, 0), int(thread.read_text().split()[1]))
        return sum(self._waits.values()) / 1e9

    def stop(self) -> None:
        self._end.set()
        self.join(10)

    def _late(self) -> float:
        late = time.monotonic() - self._last - BEAT
        return late if late > NOTICED else 0.0
