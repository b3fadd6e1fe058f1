"""The clock for the age of commands, at both ends: it is never adjusted and runs while the machine is suspended."""

from __future__ import annotations

import time


def now_ns() -> int:
    """Time since the machine started, nanoseconds; including suspends where the system supports it.

    Linux stops CLOCK_MONOTONIC during a suspend (clock_gettime(2)); a command that waited in
    a socket during it would not age.
    """
    if hasattr(time, "CLOCK_BOOTTIME"):
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    return time.monotonic_ns()


def now() -> float:
    """As :func:`now_ns`, in seconds."""
    return now_ns() / 1e9
