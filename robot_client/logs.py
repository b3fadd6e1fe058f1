"""Logs on stderr: one line for each event, plain or JSON."""

from __future__ import annotations

import sys
import traceback
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

from relay_protocol.text import inert

LONGEST = 2000
"""Characters of one log line."""


@implementer(ILogObserver)
class LineObserver:
    """Writes events as lines.

    :param as_json: an object per line instead of text
    """

    def __init__(self, out: TextIO, as_json: bool) -> None:
        self._out = out
        self._as_json = as_json

    def __call__(self, event: LogEvent) -> None:
        """Write one event."""
        line = self._json(event) if self._as_json else self._plain(event)
        try:
            self._out.write(line + "\n")
            self._out.flush()
        except (OSError, ValueError):
            return  # nobody reads the log any more; the robot goes on

    def _plain(self, event: LogEvent) -> str:
        when = _time(event).isoformat(timespec="milliseconds")
        return f"{when} {_level(event):8} {event.get('log_namespace', '-')}: {text(event)}"

    def _json(self, event: LogEvent) -> str:
        entry = {
            "time": _time(event).isoformat(),
            "level": _level(event),
            "where": event.get("log_namespace", "-"),
            "text": text(event),
        }
        return msgspec.json.encode(entry).decode()


def begin(as_json: bool) -> None:
    """Send all logs of this process to stderr."""
    quiet: Any = LogLevelFilterPredicate(defaultLogLevel=LogLevel.info)
    for chatter in ("twisted.internet", "twisted.protocols", "stdout"):
        quiet.setLogLevelForNamespace(chatter, LogLevel.warn)
    lines: Any = LineObserver(sys.stderr, as_json)
    observer: Any = FilteringLogObserver(lines, [quiet])
    globalLogBeginner.beginLoggingTo([observer], redirectStandardIO=False)


def _time(event: LogEvent) -> datetime:
    return datetime.fromtimestamp(event.get("log_time", 0.0), timezone.utc)


def _level(event: LogEvent) -> str:
    level: Any = event.get("log_level")
    return level.name if level else "info"


def text(event: LogEvent) -> str:
    text = formatEvent(event)
    failure = event.get("log_failure")
    if failure is not None:
        # The traceback belongs to our own code; on one line, like everything else.
        where = traceback.extract_tb(failure.getTracebackObject())
        steps = " < ".join(f"{each.filename.rpartition('/')[2]}:{each.lineno}" for each in reversed(where))
        text += f": {failure.type.__name__}: {failure.getErrorMessage()} [{steps}]"
    return inert(text, LONGEST)
