"""Commands in the documents are accepted by the command line, with names of robots and users filled in."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import click
import pytest
from click.exceptions import NoArgsIsHelpError

from relay_server.cli import main

ROOT = Path(__file__).parents[3]
PAGES = sorted(path for path in (ROOT / "docs").rglob("*.md") if path.name != "cli.md")
"""Without the page that is written from the commands themselves."""
SPEC = sorted((ROOT / "protocol" / "spec").glob("*.md"))
DOCUMENTS = [ROOT / "README.md", *SPEC, *PAGES]
COMMAND = re.compile(r"(?:`|^ *(?:sudo )?)switchboard ([^`\n|;<>#]+)", re.MULTILINE)


def documented(path: Path) -> list[str]:
    """Arguments of commands in a document's code blocks and text."""
    text = path.read_text().replace("\\\n", " ")
    return [found.strip(" \\") for found in COMMAND.findall(text)]


def parsed(arguments: str) -> dict[str, Any]:
    """Values of a command's parameters; empty for a command without arguments or with missing files."""
    words = ["1" if each == "ID" else each for each in shlex.split(arguments)]
    command: click.Command = main
    context = main.make_context("switchboard", words)
    while isinstance(command, click.Group) and (rest := [*context._protected_args, *context.args]):
        name, found, rest = command.resolve_command(context, rest)
        assert found is not None, name
        command = found
        try:
            context = command.make_context(name, rest, parent=context)
        except (click.MissingParameter, click.BadOptionUsage, NoArgsIsHelpError):
            return {}
        except click.BadParameter as error:
            if "does not exist" not in str(error):
                raise
            return {}
    return context.params


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_documented_commands_are_taken(path: Path) -> None:
    for arguments in documented(path):
        parsed(arguments)


def test_no_documented_name_is_both_of_a_robot_and_of_a_user() -> None:
    shown = [parsed(arguments) for path in DOCUMENTS for arguments in documented(path)]
    robots = {each["robot"] for each in shown if each.get("robot")}
    users = {each["user"] for each in shown if each.get("user")}
    assert {"robot-one", "driver"} <= robots | users
    assert not robots & users
