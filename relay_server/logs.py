"""The relay's log: one line an event on standard error, as text or JSON, inert whatever robots and clients sent."""

from __future__ import annotations

import json
import sys
from datetime import UTC, datetime
from typing import TextIO, cast

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


def begin(as_json: bool, debug: bool = False, out: TextIO = sys.stderr) -> None:
    """Send all logging to ``out``; warnings of Python and stray prints are left alone."""
    least = LogLevel.debug if debug else LogLevel.info

    def observe(event: LogEvent) -> None:
        level = event.get("log_level", LogLevel.info)
        namespace = str(event.get("log_namespace", ""))
        floor = LogLevel.warn if namespace.startswith(_QUIET) and not debug else least
        if level < floor:
            return
        text = formatEvent(event)
        failure = event.get("log_failure")
        if failure is not None:
            text += f": {failure.getErrorMessage()}"
            if level >= LogLevel.critical:
                text += "\n" + failure.getTraceback()
        out.write(_line(event, level.name, namespace, text, as_json))
        out.flush()

    globalLogBeginner.beginLoggingTo(
        [cast(ILogObserver, observe)], redirectStandardIO=False, discardBuffer=True
    )


def _line(event: LogEvent, level: str, namespace: str, text: str, as_json: bool) -> str:
    when = datetime.fromtimestamp(event.get("log_time", 0.0), UTC)
    stamp = when.isoformat(timespec="milliseconds").replace("+00:00", "Z")
    if as_json:
        entry = {"time": stamp, "level": level, "logger": namespace, "message": text}
        # Pure ASCII: whatever shows the log, nothing in it drives a terminal.
        return json.dumps(entry).replace("\x7f", "\\u007f") + "\n"
    # Our own tracebacks have lines; nobody else's text can make one up.
    lines = "\n    ".join(inert(each) for each in text.split("\n"))
    return f"{stamp} {level:<8} {lines}\n"
