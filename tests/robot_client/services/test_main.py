"""The help text and errors of the services' command."""

from __future__ import annotations

import shlex

import pytest
from click.testing import CliRunner

from robot_client.services.main import COMMAND, main


@pytest.mark.parametrize("name", sorted(main.commands))
def test_examples_in_help_texts_are_valid_commands(name: str) -> None:
    shown = CliRunner().invoke(main, [name, "--help"], prog_name=COMMAND)
    assert shown.exit_code == 0
    _, found, lines = shown.output.partition("Examples:\n")
    assert found
    for line in lines.splitlines():
        program, service, *arguments = shlex.split(line)
        assert (program, service) == (COMMAND, name)
        main.commands[name].make_context(name, arguments, resilient_parsing=False)


def test_all_services_are_listed() -> None:
    shown = CliRunner().invoke(main, ["--help"])
    for name in ("battery", "faces", "gps", "markers", "navigator", "obstacles", "speech"):
        assert f"\n  {name} " in shown.output


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (["obstacles", "--low", "2"], "--low (2) must be less than --high (1.5)"),
        (["battery", "--critical", "30"], "--critical (30) must not be more than --low (20)"),
        (["gps", "x", "--baud", "1"], "'1' is not one of"),
        (["faces", "--similarity", "2"], "--similarity"),
        (["navigator", "--scan", "", "--depth", ""], "a navigator needs a sensor"),
        (["navigator", "--inflation", "0.1"], "--inflation (0.1) must not be less than --radius (0.2)"),
        (["markers"], "Missing option '--size'"),
        (["markers", "--size", "0.1", "--dictionary", "9X9"], "'9X9' is not a dictionary; known are: 4X4_50"),
    ],
)
def test_invalid_options_are_reported(words: list[str], reported: str) -> None:
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 2
    assert reported in done.output
