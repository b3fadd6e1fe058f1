"""The level of each line that a module writes. The standard library alone."""

from __future__ import annotations

import re
from dataclasses import dataclass

_SOURCES = 64
"""Most sources of lines whose messages are followed at a time."""

_COLOUR = r"(?:\x1b\[[\d;]*m)?"
_NODE = re.compile(rf"{_COLOUR}(?:(\[[^\]]+-\d+\]):? )?{_COLOUR}")
"""``ros2 launch`` puts the process in front of its lines: [node-1] text."""

_WORD = r"(DEBUG|INFO|WARN|WARNING|ERROR|FATAL|CRITICAL)"
_TIME = r"\[?\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d\S*"
_LEVEL = re.compile(
    # rclpy, rclcpp and ros2 launch itself: [INFO] [1700000000.123456789] [node]: text, [ERROR] [node-1]: text
    rf"\[{_WORD}\](?=\s|:|$)"
    # Python's logging: ERROR:name:text, ERROR: text
    rf"|{_WORD}:(?:[\w.-]+:|(?=\s))"
    # With a time: 2026-01-31 12:00:00,123 - name - ERROR - text, … ERROR name: text, … [ERROR] text
    rf"|{_TIME}(?:\s+-\s+[^\s:]+\s+-|\s+[\w.-]+)?\s+\[?{_WORD}(?=\]|:|\s)"
)
_LEVELS = {"WARNING": "warn", "CRITICAL": "fatal"}

_TRACEBACK = re.compile(r"Traceback \(most recent call last\):\s*\Z")
_BETWEEN_TRACEBACKS = (
    "",
    "During handling of the above exception, another exception occurred:",
    "The above exception was the direct cause of the following exception:",
)
"""Lines between those of exceptions that belong together."""


@dataclass
class _Message:
    """The message that the latest line of a source belongs to.

    :ivar in_traceback: whether the line is still to come that names the exception, which is not indented
    :ivar has_traceback: whether it has one
    """

    level: str
    in_traceback: bool
    has_traceback: bool


class LineLevels:
    """Finds the levels of the lines of a module, in the order in which it writes them.

    A line has the level that it names as ROS 2, ``ros2 launch`` or Python's logging do. A traceback of Python is an
    ``error``. Indented lines continue the message before them. Other lines are ``info``.
    """

    def __init__(self) -> None:
        self._messages: dict[tuple[str, str], _Message] = {}
        """By source: the stream, and the process that ``ros2 launch`` names."""

    def level_of(self, stream: str, text: str) -> str:
        """The level of the next line of a stream."""
        node = _NODE.match(text)
        assert node is not None  # it matches no characters, too
        source, body = (stream, node[1] or ""), text[node.end() :].rstrip("\r")
        message = _next_message(self._messages.pop(source, None), body)
        if message is None:
            return "info"
        if len(self._messages) >= _SOURCES:
            self._messages.clear()
        self._messages[source] = message
        return message.level


def _next_message(before: _Message | None, text: str) -> _Message | None:
    """The message that a line belongs to.

    :param before: that of the line before
    """
    traceback = _TRACEBACK.search(text) is not None
    if level := _named_level(text):
        return _Message(level, traceback, traceback)
    if traceback:
        return _Message("fatal" if before is not None and before.level == "fatal" else "error", True, True)
    if before is None or text[:1].isspace():
        return before
    if before.in_traceback:
        return _Message(before.level, text in _BETWEEN_TRACEBACKS, True)
    return before if before.has_traceback and text in _BETWEEN_TRACEBACKS else None


def _named_level(text: str) -> str:
    found = _LEVEL.match(text)
    if not found:
        return ""
    word = found[1] or found[2] or found[3]
    return _LEVELS.get(word, word.lower())
