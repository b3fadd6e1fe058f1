"""Output of commands on terminals without Unicode, to a full disk and to a closed pipe."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import click
import pytest

from relay_protocol.command_output import OutputCommand, OutputGroup


@click.group(cls=OutputGroup)
def program() -> None:
    """A program."""


@program.command()
@click.option("--lines", default=1)
def say(lines: int) -> None:
    """Print lines."""
    for _ in range(lines):
        # Click itself writes UTF-8 where the encoding is ASCII.
        sys.stdout.write("Tür – 門\n")


@click.command(cls=OutputCommand)
def fail() -> None:
    """Fail as a bug does."""
    raise FileNotFoundError(2, "No such file or directory", "x")


@contextmanager
def output(to: int, encoding: str = "utf-8") -> Iterator[None]:
    """Standard output into a file descriptor, which is closed at the end."""
    before = sys.stdout
    mine = sys.stdout = io.TextIOWrapper(os.fdopen(to, "wb"), encoding=encoding)
    try:
        yield
    finally:
        sys.stdout = before
        with suppress(BrokenPipeError):
            mine.close()


def code_of(*arguments: str, command: click.Command = program) -> int:
    with pytest.raises(SystemExit) as ended:
        command.main(list(arguments), prog_name="program")
    return int(ended.value.code or 0)


@pytest.mark.parametrize(("encoding", "expected"), [("ascii", b"T?r ? ?\n"), ("latin-1", b"T\xfcr ? ?\n")])
def test_characters_that_a_terminal_lacks_are_replaced(encoding: str, expected: bytes) -> None:
    reading, writing = os.pipe()
    with output(writing, encoding):
        assert code_of("say") == 0
    assert os.read(reading, 100) == expected
    os.close(reading)


@pytest.mark.parametrize("lines", [1, 10_000])
def test_a_full_disk_is_an_error_in_words(lines: int, capsys: pytest.CaptureFixture[str]) -> None:
    """Also if the output is so short that only its end is written."""
    with output(os.open("/dev/full", os.O_WRONLY)):
        assert code_of("say", "--lines", str(lines)) == 1
    assert capsys.readouterr().err == "Error: the output cannot be written: No space left on device\n"


@pytest.mark.parametrize("lines", [1, 10_000])
def test_a_closed_pipe_ends_the_program_silently(lines: int, capsys: pytest.CaptureFixture[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with output(writing):
        assert code_of("say", "--lines", str(lines)) == 1
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("closed", ["stdout", "stderr"])
def test_a_descriptor_that_was_closed_before_the_start_is_no_error(
    closed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, closed, None)
    assert code_of("say") == 0
    getattr(sys, closed).close()


def test_other_errors_stay_what_they_are() -> None:
    with pytest.raises(FileNotFoundError):
        fail.main([], prog_name="program")
