"""One line that says how things stand: written over on a terminal, a line for each change elsewhere."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from typing import TextIO

EVERY = 0.2
"""Seconds from one writing to the next of what changes all the time."""


class StatusLine:
    """Writes how things stand.

    :param out: where
    :param clock: monotonic seconds
    """

    def __init__(self, out: TextIO, clock: Callable[[], float]) -> None:
        self._out = out
        self._clock = clock
        self._terminal = out.isatty()
        self._state = ""
        self._written = -math.inf

    def tell(self, state: str, details: str = "") -> None:
        """How things stand.

        :param state: written whenever it is another
        :param details: what changes all the time: written on terminals, now and then
        """
        now = self._clock()
        if state == self._state and not (self._terminal and now - self._written >= EVERY):
            return
        self._state, self._written = state, now
        if self._terminal:
            text = f"{state}  {details}"[: shutil.get_terminal_size().columns - 1]
            self._out.write(f"\r\x1b[K{text}")
        else:
            self._out.write(state + "\n")
        self._out.flush()

    def end(self, word: str) -> None:
        """The last one."""
        self.tell(word)
        if self._terminal:
            self._out.write("\n")
            self._out.flush()
