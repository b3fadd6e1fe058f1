"""Logs on standard error: one line for each event, plain or JSON."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable
from datetime import datetime, timezone
from typing import Any, TextIO

import msgspec
from twisted.logger import (
    FilteringLogObserver,
    ILogObserver,
    LogEvent,
    LogLevel,
    LogLevelFilterPredicate,
    formatEvent,
    globalLogBeginner,
)
from zope.interface import implementer

from relay_protocol.log_limit import Later, LogLimiter, LogLine, kind_of
from relay_protocol.text import escape_unprintable

MAX_LINE = 2000
"""Characters of the text of a log line."""

LIBRARIES = ("twisted.internet", "twisted.protocols", "log_legacy", "stdout")
"""Loggers of which only warnings are written."""


@implementer(ILogObserver)
class LineObserver:
    """Writes events as lines. Lines of one kind are limited as :mod:`relay_protocol.log_limit` says.

    :param as_json: whether to write JSON objects instead of text
    :param later: see :class:`relay_protocol.log_limit.LogLimiter`
    """

    def __init__(self, out: TextIO, as_json: bool, later: Later | None = None) -> None:
        self._out = out
        self._as_json = as_json
        self._limiter = LogLimiter(self._write, later)

    def __call__(self, event: LogEvent) -> None:
        level: Any = event.get("log_level")
        namespace = event.get("log_namespace", "-")
        line = LogLine(event.get("log_time", 0.0), level.name if level else "info", namespace, text(event))
        self._limiter.add(line, kind_of(event, namespace.startswith(LIBRARIES)))

    def _write(self, line: LogLine) -> None:
        try:
            self._out.write((_json(line) if self._as_json else _plain(line)) + "\n")
            self._out.flush()
        except (OSError, ValueError):
            return  # a closed log must not stop the robot


def later(seconds: float, work: Callable[[], None]) -> None:
    """Call a function by the reactor of this process; may be used from any thread."""
    from twisted.internet import reactor

    running: Any = reactor
    running.callFromThread(running.callLater, seconds, work)


def begin(as_json: bool, later: Later | None = None) -> None:
    """Send all logs of this process to standard error.

    :param later: see :class:`relay_protocol.log_limit.LogLimiter`
    """
    quiet: Any = LogLevelFilterPredicate(defaultLogLevel=LogLevel.info)
    for verbose in LIBRARIES:
        quiet.setLogLevelForNamespace(verbose, LogLevel.warn)
    lines: Any = LineObserver(sys.stderr, as_json, later)
    observer: Any = FilteringLogObserver(lines, [quiet])
    globalLogBeginner.beginLoggingTo([observer], redirectStandardIO=False)


def _time(line: LogLine) -> datetime:
    return datetime.fromtimestamp(line.time, timezone.utc)


def _plain(line: LogLine) -> str:
    when = _time(line).isoformat(timespec="milliseconds")
    return f"{when} {line.level:8} {line.namespace}: {line.text}"


def _json(line: LogLine) -> str:
    entry = {
        "time": _time(line).isoformat(),
        "level": line.level,
        "where": line.namespace,
        "text": line.text,
    }
    return msgspec.json.encode(entry).decode()


def text(event: LogEvent) -> str:
    """Text of an event on one line, with the traceback of its failure."""
    line = formatEvent(event)
    failure = event.get("log_failure")
    if failure is not None:
        # With the traceback, on the same line.
        where = traceback.extract_tb(failure.getTracebackObject())
        locations = " < ".join(
            f"{each.filename.rpartition('/')[2]}:{each.lineno}" for each in reversed(where)
        )
        line += f": {failure.type.__name__}: {failure.getErrorMessage()} [{locations}]"
    return escape_unprintable(line, MAX_LINE)
