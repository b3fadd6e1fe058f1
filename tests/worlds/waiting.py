"""Waiting for events."""

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
    """Polls until ``condition`` returns something true, and returns it; fails with its name otherwise."""
    until = time.monotonic() + seconds
    while True:
        found = condition()
        if found:
            return found
        if time.monotonic() > until:
            raise AssertionError(f"not within {seconds:g} s: {what}")
        time.sleep(0.02)


async def eventually(what: str, condition: Callable[[], Any], seconds: float = PATIENCE) -> Any:
    """The same as :func:`wait_for`, for tests on the reactor."""
    from twisted.internet import reactor, task  # not imported by programs that wait without a reactor

    until = time.monotonic() + seconds
    while not (found := condition()):
        if time.monotonic() > until:
            raise AssertionError(f"not within {seconds:g} s: {what}")
        await task.deferLater(reactor, 0.02)
    return found


def readable(connection: socket.socket, seconds: float) -> bool:
    """Whether bytes (or the end) can be read within this time."""
    with selectors.DefaultSelector() as selector:
        selector.register(connection, selectors.EVENT_READ)
        return bool(selector.select(seconds))


def freeze(pid: int) -> None:
    """Stops a process by SIGSTOP, and waits until all of its threads are stopped.

    The kernel delivers the signal to one of its threads; until that one has a CPU, the others continue.
    """
    os.kill(pid, signal.SIGSTOP)
    wait_for(f"process {pid} stands still", lambda: all(state == "T" for state in thread_states(pid)))


def thread_states(pid: int) -> list[str]:
    """The state of each thread of a process, by its letter in ``stat`` (proc(5)): after the name, which may
    contain anything.
    """
    states = []
    for stat in Path(f"/proc/{pid}/task").glob("*/stat"):
        with suppress(OSError):  # a thread that has ended meanwhile
            states.append(stat.read_text().rpartition(")")[2].split()[0])
    return states
