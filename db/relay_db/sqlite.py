"""Settings for SQLite: durable, with real transactions, and files that only the owner can read."""

from __future__ import annotations

import fcntl
import os
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sqlalchemy import URL, Connection, Engine, create_engine, event

WRITE = "switchboard_write"
"""Execution option: whether transactions on the connection may write."""

BUSY_SECONDS = 5.0
"""Seconds that a transaction waits for that of another process."""

_FOLDER_MODE = 0o700
_FILE_MODE = 0o600
_OTHERS = 0o007


def open_engine(url: URL) -> Engine:
    """:raises OSError: the file cannot be created or read"""
    assert url.database is not None
    path = Path(url.database).absolute()
    _prepare(path)
    # mode=rw: a missing file is an error. Otherwise SQLite would create one that others can read.
    target = f"file:{quote(str(path))}?mode=rw"

    def connect() -> sqlite3.Connection:
        return sqlite3.connect(
            target, uri=True, timeout=BUSY_SECONDS, isolation_level=None, check_same_thread=False
        )

    engine = create_engine(url, creator=connect, hide_parameters=True)
    event.listen(engine, "connect", _configure)
    event.listen(engine, "begin", _begin)
    return engine


def copy(source: Path, target: Path) -> None:
    """Copy a database that may be in use, with everything that is committed.

    :param target: a new file, readable by the owner only
    :raises OSError: the new file exists, or can't be created
    :raises sqlite3.Error: the database can't be read, or the copy not be written
    """
    os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_RDWR, _FILE_MODE))
    with (
        closing(sqlite3.connect(f"file:{quote(str(source))}?mode=ro", uri=True, timeout=BUSY_SECONDS)) as raw,
        closing(sqlite3.connect(target)) as made,
    ):
        raw.backup(made)


def _prepare(path: Path) -> None:
    """Create the file if it does not exist, and set its mode, which SQLite gives to -wal and -shm too.

    The folder is locked meanwhile: if two processes switch a file to WAL at once, one gets 'locked' in spite of the
    busy timeout.
    """
    path.parent.mkdir(mode=_FOLDER_MODE, parents=True, exist_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        if not path.exists():
            os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR, _FILE_MODE))
        for each in (path, Path(f"{path}-wal"), Path(f"{path}-shm")):
            if each.is_file() and each.stat().st_mode & _OTHERS:
                each.chmod(each.stat().st_mode & 0o770)
        # Only SQLite may open the file: opening and closing it otherwise drops all locks of this process
        # (https://www.sqlite.org/howtocorrupt.html, 2.2), and another process could write at the same time.
        with closing(sqlite3.connect(path, timeout=BUSY_SECONDS, isolation_level=None)) as raw:
            if raw.execute("PRAGMA journal_mode").fetchone() != ("wal",):
                raw.execute("PRAGMA journal_mode = WAL")
    finally:
        os.close(folder)


def _configure(raw: sqlite3.Connection, record: Any) -> None:
    raw.execute("PRAGMA foreign_keys = ON")
    raw.execute("PRAGMA synchronous = FULL")
    raw.execute("PRAGMA trusted_schema = OFF")


def _begin(connection: Connection) -> None:
    """Begin the transaction here: the driver would do it only before the first write, after reads outside it."""
    if connection.get_execution_options().get(WRITE):
        connection.exec_driver_sql("PRAGMA query_only = OFF")
        connection.exec_driver_sql("BEGIN IMMEDIATE")
    else:
        connection.exec_driver_sql("PRAGMA query_only = ON")
        connection.exec_driver_sql("BEGIN")
