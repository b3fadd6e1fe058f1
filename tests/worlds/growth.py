"""The cost of work in steps, and its growth with size: no slow machine changes either.

CPU times are compared with each other only, in one thread of one process.
"""

from __future__ import annotations

import gc
import math
import sys
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

QUARTER = 4
FASTER_THAN_SQUARE = 8
"""Four times the input costs 4 times as much if costs are linear, and 16 times if they are quadratic."""

ROUNDS = 12
"""Comparisons until one holds, so that a busy machine fails no test."""


def steps(work: Callable[[], object]) -> int:
    """The number of lines of Python that some work executes, without those of C code."""
    count = 0

    def trace(frame: FrameType, event: str, arg: Any) -> Any:
        nonlocal count
        count += event == "line"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(before)
    return count


def cpu_seconds(work: Callable[[], object]) -> float:
    """CPU time of this thread for some work."""
    began = time.thread_time()
    work()
    return time.thread_time() - began


def ratio_stays_below(
    limit: float,
    work: Callable[[], object],
    reference: Callable[[], object],
    seconds: Callable[[Callable[[], object]], float] = cpu_seconds,
) -> bool:
    """Whether some work costs less than ``limit`` times as much as other work; the minimum of several runs counts.

    :param seconds: measures one run
    """
    least, other = math.inf, math.inf
    collects = gc.isenabled()
    gc.disable()
    try:
        for _ in range(ROUNDS):
            other = min(other, seconds(reference), seconds(reference))
            least = min(least, seconds(work))
            if least < limit * other:
                return True
    finally:
        if collects:
            gc.enable()
    return False


def grows_linearly(work: Callable[[Any], object], make: Callable[[int], Any], size: int) -> bool:
    """Whether work grows with its input and no faster: it is compared with that of a quarter.

    :param make: the input of a size
    """
    quarter, whole = make(size // QUARTER), make(size)
    return ratio_stays_below(FASTER_THAN_SQUARE, lambda: work(whole), lambda: work(quarter))
