"""Opens the database, embedded SQLite or PostgreSQL, and begins transactions."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sqlalchemy import URL, Connection, Engine, make_url
from sqlalchemy.exc import ArgumentError
from sqlalchemy.orm import Session

from relay_db import postgres, schema, sqlite
from relay_db.failures import translated_errors
from relay_protocol.errors import Invalid

_POSTGRES_NAMES = {"postgresql", "postgres", "postgresql+psycopg"}

_SQLITE_NAMES = {"sqlite", "sqlite+pysqlite"}


class Database:
    """One database. Methods may be called from any thread; a session belongs to the thread that opened it.

    :param url: ``sqlite:///FILE`` (created with its folder, readable by the owner only) or ``postgresql://…``
    :raises Invalid: a URL of another kind, or PostgreSQL without its driver
    :raises Unavailable: the file cannot be created or used
    """

    writers: int
    """Write transactions that can run at a time."""

    def __init__(self, url: str) -> None:
        parsed = _parse(url)
        self.url = parsed.render_as_string(hide_password=True)
        if parsed.get_backend_name() == "sqlite":
            self.writers = 1
            with translated_errors():
                self._engine = sqlite.open_engine(parsed)
        else:
            self.writers = postgres.WRITERS
            self._engine = postgres.open_engine(parsed)
        self._reading = _view(self._engine, write=False)
        self._writing = _view(self._engine, write=True)

    def upgrade(self) -> None:
        """Create or upgrade the tables. Of several processes one does it, and the others wait.

        :raises Unavailable: the database cannot be reached, or was written by a newer version
        """
        with translated_errors():
            with self._reading.connect() as connection:
                if schema.is_current(connection):
                    return
            with self._writing.begin() as connection:
                schema.upgrade(connection)

    @contextmanager
    def begin(self) -> Iterator[Session]:
        """A write transaction: committed at the end, rolled back by any error.

        :raises Unavailable: locked, full, unreachable, or in conflict with another change
        """
        with translated_errors(), Session(self._writing) as session, session.begin():
            yield session

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """A session that sees one state of the database and cannot change it.

        :raises Unavailable: locked or unreachable
        """
        with translated_errors(), Session(self._reading) as session, session.begin():
            yield session

    @contextmanager
    def connection(self) -> Iterator[Connection]:
        """A connection in a write transaction, for tools that work on the tables directly."""
        with translated_errors(), self._writing.begin() as connection:
            yield connection

    def close(self) -> None:
        """Close all idle connections."""
        self._engine.dispose()


def copy_database(url: str, target: Path) -> None:
    """Copy an SQLite database of any version, also while a relay uses it.

    :param target: a new file
    :raises Invalid: the database is no file
    :raises Unavailable: it can't be read, or the copy can't be written
    """
    parsed = _parse(url)
    if parsed.get_backend_name() != "sqlite":
        raise Invalid("PostgreSQL is copied by pg_dump; this command copies SQLite databases")
    assert parsed.database is not None
    with translated_errors():
        sqlite.copy(Path(parsed.database).absolute(), target)


def _view(engine: Engine, *, write: bool) -> Engine:
    """The same connection pool, with transactions that may write or not."""
    if engine.dialect.name == "sqlite":
        return engine.execution_options(**{sqlite.WRITE: write})
    if write:
        return engine
    return engine.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)


def _parse(url: str) -> URL:
    scheme, _, path = url.partition(":///")
    if scheme in _SQLITE_NAMES:
        if path in ("", ":memory:") or "?" in path:
            raise Invalid("the database URL needs a file and nothing after it: write sqlite:///FILE")
        # Not parsed by SQLAlchemy: whether it decodes %20 in a path depends on its version.
        return URL.create("sqlite", database=path)
    try:
        parsed = make_url(url)
    except (ArgumentError, ValueError):  # ValueError for a port that is not a number
        raise Invalid(
            "this is not a database URL; write sqlite:///FILE or postgresql://USER@HOST/NAME"
        ) from None
    if parsed.drivername in _POSTGRES_NAMES:
        return parsed.set(drivername="postgresql+psycopg")
    if parsed.drivername in _SQLITE_NAMES:
        raise Invalid("the database URL needs a file: write sqlite:///FILE")
    raise Invalid(f"the database '{parsed.drivername}' is not supported; use sqlite or postgresql")
