"""Functions that work and that fail; a file in the functions folder of a relay under test."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from relay_protocol.functions import function, progress


@function(repeatable=True)
def add(a: float, b: float = 1.0) -> float:
    """Add two numbers."""
    return a + b


@function(name="add", version=2, repeatable=True)
def add_and_say(a: float, b: float = 1.0) -> dict[str, Any]:
    """Add two numbers, in words."""
    return {"sum": a + b, "words": f"{a:g} + {b:g}"}


@function()
def size_of(data: bytes) -> int:
    """The size of something in bytes."""
    return len(data)


@function()
def double(cloud: np.ndarray) -> np.ndarray:
    """Twice an array."""
    return cloud * 2


@function()
def process_id() -> int:
    """The process id of the worker."""
    return os.getpid()


@function(seconds=1.0)
def loop_for_ever() -> None:
    """Never ends."""
    while True:
        pass


@function(seconds=30.0)
def sleep(duration: float, began: str = "") -> float:
    """Sleeps.

    :param began: file that gets one more byte at each start
    """
    note(began)
    time.sleep(duration)
    return duration


@function(name="repeat", repeatable=True)
def sleep_repeatable(duration: float, began: str) -> float:
    """Sleeps; it may be repeated."""
    return sleep(duration, began)


@function(memory_mib=64)
def eat_memory() -> int:
    """Allocates more than its limit."""
    eaten = []
    while True:
        eaten.append(bytearray(16 * 1024 * 1024))


@function()
def crash(began: str = "") -> None:
    """End the process."""
    note(began)
    os.kill(os.getpid(), signal.SIGKILL)


@function(repeatable=True)
def crash_once(began: str) -> str:
    """Ends the process at the first attempt."""
    if note(began) == 1:
        os._exit(7)
    return "done"


@function()
def fail(words: str) -> None:
    """Raise."""
    raise RuntimeError(words)


@function()
def wrong_result() -> int:
    """Returns another type than declared."""
    return "text"  # type: ignore[return-value]


@function()
def unsendable() -> Any:
    """Returns an object."""
    return object()


@function()
def large_result(size: int) -> bytes:
    """Returns this many bytes."""
    return bytes(size)


_kept: list[Any] = []


@function()
def keep(mib: int, thread: bool = False) -> list[int]:
    """Keeps memory, or a thread; returns how much is kept in this process, MiB, and the process."""
    _kept.append(bytes(mib << 20))
    if thread:
        threading.Thread(target=time.sleep, args=(600,), daemon=True).start()
    return [sum(map(len, _kept)) >> 20, os.getpid()]


@function(seconds=30.0)
def report(steps: int, go_on: str) -> int:
    """Reports half, then waits for a file."""
    progress(0.5, "half")
    while not Path(go_on).exists():
        time.sleep(0.01)
    return steps


@function(seconds=30.0)
def leave_child(number: str, session: bool = True, forever: bool = False) -> int:
    """Starts a process that goes on, and writes down the number of its child's.

    :param number: path of a file
    :param session: whether it has a session of its own
    """
    pending = f"{number}.pending"
    script = f"sleep 600 & echo $! > '{pending}'; mv '{pending}' '{number}'; wait"
    subprocess.Popen(["sh", "-c", script], start_new_session=session)
    while not Path(number).exists():
        time.sleep(0.01)
    while forever:
        time.sleep(0.01)
    return int(Path(number).read_text())


@function(labels={"GPU": 1.0})
def on_gpu() -> int:
    """Needs a label."""
    return os.getpid()


def note(path: str) -> int:
    """Adds a byte to a file; returns its size."""
    if not path:
        return 0
    with Path(path).open("ab") as file:
        file.write(b"x")
    return Path(path).stat().st_size
