"""Turns errors of the databases into those of this project, without paths, parameters or passwords."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import exc

from relay_protocol.errors import Invalid, Unavailable

_SQLITE = {
    sqlite3.SQLITE_BUSY: "the database is locked by another process; try again",
    sqlite3.SQLITE_LOCKED: "the database is locked by another process; try again",
    sqlite3.SQLITE_FULL: "the disk with the database is full; free some space",
    sqlite3.SQLITE_READONLY: "the database can't be written; check the owner and mode of its file and folder",
    sqlite3.SQLITE_CANTOPEN: "the database file can't be opened; check that it exists and is readable",
    sqlite3.SQLITE_IOERR: "the disk with the database reports errors; check it",
    sqlite3.SQLITE_CORRUPT: "the database file is damaged; restore a backup",
    sqlite3.SQLITE_NOTADB: "the database file is not an SQLite database; give another folder or restore a backup",
    sqlite3.SQLITE_PERM: "the database file can't be opened; check its owner and mode",
    sqlite3.SQLITE_NOLFS: "the file system cannot hold a database of this size",
    sqlite3.SQLITE_PROTOCOL: "the database is locked by another process; try again",
    sqlite3.SQLITE_NOMEM: "there is no memory left for the database",
}
"""Primary result codes (https://www.sqlite.org/rescode.html) that a correct query can cause."""

_POSTGRES = {
    "08": "the database server can't be reached",
    "28": "the database server refuses the connection; check user, password and database in the database URL",
    "40": "the change conflicts with another one; try again",
    "53": "the database server is out of disk, memory or connections",
    "55": "the database is locked by another process; try again",
    "57": "the database server is shutting down or cancelled the query; try again",
    "58": "the disk of the database server reports errors",
    "25": "the database server is read-only; give the URL of the primary",
}
"""Classes of SQLSTATE (PostgreSQL manual, appendix A) that a correct query can cause."""

_PRIMARY = 0xFF

_NO_SUCH_TABLE = "no such "
"""Prefix of SQLite's message if a table or column is missing; the error code is that of any invalid query."""

_NUL = "NUL (0x00)"
"""Part of the message of PostgreSQL's driver about a text that it can't send; there is no SQLSTATE."""

_INCOMPLETE = "the database lacks tables of this version; restore a backup, or give an empty one"
_SETTING = "the database URL has a setting that PostgreSQL's driver does not know; check the part after '?'"


@contextmanager
def translated_errors() -> Iterator[None]:
    """Turn database errors into :class:`Unavailable`. Errors of invalid queries are not changed.

    :raises Invalid: a text has the character NUL, which PostgreSQL does not store
    :raises Unavailable: locked, full, unreachable, or in conflict with another change
    """
    try:
        yield
    except exc.IntegrityError as error:
        raise Unavailable("the change conflicts with another one; try again") from error
    except exc.TimeoutError as error:
        raise Unavailable("all connections to the database are busy; try again") from error
    except (exc.DBAPIError, sqlite3.Error) as error:
        message = _message(error)
        if message is None and _NUL in str(getattr(error, "orig", "")):
            raise Invalid("a text may not contain the character NUL") from error
        if message is None:
            raise
        raise Unavailable(message) from error
    except OSError as error:
        raise Unavailable(f"the database file can't be used: {error.strerror}") from error


def _message(error: exc.DBAPIError | sqlite3.Error) -> str | None:
    original = error if isinstance(error, sqlite3.Error) else error.orig
    if isinstance(original, sqlite3.Error):
        if str(original).startswith(_NO_SUCH_TABLE):
            return _INCOMPLETE
        code = getattr(original, "sqlite_errorcode", sqlite3.SQLITE_ERROR)
        return _SQLITE.get(code & _PRIMARY)
    state = getattr(original, "sqlstate", None)
    if state is None and isinstance(error, exc.DBAPIError):
        return _unconnected(error)
    return _INCOMPLETE if state in ("42P01", "42703") else _POSTGRES.get(str(state)[:2])


def _unconnected(error: exc.DBAPIError) -> str | None:
    """The message for an error while connecting, which has no SQLSTATE. FATAL means that the server refuses."""
    if isinstance(error, exc.ProgrammingError):
        return _SETTING
    if not isinstance(error, (exc.OperationalError, exc.InterfaceError)) and not error.connection_invalidated:
        return None
    return _POSTGRES["28"] if "FATAL" in str(error.orig) else _POSTGRES["08"]
