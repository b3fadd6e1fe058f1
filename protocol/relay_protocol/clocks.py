"""The clock by which commands grow old, at both ends: it is never set, and goes on while the machine is suspended."""

from __future__ import annotations

import time


def now_ns() -> int:
    """Time since the machine started, suspends included where the system can tell, nanoseconds.

    Linux stops CLOCK_MONOTONIC during a suspend (clock_gettime(2)); what waited in a socket meanwhile would wake
    as young as it fell asleep.
    """
    if hasattr(time, "CLOCK_BOOTTIME"):
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    return time.monotonic_ns()
