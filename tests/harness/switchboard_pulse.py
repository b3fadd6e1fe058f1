"""How long the machine that runs tests stood still meanwhile: who judges others by the clock takes that off."""

from __future__ import annotations

import threading
import time
from types import TracebackType

BEAT = 0.02
"""Seconds between two beats."""

NOTICED = 0.1
"""Seconds by which a beat is late that says something about the machine."""


class Pulse(threading.Thread):
    """Beats in a thread of its own, and sums up by how much its beats came late."""

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
        """Beat until stopped."""
        while not self._end.wait(BEAT):
            late, self._last = self._late(), time.monotonic()
            self._lost += late

    def lost(self) -> float:
        """Seconds the machine has stood still so far; also when it has only just gone on."""
        return self._lost + self._late()

    def stop(self) -> None:
        """Beat no more."""
        self._end.set()
        self.join(10)

    def _late(self) -> float:
        late = time.monotonic() - self._last - BEAT
        return late if late > NOTICED else 0.0
