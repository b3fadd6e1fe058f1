"""Stalls of the machine that runs tests, to be subtracted from measured times."""

from __future__ import annotations

import threading
import time
from types import TracebackType

BEAT = 0.02
"""Seconds between two beats."""

NOTICED = 0.1
"""Seconds by which a beat is late that says something about the machine."""


class Pulse(threading.Thread):
    """Beats in a thread of its own, and sums up the delays of its beats."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._end = threading.Event()
        self._last = time.monotonic()
        self._lost = 0.0

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

    def stop(self) -> None:
        self._end.set()
        self.join(10)

    def _late(self) -> float:
        late = time.monotonic() - self._last - BEAT
        return late if late > NOTICED else 0.0
