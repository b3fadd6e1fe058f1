"""What the robot's commands say about themselves."""

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
def test_help_ends_with_examples_that_are_understood(words: list[str], command: click.Command) -> None:
    """Each line is a command as it is typed, with options that exist."""
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
