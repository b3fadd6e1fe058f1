"""The help texts of the robot's commands."""

from __future__ import annotations

import shlex

import click
import pytest
from click.testing import CliRunner

from robot_client.cli import enroll, main, run
from robot_client.sim.main import main as simulate


@pytest.mark.parametrize(
    ("words", "command"),
    [
        (["switchboard-robot"], main),
        (["switchboard-robot", "enroll"], main),
        (["switchboard-robot", "run"], main),
        (["switchboard-sim"], simulate),
    ],
)
def test_examples_in_help_texts_are_valid_commands(words: list[str], command: click.Command) -> None:
    known = {"enroll": enroll, "run": run}
    shown = CliRunner().invoke(command, [*words[1:], "--help"], prog_name=words[0])
    assert shown.exit_code == 0
    _, found, lines = shown.output.partition("Examples:\n")
    assert found
    for line in lines.splitlines():
        name, *arguments = shlex.split(line, comments=True)
        assert name == words[0]
        used = known[arguments.pop(0)] if command is main else command
        used.make_context(name, arguments, resilient_parsing=False)
