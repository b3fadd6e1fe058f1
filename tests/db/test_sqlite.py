"""The embedded database: durable, private, and its errors."""

from __future__ import annotations

import os
import sqlite3
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from relay_db import queries
from relay_db import sqlite as edge
from relay_db.engine import Database
from relay_protocol.errors import Unavailable


@pytest.fixture
def open_umask() -> Iterator[None]:
    """A process that would make everything world-readable."""
    before = os.umask(0)
    yield
    os.umask(before)


@pytest.mark.usefixtures("open_umask")
def test_the_files_are_for_their_owner_only(sqlite_url: str, tmp_path: Path) -> None:
    """Folder and files of the database are closed to others, for any umask."""
    database = Database(sqlite_url)
    database.upgrade()
    with database.begin() as s:
        queries.add_robot(s, "rover")
        modes = {each.name: stat.S_IMODE(each.stat().st_mode) for each in (tmp_path / "data").iterdir()}
    database.close()
    assert modes == {"switchboard.db": 0o600, "switchboard.db-wal": 0o600, "switchboard.db-shm": 0o600}
    assert stat.S_IMODE((tmp_path / "data").stat().st_mode) == 0o700


def test_a_world_readable_file_is_closed(sqlite_url: str, tmp_path: Path) -> None:
    """A database with an open mode loses it when it is opened; the group's rights stay."""
    Database(sqlite_url).close()
    path = tmp_path / "data" / "switchboard.db"
    path.chmod(0o664)
    Database(sqlite_url).close()
    assert stat.S_IMODE(path.stat().st_mode) == 0o660


def test_the_settings_are_those_of_a_durable_database(sqlite: Database) -> None:
    """WAL, foreign keys, and a sync at every commit."""
    with sqlite.reading() as s:
        connection = s.connection()
        values = {
            name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("journal_mode", "foreign_keys", "synchronous")
        }
    assert values == {"journal_mode": "wal", "foreign_keys": 1, "synchronous": 2}


def test_odd_paths_work(tmp_path: Path) -> None:
    """Blanks, percent signs and hashes in a path work."""
    path = tmp_path / "a b%20#c" / "d.db"
    database = Database(f"sqlite:///{path}")
    database.upgrade()
    database.close()
    assert path.exists()


def test_a_restored_dump_gets_a_write_ahead_log(sqlite_url: str, tmp_path: Path) -> None:
    """A database with a rollback journal is switched when it is opened."""
    Database(sqlite_url).close()
    path = tmp_path / "data" / "switchboard.db"
    raw = sqlite3.connect(path)
    assert raw.execute("PRAGMA journal_mode = DELETE").fetchone() == ("delete",)
    raw.execute("CREATE TABLE something (x)")
    raw.close()
    database = Database(sqlite_url)
    with database.reading() as s:
        assert s.connection().exec_driver_sql("PRAGMA journal_mode").scalar() == "wal"
    database.close()


def test_a_locked_database_has_a_clear_error(
    sqlite_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process holds the write lock too long; afterwards it works again."""
    monkeypatch.setattr(edge, "BUSY_SECONDS", 0.05)
    database = Database(sqlite_url)
    database.upgrade()
    other = sqlite3.connect(tmp_path / "data" / "switchboard.db", isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    with pytest.raises(Unavailable, match="locked"), database.begin() as s:
        queries.add_robot(s, "rover")
    with database.reading() as s:
        assert queries.revision(s) == 1
    other.execute("ROLLBACK")
    other.close()
    with database.begin() as s:
        queries.add_robot(s, "rover")
    database.close()


def test_a_full_disk_has_a_clear_error(sqlite: Database) -> None:
    """No page can be added: nothing is half-written, and reading continues."""
    with pytest.raises(Unavailable, match="full"), sqlite.begin() as s:
        pages = s.connection().exec_driver_sql("PRAGMA page_count").scalar_one()
        s.connection().exec_driver_sql(f"PRAGMA max_page_count = {pages}")
        for number in range(10_000):
            queries.add_robot(s, f"rover-{number}", "x" * 255)
    with sqlite.reading() as s:
        assert queries.list_robots(s) == []


def test_a_missing_file_is_an_error_and_not_created_again(sqlite_url: str, tmp_path: Path) -> None:
    """A database that disappears is an error, not a new one without users."""
    database = Database(sqlite_url)
    path = tmp_path / "data" / "switchboard.db"
    for each in path.parent.iterdir():
        each.unlink()
    with pytest.raises(Unavailable, match="can't be opened"):
        database.upgrade()
    assert not path.exists()


def test_a_file_that_is_not_a_database_has_a_clear_error(sqlite_url: str, tmp_path: Path) -> None:
    """The file stays as it was."""
    path = tmp_path / "data" / "switchboard.db"
    path.parent.mkdir()
    path.write_bytes(b"a letter to aunt Emma\n" * 100)
    with pytest.raises(Unavailable, match="not an SQLite database"):
        Database(sqlite_url)
    assert path.read_bytes() == b"a letter to aunt Emma\n" * 100


def test_a_folder_that_cannot_be_created_has_a_clear_error(tmp_path: Path) -> None:
    """For example with a file in place of the folder; the error does not contain the path."""
    (tmp_path / "taken").write_text("")
    with pytest.raises(Unavailable, match="can't be used") as caught:
        Database(f"sqlite:///{tmp_path}/taken/switchboard.db")
    assert str(tmp_path) not in str(caught.value)


def test_a_second_database_in_one_process_costs_the_first_no_lock(sqlite_url: str) -> None:
    """Another process finds the first one's locks and does not touch its write-ahead log."""
    first = Database(sqlite_url)
    first.upgrade()
    with first.begin() as session:
        queries.add_user(session, "before", None)
    second = Database(sqlite_url)
    with second.reading() as session:
        assert len(queries.list_users(session)) == 1
    program = (
        "import sys; from relay_db.engine import Database; from relay_db import queries\n"
        "database = Database(sys.argv[1])\n"
        "with database.begin() as session: queries.add_user(session, 'elsewhere', None)\n"
        "database.close()"
    )
    subprocess.run([sys.executable, "-c", program, sqlite_url], check=True, timeout=60)
    with first.begin() as session:
        queries.add_user(session, "after", None)
    third = Database(sqlite_url)
    with third.reading() as session:
        assert {each.name for each in queries.list_users(session)} == {"before", "elsewhere", "after"}
    for each in (first, second, third):
        each.close()
