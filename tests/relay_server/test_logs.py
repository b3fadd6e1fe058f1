"""The relay's log: one line per event, with unprintable characters escaped."""

from __future__ import annotations

import json
from typing import Any

import pytest
from twisted.logger import LogLevel
from twisted.python.failure import Failure

from relay_server import logs

HOSTILE = "\x1b[2Jrover\u202e\u009b31m\x7f\u2028\r\ud800\x00"


class Log:
    """The observer given to Twisted, and its output."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, as_json: bool, debug: bool = False, later: Any = None
    ) -> None:
        self.text = ""
        observers: list[Any] = []
        monkeypatch.setattr(
            logs.globalLogBeginner, "beginLoggingTo", lambda given, **more: observers.extend(given)
        )
        logs.begin(as_json, debug, out=self, later=later)  # type: ignore[arg-type]
        self._observe = observers[0]

    def write(self, text: str) -> None:
        self.text += text

    def flush(self) -> None:
        """Needed by the observer."""

    def event(self, words: str, level: LogLevel = LogLevel.info, **more: Any) -> str:
        """Logs an event; returns the written text."""
        self.text = ""
        self._observe(
            {
                "log_format": "{words}",
                "words": words,
                "log_level": level,
                "log_time": 0.5,
                "log_namespace": "relay_server.session",
                **more,
            }
        )
        return self.text


def test_a_line_has_time_level_and_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """The time is UTC, in milliseconds."""
    assert Log(monkeypatch, False).event("hello") == "1970-01-01T00:00:00.500Z info     hello\n"


def test_control_characters_are_spelled_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Escape sequences, bidirectional marks, C1 characters and surrogates cannot control a terminal."""
    line = Log(monkeypatch, False).event(HOSTILE)
    assert line.removesuffix("\n").isprintable()
    assert "\\x1b[2Jrover\\u202e\\x9b31m\\x7f\\u2028\\r\\ud800\\x00" in line


def test_log_lines_cannot_be_forged(monkeypatch: pytest.MonkeyPatch) -> None:
    """A line break in received text is indented, so it begins no new entry."""
    lines = Log(monkeypatch, False).event("x\n1970-01-01T00:00:00.500Z critical forged").splitlines()
    assert lines[1].startswith("    1970")
    assert "\n" not in Log(monkeypatch, True).event("x\nforged").removesuffix("\n")


def test_json_lines_are_pure_ascii(monkeypatch: pytest.MonkeyPatch) -> None:
    """One object per line, safe on a terminal."""
    line = Log(monkeypatch, True).event(HOSTILE)
    assert line.isascii()
    assert line.removesuffix("\n").isprintable()
    assert json.loads(line) == {
        "time": "1970-01-01T00:00:00.500Z",
        "level": "info",
        "logger": "relay_server.session",
        "message": HOSTILE,
    }


def test_libraries_log_only_warnings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Debugging shows all levels."""
    log = Log(monkeypatch, False)
    assert log.event("chatter", log_namespace="autobahn.websocket") == ""
    assert "careful" in log.event("careful", LogLevel.warn, log_namespace="autobahn.websocket")
    assert log.event("detail", LogLevel.debug) == ""
    debugging = Log(monkeypatch, False, debug=True)
    assert "detail" in debugging.event("detail", LogLevel.debug)


def test_a_failure_shows_its_words_and_only_a_crash_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tracebacks are for unexpected errors."""
    log = Log(monkeypatch, False)
    failure = Failure(ValueError("no good"))
    assert log.event("it failed", LogLevel.error, log_failure=failure).endswith("it failed: no good\n")
    assert "ValueError" in log.event("it failed", LogLevel.critical, log_failure=failure)


def test_lines_about_unauthenticated_clients_are_limited_and_the_rest_is_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """30 per minute of one kind; others are not affected, and one line has the number of omitted ones."""
    log = Log(monkeypatch, False)
    lines = [log.event(f"refused {number}", limited="401") for number in range(50)]
    assert [bool(each) for each in lines] == [True] * 30 + [False] * 20
    assert log.event("refused otherwise", limited="403")
    reported, own = log.event("hello", log_time=60.5).splitlines()
    assert reported.endswith("20 more lines like this one were left out in 60 s: refused 0")
    assert own.endswith("hello")
    assert log.event("refused again", limited="401", log_time=61.0)


@pytest.mark.parametrize("namespace", ["autobahn.twisted.websocket", "twisted.internet.tcp"])
def test_warnings_of_libraries_are_few(monkeypatch: pytest.MonkeyPatch, namespace: str) -> None:
    """For any number of different ones."""
    log = Log(monkeypatch, False)
    lines = [
        log.event("", LogLevel.warn, log_format=f"peer {number}", log_namespace=namespace)
        for number in range(50)
    ]
    assert sum(map(bool, lines)) == 30


def test_tracebacks_are_few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Per kind of error."""
    log = Log(monkeypatch, False)

    def failed(error: Exception) -> str:
        return log.event("it failed", LogLevel.critical, log_failure=Failure(error))

    assert sum(bool(failed(ValueError(str(number)))) for number in range(50)) == 30
    assert failed(KeyError("x"))


def test_the_count_is_written_when_the_window_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even if nothing else is logged."""
    waiting: list[tuple[float, Any]] = []
    log = Log(monkeypatch, False, later=lambda seconds, work: waiting.append((seconds, work)))
    for _ in range(50):
        log.event("refused", limited="401")
    [(seconds, work)] = waiting
    assert seconds == 61
    work()
    assert "20 more lines" in log.text


def test_a_line_has_a_longest_length(monkeypatch: pytest.MonkeyPatch) -> None:
    """For any input."""
    assert len(Log(monkeypatch, False).event("x" * 100_000)) < 2100
