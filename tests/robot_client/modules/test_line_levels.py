"""The levels of the lines that a module writes."""

from __future__ import annotations

import logging
import traceback
from io import StringIO

import pytest

from robot_client.modules.line_levels import LineLevels

TRACEBACK = [
    "Traceback (most recent call last):",
    '  File "base.py", line 7, in <module>',
    "    drive()",
    "RuntimeError: no device",
]


def levels_of(lines: list[str], stream: str = "err") -> list[str]:
    levels = LineLevels()
    return [levels.level_of(stream, each) for each in lines]


@pytest.mark.parametrize(
    ("text", "level"),
    [
        ("[WARN] [1700000000.123456789] [base]: slow", "warn"),
        ("[ERROR] [1700000000.1] [base]: broken", "error"),
        ("[talker-1] [ERROR] [1700000000.1] [talker]: no device", "error"),
        ("[talker-1] \x1b[33m[WARN] [1700000000.1] [talker]: slow\x1b[0m", "warn"),
        ("[ERROR] [talker-1]: process has died [pid 7, exit code -9, cmd 'talker'].", "error"),
        ("[WARNING] [launch_ros.actions.node]: two nodes share a name", "warn"),
        ("[CRITICAL] [launch]: broken", "fatal"),
        ("[talker-1] [ERROR] without a time", "error"),
        ("[WARN] no time", "warn"),
        ("[INFO] [ERROR] in a text", "info"),
        ("[node] [ERROR] in a text", "info"),
        ("ERROR:root:broken", "error"),
        ("[python3-1] WARNING:base.arm:slow", "warn"),
        ("DEBUG:asyncio:Using selector", "debug"),
        ("CRITICAL: out of memory", "fatal"),
        ("2026-01-31 12:00:00,123 - base.arm - ERROR - broken", "error"),
        ("2026-01-31 12:00:00,123 WARNING base: slow", "warn"),
        ("2026-01-31T12:00:00Z base ERROR: broken", "error"),
        ("[2026-01-31 12:00:00] [ERROR] broken", "error"),
        ("ERRORS: 3", "info"),
        ("Error: lower case letters are no level", "info"),
        ("a text with ERROR: in it", "info"),
        ("plain", "info"),
    ],
)
def test_level_of_lines_of_ros_and_python(text: str, level: str) -> None:
    assert LineLevels().level_of("out", text) == level


@pytest.mark.parametrize("prefix", ["", "[base-1] ", "[base-1] \x1b[31m"])
def test_traceback_is_an_error_to_its_last_line(prefix: str) -> None:
    lines = [f"{prefix}{each}" for each in ("started", *TRACEBACK, "started again", "  indented")]
    assert levels_of(lines) == ["info", *["error"] * 4, "info", "info"]


@pytest.mark.parametrize(("word", "level"), [("INFO", "info"), ("WARN", "warn"), ("FATAL", "fatal")])
def test_traceback_in_a_message_has_the_level_of_the_message(word: str, level: str) -> None:
    first, *lines = TRACEBACK
    assert levels_of([f"[{word}] [17.5] [base]: {first}", *lines]) == [level] * 4


@pytest.mark.parametrize(("level", "found"), [("info", "error"), ("error", "error"), ("critical", "fatal")])
def test_traceback_behind_a_message_is_an_error_at_least(level: str, found: str) -> None:
    """As Python's logging writes it with ``exc_info``; after ``info`` it may as well be that of a crash."""
    text = StringIO()
    handler = logging.StreamHandler(text)
    handler.setFormatter(logging.Formatter(logging.BASIC_FORMAT))
    logger = logging.Logger("base")
    logger.addHandler(handler)
    try:
        raise RuntimeError("no device")
    except RuntimeError:
        getattr(logger, level)("it failed", exc_info=True)
    named, *lines = levels_of(text.getvalue().splitlines())
    assert named == {"critical": "fatal"}.get(level, level)
    assert len(lines) > 2
    assert set(lines) == {found}


def test_exceptions_that_belong_together_are_errors() -> None:
    try:
        try:
            try:
                raise ValueError("first")
            except ValueError as error:
                raise RuntimeError("its consequence") from error
        except RuntimeError:
            raise KeyError("while it is handled")  # noqa: B904  # the context is wanted
    except KeyError:
        lines = traceback.format_exc().splitlines()
    assert sum("exception" in each and not each.startswith(" ") for each in lines) == 2
    assert levels_of([*lines, "", "next"]) == [*["error"] * (len(lines) + 1), "info"]


def test_group_of_exceptions_is_an_error() -> None:
    lines = [
        "  + Exception Group Traceback (most recent call last):",
        '  |   File "base.py", line 1, in <module>',
        "  | ExceptionGroup: two (2 sub-exceptions)",
        "  +-+---------------- 1 ----------------",
        "    | ValueError: first",
        "    +------------------------------------",
    ]
    assert levels_of(lines) == ["error"] * 6


def test_indented_lines_continue_a_message() -> None:
    lines = ["[WARN] [17.5] [base]: two things:", "  one", "\tother", "next", "  indented"]
    assert levels_of(lines) == ["warn", "warn", "warn", "info", "info"]


def test_lines_of_two_streams_and_of_nodes_of_a_launch_file_may_alternate() -> None:
    levels = LineLevels()
    alternating = [
        (source, each) for each in TRACEBACK for source in (("err", "[a-1] "), ("err", "[b-2] "), ("out", ""))
    ]
    found = [
        levels.level_of(stream, "fine" if stream == "out" else prefix + each)
        for (stream, prefix), each in alternating
    ]
    assert found == ["error", "error", "info"] * 4


def test_sources_that_are_remembered_are_bounded() -> None:
    levels = LineLevels()
    for number in range(1000):
        assert levels.level_of("out", f"[node-{number}] [ERROR] broken") == "error"
    assert len(levels._messages) < 100
