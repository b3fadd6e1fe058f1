"""``--data`` and ``--db`` may stand before and behind a command."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from relay_server.cli import main
from tests.worlds.empty_database import write_empty_database


def run(*arguments: str) -> str:
    done = CliRunner().invoke(main, [*arguments, "--json"])
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.mark.parametrize(
    "command",
    [
        ["--data", "{data}", "robot", "list"],
        ["robot", "list", "--data", "{data}"],
        [
            "--data",
            "/nowhere",
            "robot",
            "list",
            "--db",
            "sqlite:///{data}/switchboard.db",
            "--data",
            "{data}",
        ],
        ["robot", "list", "--db", "sqlite:///{data}/switchboard.db", "--data", "{data}"],
    ],
)
def test_shared_options_stand_on_either_side(tmp_path: Path, command: list[str]) -> None:
    """The one behind the command counts."""
    write_empty_database(tmp_path / "switchboard.db")
    run("--data", str(tmp_path), "robot", "add", "rover")
    robots = json.loads(run(*(word.format(data=tmp_path) for word in command)))
    assert [robot["robot"] for robot in robots] == ["rover"]


def test_a_command_with_its_own_option_keeps_it(tmp_path: Path) -> None:
    """``serve`` describes ``--data`` itself, and takes ``--db`` too."""
    done = CliRunner().invoke(main, ["serve", "--db", "nonsense://x", "--data", str(tmp_path)])
    assert done.exit_code != 0
    assert "No such option" not in done.output
    assert "nonsense" in done.output
