"""The relay's log: one line an event on standard error, as text or JSON, inert whatever robots and clients sent."""

from __future__ import annotations

import json
import sys
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from datetime import UTC, datetime
from threading import RLock
from typing import Any, TextIO, cast

from twisted.logger import ILogObserver, LogEvent, LogLevel, formatEvent, globalLogBeginner

from relay_protocol.text import inert

_QUIET = (
    "autobahn",
    "txaio",
    "twisted.web",
    "twisted.internet",
    "twisted.python",
    "log_legacy",
)


WINDOW = 60.0
"""Seconds over which lines are counted."""

LINES = 30
"""Most lines of one kind in :data:`WINDOW` that others can cause: refusals, tracebacks, warnings of libraries."""

MOST_LINES = 1000
"""The same of all other kinds."""

LONGEST = 2000
"""Characters of one line."""

Later = Callable[[float, Callable[[], None]], None]
"""Calls something after so many seconds."""


def begin(as_json: bool, debug: bool = False, out: TextIO = sys.stderr, later: Later | None = None) -> None:
    """Send all logging to ``out``; warnings of Python and stray prints are left alone.

    An event whose ``limited`` names a kind is one that a stranger can cause as often as they like. Lines over
    the limit of their kind are counted, and one line says how many there were.

    :param later: writes that line when the window ends; without it the next event after that does
    """
    write = _Writer(out, as_json, debug, later)
    globalLogBeginner.beginLoggingTo(
        [cast(ILogObserver, write)], redirectStandardIO=False, discardBuffer=True
    )


def later(seconds: float, work: Callable[[], None]) -> None:
    """Call something by the reactor that runs in this process; from any thread."""
    from twisted.internet import reactor

    running: Any = reactor
    running.callFromThread(running.callLater, seconds, work)


@dataclass
class _LineKind:
    """Lines of one kind in one window.

    :param began: seconds
    """

    began: float
    level: str
    namespace: str
    first: str
    written: int = 0
    left_out: int = 0


class _Writer:
    """An observer that writes lines. Events come from several threads."""

    def __init__(self, out: TextIO, as_json: bool, debug: bool, later: Later | None) -> None:
        self._out = out
        self._as_json = as_json
        self._debug = debug
        self._later = later
        self._kinds: OrderedDict[Hashable, _LineKind] = OrderedDict()
        # Garbage collection may log in the middle of it.
        self._lock = RLock()

    def __call__(self, event: LogEvent) -> None:
        level = event.get("log_level", LogLevel.info)
        namespace = str(event.get("log_namespace", ""))
        least = LogLevel.debug if self._debug else LogLevel.info
        library = namespace.startswith(_QUIET)
        if level < (LogLevel.warn if library and not self._debug else least):
            return
        now = event.get("log_time", 0.0)
        text = formatEvent(event)
        failure = event.get("log_failure")
        if failure is not None:
            text += f": {failure.getErrorMessage()}"
        text = text[:LONGEST]
        limited = event.get("limited")
        kind: Hashable
        if limited is not None or (library and level >= LogLevel.warn):
            kind, most = (namespace, limited), LINES
        elif failure is not None:
            kind, most = (namespace, event.get("log_format"), failure.type), LINES
        else:
            kind, most = (namespace, event.get("log_format")), MOST_LINES
        with self._lock:
            self._close_windows(now)
            counted = self._kinds.get(kind)
            if counted is None:
                counted = self._kinds[kind] = _LineKind(now, level.name, namespace, text)
            if counted.written < most:
                counted.written += 1
                if failure is not None and level >= LogLevel.critical:
                    text += "\n" + failure.getTraceback()
                self._write(now, level.name, namespace, text)
                return
            counted.left_out += 1
            first_left_out = counted.left_out == 1
        if first_left_out and self._later is not None:
            self._later(counted.began + WINDOW - now + 1, self._flush)

    def _flush(self) -> None:
        with self._lock:
            self._close_windows(time.time())

    def _close_windows(self, now: float) -> None:
        """Say what was left out in windows that are over. They are in the order in which they began."""
        while self._kinds:
            kind, counted = next(iter(self._kinds.items()))
            if 0 <= now - counted.began < WINDOW:
                return
            self._kinds.pop(kind, None)
            if counted.left_out:
                words = f"{counted.left_out} more lines like this one were left out in {WINDOW:g} s"
                self._write(now, counted.level, counted.namespace, f"{words}: {counted.first}")

    def _write(self, now: float, level: str, namespace: str, text: str) -> None:
        self._out.write(_line(now, level, namespace, text, self._as_json))
        self._out.flush()


def _line(now: float, level: str, namespace: str, text: str, as_json: bool) -> str:
    when = datetime.fromtimestamp(now, UTC)
    stamp = when.isoformat(timespec="milliseconds").replace("+00:00", "Z")
    if as_json:
        entry = {"time": stamp, "level": level, "logger": namespace, "message": text}
        # Pure ASCII: whatever shows the log, nothing in it drives a terminal.
        return json.dumps(entry).replace("\x7f", "\\u007f") + "\n"
    # Our own tracebacks have lines; nobody else's text can make one up.
    lines = "\n    ".join(inert(each, LONGEST) for each in text.split("\n"))
    return f"{stamp} {level:<8} {lines}\n"
