"""SQLite as we want it: durable, with real transactions, and for its owner's eyes only."""

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
"""How long a transaction waits for another process's before it gives up."""

_FOLDER_MODE = 0o700
_FILE_MODE = 0o600
_OTHERS = 0o007


def open_engine(url: URL) -> Engine:
    """:raises OSError: the file can't be made or read"""
    assert url.database is not None
    path = Path(url.database).absolute()
    _prepare(path)
    # mode=rw: a file that vanished is an error, not an empty database readable by all
    target = f"file:{quote(str(path))}?mode=rw"

    def connect() -> sqlite3.Connection:
        return sqlite3.connect(
            target, uri=True, timeout=BUSY_SECONDS, isolation_level=None, check_same_thread=False
        )

    engine = create_engine(url, creator=connect, hide_parameters=True)
    event.listen(engine, "connect", _configure)
    event.listen(engine, "begin", _begin)
    return engine


def _prepare(path: Path) -> None:
    """Make the file, if it is not there, and see to its mode; SQLite gives -wal and -shm the same one.

    The folder is locked meanwhile: two processes that switch one file to WAL at once get 'locked', which no
    busy timeout covers.
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
        # By SQLite alone: whoever else opens and closes the file drops all locks this process has on it
        # (https://www.sqlite.org/howtocorrupt.html, 2.2), and the next process believes it is alone.
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
    """Say BEGIN ourselves: the driver would only do so before the first write, after reads made outside."""
    if connection.get_execution_options().get(WRITE):
        connection.exec_driver_sql("PRAGMA query_only = OFF")
        connection.exec_driver_sql("BEGIN IMMEDIATE")
    else:
        connection.exec_driver_sql("PRAGMA query_only = ON")
        connection.exec_driver_sql("BEGIN")
