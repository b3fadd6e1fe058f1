"""What kind of machine this is: how much dearer the first work after a rest is than the same work in a loop.

Figures at low rates (a scan at 40 Hz, a message every few milliseconds) are all such first work. On most machines it
costs up to twice as much; on one whose memory is taken back while it idles, thirty times.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path

REST = 0.05
"""Seconds of doing nothing: about the time between two samples of a laser."""

_TURNS = 15
_SOURCE = Path(__file__).read_text("utf-8")


def _work() -> None:
    compile(_SOURCE, __file__, "exec")


def _milliseconds() -> float:
    begun = time.thread_time_ns()
    _work()
    return (time.thread_time_ns() - begun) / 1e6


def rest_costs() -> float:
    """Processor time of a piece of work after a rest, as a multiple of the same work without one; medians."""
    warm = statistics.median(_milliseconds() for _ in range(_TURNS))
    rested = []
    for _ in range(_TURNS):
        time.sleep(REST)  # what is measured: work that follows a rest
        rested.append(_milliseconds())
    return statistics.median(rested) / warm
