"""The status line of a program."""

from __future__ import annotations

import io

from robot_client.apps.program import UPDATE_SECONDS, StatusLine


class Screen(io.StringIO):
    """A terminal."""

    def isatty(self) -> bool:
        return True


def test_in_a_file_each_change_is_a_line() -> None:
    """Values that change all the time are left out."""
    out = io.StringIO()
    line = StatusLine(out, lambda: 0.0)
    for state, details in [("ready", "1"), ("ready", "2"), ("driving", "3"), ("ready", "4")]:
        line.show(state, details)
    line.finish("ended")
    assert out.getvalue() == "ready\ndriving\nready\nended\n"


def test_on_a_terminal_the_line_is_written_over() -> None:
    """From time to time with changing values, at once with a new state."""
    now = 0.0
    out = Screen()
    line = StatusLine(out, lambda: now)
    line.show("driving", "1")
    line.show("driving", "2")
    now += UPDATE_SECONDS
    line.show("driving", "3")
    line.show("ready", "4")
    line.finish("ended")
    assert out.getvalue().replace("\r\x1b[K", "|") == "|driving  1|driving  3|ready  4|ended  \n"
