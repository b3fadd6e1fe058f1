"""The line that says how things stand."""

from __future__ import annotations

import io

from robot_client.apps.status_line import EVERY, StatusLine


class Screen(io.StringIO):
    """A terminal."""

    def isatty(self) -> bool:
        return True


def test_in_a_file_each_change_is_a_line() -> None:
    """What changes all the time is left out."""
    out = io.StringIO()
    line = StatusLine(out, lambda: 0.0)
    for state, details in [("ready", "1"), ("ready", "2"), ("driving", "3"), ("ready", "4")]:
        line.tell(state, details)
    line.end("ended")
    assert out.getvalue() == "ready\ndriving\nready\nended\n"


def test_on_a_terminal_the_line_is_written_over() -> None:
    """Now and then with what changes all the time, at once with another state."""
    now = 0.0
    out = Screen()
    line = StatusLine(out, lambda: now)
    line.tell("driving", "1")
    line.tell("driving", "2")
    now += EVERY
    line.tell("driving", "3")
    line.tell("ready", "4")
    line.end("ended")
    assert out.getvalue().replace("\r\x1b[K", "|") == "|driving  1|driving  3|ready  4|ended  \n"
