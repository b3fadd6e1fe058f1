"""The output of a module, cut into lines, and bounded when the module writes too much. The standard library alone."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from robot_client.modules.log_ring import LINE_BYTES

OUTPUT_RATE = 1024 * 1024
OUTPUT_BURST = 4 * 1024 * 1024
"""Bytes a second, and at once, of one stream of a module that are kept; more is counted and dropped."""

LINE_COST = 48
"""So many bytes more count for each line, since each takes time of its own: at most about 20,000 lines a second."""

REPORT_SECONDS = 1.0
"""Time between two lines that say how much was dropped."""

FLOOD_ALERT_SECONDS = 10.0
"""Output that is dropped for so long is an alert."""

LOSS_OVER_SECONDS = 2.0
"""The alert is over when so long no line was lost."""


class ModuleOutput:
    """One stream of the module.

    :param stream: ``out`` or ``err``
    :param emit: receives the stream and the text of each line
    :param note: receives the level and the text of a remark about the output
    :param later: calls a function after some seconds
    :param on_drop: called when bytes are dropped
    """

    def __init__(
        self,
        stream: str,
        emit: Callable[[str, str], None],
        note: Callable[[str, str], None],
        later: Callable[[float, Callable[[], None]], None],
        on_drop: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._stream = stream
        self._emit = emit
        self._note = note
        self._later = later
        self._on_drop = on_drop
        self._clock = clock
        self._unfinished = b""
        self._budget = float(OUTPUT_BURST)
        self._at = clock()
        self._dropped = 0

    def received(self, data: bytes) -> bool:
        """Take what the module has written.

        :returns: whether it is kept; if not, it was dropped because of the rate
        """
        now = self._clock()
        self._budget = min(OUTPUT_BURST, self._budget + (now - self._at) * OUTPUT_RATE)
        self._at = now
        cost = len(data) + LINE_COST * data.count(b"\n")
        if self._budget < cost:
            self.drop(len(data))
            return False
        self._budget -= cost
        *lines, unfinished = (self._unfinished + data).split(b"\n")
        for line in lines:
            self._emit(self._stream, line[:LINE_BYTES].decode(errors="replace"))
        self._unfinished = unfinished[-LINE_BYTES:]
        return True

    def drop(self, count: int) -> None:
        """Count bytes that are dropped; the log says it once a second at most."""
        if not self._dropped:
            self._later(REPORT_SECONDS, self._report_dropped)
        self._dropped += count
        self._unfinished = b""
        self._on_drop()

    def ended(self) -> None:
        """The stream was closed."""
        self._report_dropped()
        if self._unfinished:
            self._emit(self._stream, self._unfinished.decode(errors="replace"))
            self._unfinished = b""

    def _report_dropped(self) -> None:
        if self._dropped:
            limit = f"more than {OUTPUT_RATE} bytes a second to one stream"
            self._note("error", f"{self._dropped} bytes of output were dropped: {limit}")
            self._dropped = 0


class OutputLoss:
    """Why output of the module is being lost, for an alert.

    :ivar reason: in words; empty if nothing is being lost
    """

    def __init__(self) -> None:
        self.reason = ""
        self._disk = ""
        self._disk_at = -math.inf
        self._flood_began = 0.0
        self._flood_at = -math.inf

    def not_written(self, now: float, reason: str) -> None:
        """A line could not be written into the log.

        :param now: monotonic seconds, also below
        """
        self._disk, self._disk_at = reason, now

    def dropped(self, now: float) -> None:
        """Output was dropped because of its rate."""
        if now - self._flood_at > LOSS_OVER_SECONDS:
            self._flood_began = now
        self._flood_at = now

    def update(self, now: float) -> bool:
        """Set the reason by what was lost until now.

        :returns: whether to call it again in a second: something was lost recently
        """
        disk = now - self._disk_at < LOSS_OVER_SECONDS
        flood = now - self._flood_at < LOSS_OVER_SECONDS
        if disk:
            self.reason = f"without its log, into which lines can't be written: {self._disk}"
        elif flood and self._flood_at - self._flood_began >= FLOOD_ALERT_SECONDS:
            self.reason = "without part of its log: it writes more than 1 MiB a second to one of its streams"
        else:
            self.reason = ""
        return disk or flood
