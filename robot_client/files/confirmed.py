"""Remembers which files the relay has confirmed, for groups whose files are kept on the robot."""

from __future__ import annotations

import errno
import sqlite3
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from robot_client.files.folder import FileState

T = TypeVar("T")


class ConfirmedFiles:
    """A small database beside the daemon's state. Losing it costs no file: each is offered once more.

    All methods block, and may be called in any thread.

    :param path: of the database, which is opened with the first use
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._database: sqlite3.Connection | None = None

    def has(self, group: str, path: str, state: FileState) -> bool:
        """Whether the file was confirmed as it is now."""
        with self._lock:
            query = "SELECT size, modified, inode FROM confirmed WHERE name = ?"
            row = self._repaired(lambda db: db.execute(query, (f"{group}/{path}",)).fetchone())
        return row is not None and tuple(row) == state

    def add(self, group: str, path: str, state: FileState) -> None:
        """The relay has confirmed the file."""
        values = (f"{group}/{path}", *state)

        def insert(database: sqlite3.Connection) -> None:
            with database:
                database.execute("INSERT OR REPLACE INTO confirmed VALUES (?, ?, ?, ?)", values)

        with self._lock:
            self._repaired(insert)

    def close(self) -> None:
        """Close the database."""
        with self._lock:
            self._close()

    def _close(self) -> None:
        if self._database is not None:
            self._database.close()
            self._database = None

    def _repaired(self, work: Callable[[sqlite3.Connection], T]) -> T:
        """Use the database. A damaged one is replaced by an empty one.

        :raises OSError: it can't be used
        """
        try:
            try:
                return work(self._open())
            except sqlite3.OperationalError as error:
                if "malformed" not in str(error) and "no such table" not in str(error):
                    raise
            except sqlite3.DatabaseError:
                pass
            self._close()
            for ending in ("", "-wal", "-shm"):
                Path(f"{self._path}{ending}").unlink(missing_ok=True)
            return work(self._open())
        except sqlite3.Error as error:
            raise OSError(errno.EIO, f"the database of confirmed files can't be used: {error}") from None

    def _open(self) -> sqlite3.Connection:
        if self._database is None:
            self._database = _connect(self._path)
        return self._database


def _connect(path: Path) -> sqlite3.Connection:
    database = sqlite3.connect(path, check_same_thread=False)
    database.execute("PRAGMA journal_mode = WAL")
    database.execute(
        "CREATE TABLE IF NOT EXISTS confirmed "
        "(name TEXT PRIMARY KEY, size INTEGER, modified INTEGER, inode INTEGER) WITHOUT ROWID"
    )
    return database
