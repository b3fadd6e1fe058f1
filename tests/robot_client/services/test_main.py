"""What the command of the services says about itself."""

from __future__ import annotations

import shlex

import pytest
from click.testing import CliRunner

from robot_client.services.main import COMMAND, main


@pytest.mark.parametrize("name", sorted(main.commands))
def test_help_ends_with_examples_that_are_understood(name: str) -> None:
    """Each line is a command as it is typed, with options that exist."""
    shown = CliRunner().invoke(main, [name, "--help"], prog_name=COMMAND)
    assert shown.exit_code == 0
    _, found, lines = shown.output.partition("Examples:\n")
    assert found
    for line in lines.splitlines():
        program, service, *arguments = shlex.split(line)
        assert (program, service) == (COMMAND, name)
        main.commands[name].make_context(name, arguments, resilient_parsing=False)


def test_all_services_are_listed() -> None:
    """Each with a sentence."""
    shown = CliRunner().invoke(main, ["--help"])
    for name in ("battery", "faces", "gps", "markers", "obstacles", "speech"):
        assert f"\n  {name} " in shown.output


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["obstacles", "--low", "2"], "--low (2) must be less than --high (1.5)"),
        (["battery", "--critical", "30"], "--critical (30) must not be more than --low (20)"),
        (["gps", "x", "--baud", "1"], "'1' is not one of"),
        (["faces", "--alike", "2"], "--alike"),
        (["markers"], "Missing option '--size'"),
        (["markers", "--size", "0.1", "--dictionary", "9X9"], "'9X9' is not known; these are: 4X4_50"),
    ],
)
def test_options_that_make_no_sense_are_told_in_a_sentence(words: list[str], told: str) -> None:
    """Before anything runs."""
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 2
    assert told in done.output
