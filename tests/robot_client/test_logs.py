"""Log lines."""

from __future__ import annotations

import io
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol.text import inert
from robot_client.logs import LONGEST, LineObserver


@given(st.text())
def test_inert_text_can_do_nothing(text: str) -> None:
    """Whatever goes in, what comes out is printable, on one line and bounded."""
    assert inert(text, LONGEST).isprintable()
    assert len(inert(text, LONGEST)) <= 10 * LONGEST + 1


def test_escape_sequences_are_shown() -> None:
    """A terminal's escape sequence and a line break are written out."""
    assert inert("\x1b[2J a\nb") == r"\x1b[2J a\nb"


@pytest.mark.parametrize("as_json", [False, True])
def test_one_event_is_one_line(as_json: bool) -> None:
    """A reason with line breaks stays one line, plain and as JSON."""
    out = io.StringIO()
    log = Logger("link", observer=LineObserver(out, as_json))
    log.warn("refused: {reason}", reason="a\nforged line\x1b[31m")
    (line,) = out.getvalue().splitlines()
    text = json.loads(line)["text"] if as_json else line
    assert text.endswith(r"refused: a\nforged line\x1b[31m")


def test_failure_is_one_line() -> None:
    """A failure is logged with its place, on one line."""
    out = io.StringIO()
    log = Logger("link", observer=LineObserver(out, False))
    try:
        raise ValueError("what")
    except ValueError:
        log.failure("it failed", Failure())
    (line,) = out.getvalue().splitlines()
    assert "ValueError: what" in line
    assert "test_logs.py" in line


def test_closed_stderr_is_no_trouble() -> None:
    """A log nobody reads any more does not end the robot's daemon."""
    out = io.StringIO()
    out.close()
    Logger("link", observer=LineObserver(out, False)).info("hello")
