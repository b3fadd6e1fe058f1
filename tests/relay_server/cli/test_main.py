"""Common to all commands: the data folder, the audit log, notifying the relay, exit codes, help."""

from __future__ import annotations

import json
import os
import pwd
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest
from sqlalchemy import create_engine, text

from relay_db.schema import HEAD
from relay_server.cli import main
from relay_server.common.data_dir import SOCKET_NAME
from tests.worlds.empty_database import write_empty_database

CHANGES = [
    ("realm.add", ("realm", "add", "lab1")),
    ("realm.remove", ("realm", "remove", "lab0", "--yes")),
    ("user.add", ("user", "add", "bob", "--no-password")),
    ("user.password", ("user", "passwd", "ann", "--password-stdin")),
    ("user.disable", ("user", "disable", "ann")),
    ("user.enable", ("user", "enable", "ann")),
    ("user.remove", ("user", "remove", "ann", "--yes")),
    ("group.add", ("group", "add", "ops")),
    ("group.remove", ("group", "remove", "lab", "--yes")),
    ("group.join", ("group", "join", "lab", "ann")),
    ("group.leave", ("group", "leave", "lab", "cat")),
    ("robot.add", ("robot", "add", "arm")),
    ("robot.code", ("robot", "code", "rover")),
    ("robot.remove", ("robot", "remove", "rover", "--yes")),
    ("right.grant", ("right", "grant", "ann", "rover", "owner", "--allow", "call:/x")),
    ("right.revoke", ("right", "revoke", "cat", "rover")),
    ("foxglove_url.create", ("foxglove-url", "create", "rover", "cat")),
    ("token.create", ("token", "create", "ann")),
    ("token.revoke", ("token", "revoke", "1")),
]
LOOKS = [
    ("realm", "list"),
    ("user", "list"),
    ("group", "list"),
    ("robot", "list"),
    ("robot", "keys", "rover"),
    ("right", "list"),
    ("foxglove-url", "list"),
    ("token", "list"),
    ("audit", "list"),
    ("audit", "verify"),
]


def _fill(cli: Any) -> None:
    for arguments in (
        ("realm", "add", "lab0"),
        ("user", "add", "ann", "--no-password"),
        ("user", "add", "cat", "--no-password"),
        ("group", "add", "lab"),
        ("group", "join", "lab", "cat"),
        ("robot", "add", "rover"),
        ("right", "grant", "cat", "rover", "viewer"),
        ("token", "create", "cat", "--json"),
    ):
        cli.ok(*arguments)


@pytest.mark.parametrize(("action", "arguments"), CHANGES, ids=[action for action, _ in CHANGES])
def test_change_is_audited_and_announced(
    live: Any, relay: Any, action: str, arguments: tuple[str, ...]
) -> None:
    _fill(live)
    before = len(live.json("audit", "list"))
    relay.asked.clear()
    result = live(*arguments, stdin="correct horse\n", LOGNAME="someone-else", USER="someone-else")
    assert result.exit_code == 0, result.output
    assert relay.asked[0] == "POST /refresh"
    *_, entry = entries = live.json("audit", "list")
    assert len(entries) == before + 1
    assert (entry["action"], entry["actor"]) == (action, f"cli:{pwd.getpwuid(os.getuid()).pw_name}")
    assert live.json("audit", "verify") == {"whole": True, "first_broken": None}


@pytest.mark.parametrize("arguments", LOOKS, ids=" ".join)
def test_a_read_changes_nothing(live: Any, relay: Any, arguments: tuple[str, ...]) -> None:
    """It makes no audit entry and notifies no relay; --json prints one line of JSON and nothing else."""
    _fill(live)
    before = live.json("audit", "list")
    relay.asked.clear()
    answer = live.ok(*arguments, "--json")
    assert answer.count("\n") == 1
    json.loads(answer)
    assert live.ok(*arguments)
    assert relay.asked == []
    assert live.json("audit", "list") == before


def test_a_refused_change_is_not_audited_and_does_not_notify_the_relay(live: Any, relay: Any) -> None:
    _fill(live)
    before = live.json("audit", "list")
    relay.asked.clear()
    live.fails("user", "add", "ann", "--no-password")
    live.fails("right", "grant", "ann", "rover", "owner", "--allow", "nonsense")
    assert relay.asked == []
    assert live.json("audit", "list") == before


def test_a_broken_chain_is_reported(cli: Any) -> None:
    """It names the entry and exits with code 1, also in JSON."""
    for name in ("ann", "bob"):
        cli.ok("user", "add", name, "--no-password")
    engine = create_engine(f"sqlite:///{cli.data}/switchboard.db")
    with engine.begin() as connection:
        connection.execute(text("DROP TRIGGER audit_entry_no_update"))
        connection.execute(text("UPDATE audit_entry SET target = 'bab' WHERE id = 2"))
    engine.dispose()
    assert "first broken entry is number 2" in cli.fails("audit", "verify")
    result = cli("audit", "verify", "--json")
    assert (result.exit_code, json.loads(result.stdout)) == (1, {"whole": False, "first_broken": 2})


def test_the_audit_log_is_listed_oldest_first_and_cut_to_the_latest(cli: Any) -> None:
    for name in ("ann", "bob", "cat"):
        cli.ok("user", "add", name, "--no-password")
    assert [entry["target"] for entry in cli.json("audit", "list", "--limit", "2")] == ["bob", "cat"]
    assert [line.split()[0] for line in cli.ok("audit", "list").splitlines()[2:]] == ["1", "2", "3"]


def test_the_data_folder_is_made_for_its_owner_only(cli: Any) -> None:
    cli.ok("user", "list")
    assert stat.S_IMODE(cli.data.stat().st_mode) == 0o700
    assert stat.S_IMODE((cli.data / "switchboard.db").stat().st_mode) == 0o600


def test_the_option_beats_the_variable(new_cli: Any, tmp_path: Path) -> None:
    """--data before the command precedes SWITCHBOARD_DATA."""
    new_cli.ok("--data", str(tmp_path / "other"), "db", "upgrade")
    assert (tmp_path / "other" / "switchboard.db").exists()
    assert not new_cli.data.exists()


def test_pages_of_other_origins_need_the_port_of_the_demo(cli: Any, tmp_path: Path) -> None:
    error = cli.fails("demo", "--data", str(tmp_path / "demo"), "--origin", "http://localhost:8000")
    assert "--origin needs a port in --http" in error


def test_odd_folders_work(cli: Any, tmp_path: Path) -> None:
    """Paths may contain blanks, percent signs and hashes."""
    folder = tmp_path / "a b%41#c"
    cli.ok("--data", str(folder), "db", "upgrade")
    assert (folder / "switchboard.db").exists()
    cli.ok("--data", str(folder), "user", "list")


@pytest.mark.parametrize("command", [["user", "list"], ["robot", "add", "rover"], ["audit", "verify"]])
def test_a_wrong_folder_is_refused_and_gets_no_database(
    new_cli: Any, tmp_path: Path, command: list[str]
) -> None:
    folder = tmp_path / "wrong"
    error = new_cli.fails("--data", str(folder), *command, code=3)
    assert f"there is no database in the data folder {folder}; give the relay's" in error
    assert not folder.exists()


def test_another_database_is_taken_by_url(new_cli: Any, tmp_path: Path) -> None:
    """With --db or SWITCHBOARD_DB the data folder is not needed."""
    url = f"sqlite:///{tmp_path}/elsewhere/x.db"
    new_cli.ok("--db", url, "user", "add", "ann", "--no-password")
    result = new_cli("user", "list", "--json", SWITCHBOARD_DB=url)
    assert [each["user"] for each in json.loads(result.stdout)] == ["ann"]
    assert not new_cli.data.exists()
    assert new_cli.json("--db", url, "db", "upgrade") == {"database": url, "schema": HEAD}


def test_a_database_that_is_not_there_is_exit_code_3(cli: Any, tmp_path: Path) -> None:
    """The error has no traceback and no password of the URL."""
    result = cli("user", "list", SWITCHBOARD_DB="postgresql://me:hunter22@127.0.0.1:1/x")
    assert (result.exit_code, result.stdout) == (3, "")
    assert result.stderr == "Error: the database server can't be reached\n"
    (tmp_path / "file").write_text("")
    assert "can't be used" in cli.fails("--data", str(tmp_path / "file" / "x"), "db", "upgrade", code=3)


def test_a_database_url_that_cannot_be_is_refused(cli: Any) -> None:
    assert "not a database URL" in cli.fails("--db", "nonsense", "user", "list")


def test_a_relay_that_hangs_does_not_hold_a_change_up(
    cli: Any, short_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Notifying the relay times out; the change is made."""
    import socket

    from relay_server.cli import admin_socket_client

    monkeypatch.setattr(admin_socket_client, "_NOTIFY_SECONDS", 0.05)
    monkeypatch.setattr(admin_socket_client, "_STATUS_SECONDS", 0.05)
    with socket.socket(socket.AF_UNIX) as silent:
        silent.bind(str(short_folder / SOCKET_NAME))
        silent.listen()
        write_empty_database(short_folder / "switchboard.db")
        cli.ok("--data", str(short_folder), "user", "add", "ann", "--no-password")
        reported = cli.fails("--data", str(short_folder), "status", code=3)
    assert "does not answer" in reported
    assert len(cli.json("--data", str(short_folder), "user", "list")) == 1


def _commands(
    command: click.Command, path: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    yield path, command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            child = command.get_command(context, name)
            assert child is not None
            yield from _commands(child, (*path, name))


ADMIN = [
    (path, command)
    for path, command in _commands(main, ())
    if not isinstance(command, click.Group) and path not in {("serve",), ("demo",), ("worker",)}
]


@pytest.mark.parametrize(("path", "command"), ADMIN, ids=[" ".join(path) for path, _ in ADMIN])
def test_commands_have_help_examples_and_json(path: tuple[str, ...], command: click.Command) -> None:
    """The help describes the command, its exit codes, and shows an example."""
    assert command.help
    assert command.epilog is not None
    assert re.search(rf"switchboard( --data \S+)? {' '.join(path)}\b", command.epilog)
    assert "Exit codes: 0 done, 1 refused" in command.epilog
    assert any("--json" in parameter.opts for parameter in command.params)
    if "remove" in path:
        assert any("--yes" in parameter.opts for parameter in command.params)


def test_the_help_names_all_commands(cli: Any) -> None:
    """Without importing them."""
    shown = cli.ok("--help")
    for name in ("realm", "user", "group", "robot", "right", "token", "audit", "db", "status"):
        assert re.search(rf"^  {name} ", shown, re.MULTILINE)


@pytest.mark.parametrize("arguments", [("fly",), ("user", "fly"), ("user", "add"), ("user", "list", "--fly")])
def test_wrong_usage_is_exit_code_2(new_cli: Any, arguments: tuple[str, ...]) -> None:
    new_cli.fails(*arguments, code=2)
    assert not new_cli.data.exists()
