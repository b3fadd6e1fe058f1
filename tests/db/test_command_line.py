"""The admin command line on PostgreSQL: the same commands, another database."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

import relay_db
from relay_server.cli import main


def test_the_command_line_works_on_postgresql(empty_postgres_url: str, tmp_path: Path) -> None:
    """From an empty database to a verified audit log; no file is made for it."""
    runner = CliRunner(env={"SWITCHBOARD_DB": empty_postgres_url, "SWITCHBOARD_DATA": str(tmp_path / "data")})

    def run(*arguments: str, stdin: str | None = None) -> Any:
        result = runner.invoke(main, [*arguments, "--json"], input=stdin)
        assert (result.exit_code, result.stderr) == (0, ""), result.output
        return json.loads(result.stdout)

    newest = max(path.name for path in (Path(relay_db.__file__).parent / "migrations/versions").glob("0*.py"))
    assert newest.startswith(run("db", "upgrade")["schema"] + "_")
    run("user", "add", "ann", "--password-stdin", stdin="correct horse\n")
    run("group", "add", "lab")
    run("group", "join", "lab", "ann")
    run("robot", "add", "rover")
    run("right", "grant", "@lab", "rover", "operator", "--deny", "call:/reset")
    assert [each["holder"] for each in run("right", "list", "--user", "ann")] == ["@lab"]
    token = run("token", "create", "ann", "--ttl", "1h")
    run("token", "revoke", str(token["id"]))
    run("robot", "remove", "rover", "--yes")
    assert run("audit", "verify") == {"whole": True, "first_broken": None}
    assert len(run("audit", "list")) == 8
    assert not (tmp_path / "data").exists()


def test_a_missing_server_is_exit_code_3(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error does not contain the password."""
    monkeypatch.setenv("SWITCHBOARD_DB", f"postgresql://me:hunter22@/x?host={tmp_path}")
    result = CliRunner().invoke(main, ["user", "list"])
    assert result.exit_code == 3
    assert result.stderr == "Error: the database server can't be reached\n"
