"""Log lines."""

from __future__ import annotations

import io
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from twisted.logger import Logger, LogLevel
from twisted.python.failure import Failure

from relay_protocol.text import escape_unprintable
from robot_client.logs import MAX_LINE, LineObserver


@given(st.text())
def test_escaped_text_is_printable_bounded_and_on_one_line(text: str) -> None:
    assert escape_unprintable(text, MAX_LINE).isprintable()
    assert len(escape_unprintable(text, MAX_LINE)) <= 10 * MAX_LINE + 1


def test_escape_sequences_are_written_out() -> None:
    assert escape_unprintable("\x1b[2J a\nb") == r"\x1b[2J a\nb"


@pytest.mark.parametrize("as_json", [False, True])
def test_event_is_one_line(as_json: bool) -> None:
    """Plain and as JSON."""
    out = io.StringIO()
    log = Logger("link", observer=LineObserver(out, as_json))
    log.warn("refused: {reason}", reason="a\nforged line\x1b[31m")
    (line,) = out.getvalue().splitlines()
    text = json.loads(line)["text"] if as_json else line
    assert text.endswith(r"refused: a\nforged line\x1b[31m")


def test_failure_is_one_line_with_its_location() -> None:
    out = io.StringIO()
    log = Logger("link", observer=LineObserver(out, False))
    try:
        raise ValueError("what")
    except ValueError:
        log.failure("it failed", Failure())
    (line,) = out.getvalue().splitlines()
    assert "ValueError: what" in line
    assert "test_logs.py" in line


def test_closed_stderr_does_not_end_the_daemon() -> None:
    out = io.StringIO()
    out.close()
    Logger("link", observer=LineObserver(out, False)).info("hello")


def test_lines_that_devices_and_clients_cause_are_limited_and_counted() -> None:
    """30 a minute of one kind; other lines are not affected."""
    out = io.StringIO()
    scheduled: list[float] = []
    observe = LineObserver(out, False, lambda seconds, work: scheduled.append(seconds))
    event = {"log_level": LogLevel.warn, "log_namespace": "mqtt", "log_format": "{about}: refused"}
    for number in range(50):
        observe({**event, "about": f"device {number}", "limited": "problem", "log_time": 100.0})
    observe({**event, "about": "the broker", "log_time": 100.0})
    assert len(out.getvalue().splitlines()) == 31
    assert scheduled == [61]
    observe({**event, "about": "the broker", "log_time": 160.5})
    assert (
        out.getvalue()
        .splitlines()[-2]
        .endswith("mqtt: 20 more lines like this one were left out in 60 s: device 0: refused")
    )


def test_failures_are_limited() -> None:
    """Per kind of error."""
    out = io.StringIO()
    observe = LineObserver(out, False)
    for error in [ValueError()] * 50 + [KeyError()]:
        observe({"log_namespace": "x", "log_format": "it failed", "log_failure": Failure(error)})
    assert len(out.getvalue().splitlines()) == 31
