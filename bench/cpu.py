"""Processor time of other processes, to the nanosecond where the kernel tells it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import psutil


def _tasks_ns(pid: int) -> int | None:
    """Time on a processor of all threads of a process, ``None`` where the kernel keeps no such figure."""
    total = 0
    try:
        for task in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):
                total += int((task / "schedstat").read_text().split()[0])
    except (FileNotFoundError, IndexError):
        return None
    return total


def seconds_of(pid: int, *, children: bool = False) -> float:
    """Processor seconds a process has used so far: user and system, all threads.

    The scheduler's own count is exact; ``utime`` and ``stime`` of ``/proc/<pid>/stat`` come in steps of 10 ms.

    :param children: count its living descendants too
    """
    process = psutil.Process(pid)
    found = [process, *(process.children(recursive=True) if children else [])]
    total = 0.0
    for each in found:
        with contextlib.suppress(psutil.NoSuchProcess):
            tasks = _tasks_ns(each.pid)
            total += sum(each.cpu_times()[:2]) if not tasks else tasks / 1e9
    return total


class Stopwatch:
    """Processor seconds of some processes since it was started, filled in when the ``with`` block ends."""

    def __init__(self) -> None:
        self.seconds = 0.0


@contextlib.contextmanager
def measured(*pids: int, children: bool = False) -> Iterator[Stopwatch]:
    """Measure what processes use within a block."""
    watch = Stopwatch()
    before = sum(seconds_of(pid, children=children) for pid in pids)
    yield watch
    watch.seconds = sum(seconds_of(pid, children=children) for pid in pids) - before


def resident(pid: int) -> int:
    """Bytes of memory a process holds."""
    return int(psutil.Process(pid).memory_info().rss)
