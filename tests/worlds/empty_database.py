"""A SQLite database with all tables, made once for each process: running all migrations takes a tenth of a second."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

from relay_db.engine import Database


@cache
def empty_database() -> bytes:
    """The file of a database that no relay has used yet."""
    with tempfile.TemporaryDirectory(prefix="empty-database-") as folder:
        path = Path(folder) / "switchboard.db"
        database = Database(f"sqlite:///{path}")
        database.upgrade()
        database.close()
        return path.read_bytes()


def write_empty_database(path: Path) -> None:
    """Write it where nothing is yet, with the modes a relay would give it."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    path.touch(mode=0o600)
    path.write_bytes(empty_database())
