"""Limit of log lines of one kind: the log must not grow as fast as clients, devices or libraries cause events.

Lines over the limit are counted. One line reports how many there were.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from threading import RLock
from typing import Any, NamedTuple

WINDOW = 60.0
"""Seconds over which lines are counted."""

LINES = 30
"""Most lines per :data:`WINDOW` of one kind that others can cause: refusals, tracebacks, warnings of libraries."""

MOST_LINES = 1000
"""The same for all other kinds."""

Later = Callable[[float, Callable[[], None]], None]
"""Calls a function after a number of seconds."""


class LogLine(NamedTuple):
    """A line of a log.

    :param time: seconds since 1970
    :param level: its name
    :param namespace: of the logger
    :param details: what follows the text, such as a traceback; a line that counts others has none
    """

    time: float
    level: str
    namespace: str
    text: str
    details: str = ""


class LineKind(NamedTuple):
    """What lines are counted together, and how many of them are written.

    :param most: lines per :data:`WINDOW`
    """

    key: Hashable
    most: int


def kind_of(event: Mapping[str, Any], of_library: bool) -> LineKind:
    """The kind of a log event of Twisted.

    An event with a field ``limited`` names a kind of event that any client or device can cause at will.

    :param of_library: whether it is a warning of a library, whose texts differ without limit
    """
    namespace, limited, failure = (
        event.get("log_namespace", ""),
        event.get("limited"),
        event.get("log_failure"),
    )
    if limited is not None or of_library:
        return LineKind((namespace, limited), LINES)
    if failure is not None:
        return LineKind((namespace, event.get("log_format"), failure.type), LINES)
    return LineKind((namespace, event.get("log_format")), MOST_LINES)


@dataclass
class _Window:
    """Lines of one kind in one window.

    :param first: line of the window
    """

    first: LogLine
    written: int = 0
    left_out: int = 0


class LogLimiter:
    """Writes the first lines of each kind in each window. Lines come from several threads.

    :param write: writes a line
    :param later: schedules the count for the end of the window; without it the next line after that writes it
    """

    def __init__(self, write: Callable[[LogLine], None], later: Later | None = None) -> None:
        self._write = write
        self._later = later
        self._windows: OrderedDict[Hashable, _Window] = OrderedDict()
        # Garbage collection may log in the middle of it.
        self._lock = RLock()

    def add(self, line: LogLine, kind: LineKind) -> None:
        """Write a line, or count it."""
        with self._lock:
            self._close_windows(line.time)
            window = self._windows.get(kind.key)
            if window is None:
                window = self._windows[kind.key] = _Window(line)
            if window.written < kind.most:
                window.written += 1
                self._write(line)
                return
            window.left_out += 1
            first_left_out = window.left_out == 1
        if first_left_out and self._later is not None:
            self._later(window.first.time + WINDOW - line.time + 1, self._flush)

    def _flush(self) -> None:
        with self._lock:
            self._close_windows(time.time())

    def _close_windows(self, now: float) -> None:
        """Report the number of lines left out in windows that are over. They are sorted by their beginning."""
        while self._windows:
            key, window = next(iter(self._windows.items()))
            first = window.first
            if 0 <= now - first.time < WINDOW:
                return
            self._windows.pop(key, None)
            if window.left_out:
                words = f"{window.left_out} more lines like this one were left out in {WINDOW:g} s"
                self._write(LogLine(now, first.level, first.namespace, f"{words}: {first.text}"))
