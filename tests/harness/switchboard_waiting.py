"""Waiting for what comes by itself."""

from __future__ import annotations

import os
import selectors
import signal
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

PATIENCE = 60.0
"""Seconds for what comes at once: a machine that runs tests may stand still for a while."""


def wait_for(what: str, condition: Callable[[], Any], seconds: float = PATIENCE) -> Any:
    """Poll until ``condition`` gives something true, and return it; fail by name when it does not."""
    until = time.monotonic() + seconds
    while True:
        found = condition()
        if found:
            return found
        if time.monotonic() > until:
            raise AssertionError(f"not within {seconds:g} s: {what}")
        time.sleep(0.02)


def readable(connection: socket.socket, seconds: float) -> bool:
    """Whether bytes (or the end) can be read within this time."""
    with selectors.DefaultSelector() as selector:
        selector.register(connection, selectors.EVENT_READ)
        return bool(selector.select(seconds))


def freeze(pid: int) -> None:
    """Stop a process by SIGSTOP, and wait until all of it stands still.

    The kernel hands the signal to one of its threads; until that one has a processor, the others go on.
    """
    os.kill(pid, signal.SIGSTOP)
    wait_for(f"process {pid} stands still", lambda: all(state == "T" for state in _states(pid)))


def _states(pid: int) -> list[str]:
    """How each thread of a process is, by its letter in ``stat`` (proc(5)): after the name, which may hold anything."""
    states = []
    for stat in Path(f"/proc/{pid}/task").glob("*/stat"):
        with suppress(OSError):  # a thread that has ended meanwhile
            states.append(stat.read_text().rpartition(")")[2].split()[0])
    return states
