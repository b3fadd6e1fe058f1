"""Counts how often a Python process opens files of ``/proc/PID`` or lists ``/proc``: for the folder on ``PYTHONPATH``.

The count is in the file of its pid in the folder ``BENCH_PROC_READS``, 8 bytes.
"""

from __future__ import annotations

import itertools
import mmap
import os
import re
import struct
import sys

_OF_A_PROCESS = re.compile(r"/proc(/[0-9]+(/.*)?)?/?")


def _count(folder: str) -> None:
    descriptor = os.open(f"{folder}/{os.getpid()}", os.O_RDWR | os.O_CREAT, 0o600)
    os.ftruncate(descriptor, 8)
    count = mmap.mmap(descriptor, 8)
    os.close(descriptor)
    numbers = itertools.count(1)

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        if event in ("open", "os.scandir", "os.listdir"):
            path = arguments[0]
            if isinstance(path, str) and _OF_A_PROCESS.fullmatch(path):
                struct.pack_into("=Q", count, 0, next(numbers))

    sys.addaudithook(hook)


if folder := os.environ.get("BENCH_PROC_READS"):
    _count(folder)
