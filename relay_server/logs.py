"""The relay's log: one line per event on standard error, as text or JSON, with unprintable characters
escaped."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any, TextIO, cast

from twisted.logger import ILogObserver, LogEvent, LogLevel, formatEvent, globalLogBeginner

from relay_protocol.log_limit import Later, LogLimiter, LogLine, kind_of
from relay_protocol.text import escape_unprintable

_QUIET = (
    "autobahn",
    "txaio",
    "twisted.web",
    "twisted.internet",
    "twisted.python",
    "log_legacy",
)


LONGEST = 2000
"""Characters of one line."""


def begin(
    as_json: bool,
    debug: bool = False,
    out: TextIO = sys.stderr,
    later: Later | None = None,
    worker: int | None = None,
) -> None:
    """Send all logging to ``out``. Python's warnings and stray prints are left alone.

    An event with a field ``limited`` names a kind of event that any client can cause at will. Lines over the
    limit of their kind are counted, and one line reports how many there were.

    :param later: schedules that line for the end of the window; without it the next event after that writes
        it
    :param worker: number of this worker, which each line shows
    """
    write = _Writer(out, as_json, debug, later, worker)
    globalLogBeginner.beginLoggingTo(
        [cast(ILogObserver, write)], redirectStandardIO=False, discardBuffer=True
    )


def later(seconds: float, work: Callable[[], None]) -> None:
    """Call a function by the reactor of this process; may be used from any thread."""
    from twisted.internet import reactor

    running: Any = reactor
    running.callFromThread(running.callLater, seconds, work)


class _Writer:
    """Writes log lines. Events come from several threads."""

    def __init__(
        self, out: TextIO, as_json: bool, debug: bool, later: Later | None, worker: int | None
    ) -> None:
        self._out = out
        self._as_json = as_json
        self._debug = debug
        self._worker = worker
        self._limiter = LogLimiter(self._write, later)

    def __call__(self, event: LogEvent) -> None:
        level = event.get("log_level", LogLevel.info)
        namespace = str(event.get("log_namespace", ""))
        least = LogLevel.debug if self._debug else LogLevel.info
        library = namespace.startswith(_QUIET)
        if level < (LogLevel.warn if library and not self._debug else least):
            return
        text = formatEvent(event)
        failure = event.get("log_failure")
        details = ""
        if failure is not None:
            text += f": {failure.getErrorMessage()}"
            if level >= LogLevel.critical:
                details = "\n" + failure.getTraceback()
        line = LogLine(event.get("log_time", 0.0), level.name, namespace, text[:LONGEST], details)
        self._limiter.add(line, kind_of(event, library and level >= LogLevel.warn))

    def _write(self, line: LogLine) -> None:
        text = line.text + line.details
        self._out.write(_line(line.time, line.level, line.namespace, text, self._as_json, self._worker))
        self._out.flush()


def _line(now: float, level: str, namespace: str, text: str, as_json: bool, worker: int | None) -> str:
    when = datetime.fromtimestamp(now, UTC)
    stamp = when.isoformat(timespec="milliseconds").replace("+00:00", "Z")
    if as_json:
        entry: dict[str, object] = {"time": stamp, "level": level, "logger": namespace, "message": text}
        if worker is not None:
            entry["worker"] = worker
        # Pure ASCII, so that no text in the log can control a terminal.
        return json.dumps(entry).replace("\x7f", "\\u007f") + "\n"
    # Only tracebacks of this process have several lines; text from outside cannot fake one.
    lines = "\n    ".join(escape_unprintable(each, LONGEST) for each in text.split("\n"))
    sender = "" if worker is None else f"worker {worker}: "
    return f"{stamp} {level:<8} {sender}{lines}\n"
