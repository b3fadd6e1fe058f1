"""``switchboard db backup``."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from relay_server.cli import main
from tests.worlds.empty_database import write_empty_database


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A data folder with a user and a name."""
    folder = tmp_path / "data"
    write_empty_database(folder / "switchboard.db")
    (folder / "relay.name").write_text("fleet\n")
    assert run(folder, "user", "add", "ann", "--no-password").exit_code == 0
    return folder


def run(data: Path, *arguments: str) -> Result:
    """One command."""
    return CliRunner().invoke(main, ["--data", str(data), *arguments])


def test_a_backup_has_all_that_is_committed_and_is_a_data_folder(data: Path, tmp_path: Path) -> None:
    """Also while another process writes."""
    with closing(sqlite3.connect(data / "switchboard.db", isolation_level=None)) as writer:
        writer.execute("PRAGMA wal_autocheckpoint = 0")
        assert run(data, "user", "add", "bob", "--no-password").exit_code == 0
        writer.execute("BEGIN IMMEDIATE")
        writer.execute("DELETE FROM user_account")
        assert run(data, "db", "backup", str(tmp_path / "new/monday")).exit_code == 0
        writer.execute("ROLLBACK")
    copied = tmp_path / "new/monday"
    assert {each.name for each in copied.iterdir()} == {"switchboard.db", "relay.name"}
    assert (copied / "relay.name").read_text() == "fleet\n"
    assert all(each.stat().st_mode & 0o777 == 0o600 for each in copied.iterdir())
    assert copied.stat().st_mode & 0o777 == 0o700
    shown = run(copied, "user", "list").stdout
    assert "ann" in shown and "bob" in shown


def test_a_database_of_another_version_is_copied_as_it_is(data: Path, tmp_path: Path) -> None:
    """So a backup before an upgrade is possible with the new version."""
    with closing(sqlite3.connect(data / "switchboard.db")) as old, old:
        old.execute("UPDATE alembic_version SET version_num = '0001'")
    assert run(data, "db", "backup", str(tmp_path / "copy")).exit_code == 0
    with closing(sqlite3.connect(tmp_path / "copy/switchboard.db")) as copied:
        assert copied.execute("SELECT version_num FROM alembic_version").fetchone() == ("0001",)


def test_no_folder_is_overwritten(data: Path) -> None:
    before = (data / "switchboard.db").read_bytes()
    done = run(data, "db", "backup", str(data))
    assert done.exit_code == 1
    assert "exists; name a new folder" in done.stderr
    assert (data / "switchboard.db").read_bytes() == before


@pytest.mark.parametrize("missing", ["switchboard.db", "everything"])
def test_a_failed_backup_leaves_nothing(data: Path, tmp_path: Path, missing: str) -> None:
    """And makes no empty database."""
    source = data if missing != "everything" else tmp_path / "elsewhere"
    (data / "switchboard.db").unlink()
    done = run(source, "db", "backup", str(tmp_path / "copy"))
    assert done.exit_code == 3
    assert f"there is no database in the data folder {source}" in done.stderr
    assert not (tmp_path / "copy").exists()
    assert not (source / "switchboard.db").exists()


def test_postgresql_is_copied_by_its_own_program(tmp_path: Path) -> None:
    done = CliRunner().invoke(
        main, ["--db", "postgresql://me@db/fleet", "db", "backup", str(tmp_path / "copy")]
    )
    assert done.exit_code == 1
    assert "pg_dump" in done.stderr
    assert not (tmp_path / "copy").exists()
