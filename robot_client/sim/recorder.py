"""The simulated body's own record of what it was told and what it did, one JSON line each."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import IO

import orjson


class MotionRecorder:
    """Writes events with a monotonic time, each flushed at once: the process may be killed at any moment.

    :param stream: open for writing bytes, or None to record nothing
    :param clock: nanoseconds, monotonic, shared by all processes of the machine
    """

    def __init__(self, stream: IO[bytes] | None, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._stream = stream
        self._clock = clock
        self._moving = False
        self._touching = False

    def command(self, speed: float, turn: float) -> None:
        """A velocity command arrived, in m/s and rad/s; what is no number is written as null."""
        self._write({"event": "command", "v": _finite(speed), "w": _finite(turn)})

    def motion(self, moving: bool) -> None:
        """Tell after every step whether the body moves; only changes are written."""
        if moving is not self._moving:
            self._moving = moving
            self._write({"event": "moving" if moving else "standstill"})

    def touch(self, touching: bool) -> None:
        """Tell after every step whether the body touches a wall; only that it begins to is written."""
        if touching and not self._touching:
            self._write({"event": "bump"})
        self._touching = touching

    def reset(self) -> None:
        """The body was put back to its start."""
        self._write({"event": "reset"})

    def _write(self, event: dict[str, object]) -> None:
        if self._stream is not None:
            self._stream.write(orjson.dumps({"t": self._clock(), **event}) + b"\n")
            self._stream.flush()


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
