"""Opens the database, SQLite embedded or PostgreSQL by URL, and hands out transactions."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import URL, Connection, Engine, make_url
from sqlalchemy.exc import ArgumentError
from sqlalchemy.orm import Session

from relay_db import postgres, schema, sqlite
from relay_db.failures import in_words
from relay_protocol.errors import Invalid

_POSTGRES_NAMES = {"postgresql", "postgres", "postgresql+psycopg"}

_SQLITE_NAMES = {"sqlite", "sqlite+pysqlite"}


class Database:
    """One database. Methods may be called from any thread; a session belongs to the thread that opened it.

    :param url: ``sqlite:///FILE`` (created with its folder, for its owner only) or ``postgresql://…``
    :raises Invalid: a URL of another kind, or PostgreSQL without its driver
    :raises Unavailable: the file can't be made or used
    """

    writers: int
    """How many write transactions can run at a time; more threads than that only wait."""

    def __init__(self, url: str) -> None:
        parsed = _parse(url)
        self.url = parsed.render_as_string(hide_password=True)
        if parsed.get_backend_name() == "sqlite":
            self.writers = 1
            with in_words():
                self._engine = sqlite.open_engine(parsed)
        else:
            self.writers = postgres.WRITERS
            self._engine = postgres.open_engine(parsed)
        self._reading = _view(self._engine, write=False)
        self._writing = _view(self._engine, write=True)

    def upgrade(self) -> None:
        """Bring the tables up to date. Several processes may do so at once: one works, the others wait.

        :raises Unavailable: the database can't be reached, or was written by newer code
        """
        with in_words():
            with self._reading.connect() as connection:
                if schema.is_current(connection):
                    return
            with self._writing.begin() as connection:
                schema.upgrade(connection)

    @contextmanager
    def begin(self) -> Iterator[Session]:
        """One write transaction: committed at the end, rolled back by any error.

        :raises Unavailable: locked, full, unreachable, or overtaken by another change
        """
        with in_words(), Session(self._writing) as session, session.begin():
            yield session

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """A session that sees one state of the database and can't change it.

        :raises Unavailable: locked or unreachable
        """
        with in_words(), Session(self._reading) as session, session.begin():
            yield session

    @contextmanager
    def connection(self) -> Iterator[Connection]:
        """A bare connection in one write transaction, for tools that look at the tables themselves."""
        with in_words(), self._writing.begin() as connection:
            yield connection

    def close(self) -> None:
        """Give up all idle connections."""
        self._engine.dispose()


def _view(engine: Engine, *, write: bool) -> Engine:
    """The same pool with another kind of transaction."""
    if engine.dialect.name == "sqlite":
        return engine.execution_options(**{sqlite.WRITE: write})
    if write:
        return engine
    return engine.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)


def _parse(url: str) -> URL:
    scheme, _, path = url.partition(":///")
    if scheme in _SQLITE_NAMES:
        if path in ("", ":memory:") or "?" in path:
            raise Invalid("give the database a file: sqlite:///FILE, without anything after it")
        # taken as it is: whether SQLAlchemy decodes %20 in a path depends on its version
        return URL.create("sqlite", database=path)
    try:
        parsed = make_url(url)
    except (ArgumentError, ValueError):  # the second for a port that is no number
        raise Invalid(
            "this is no database URL; write sqlite:///FILE or postgresql://USER@HOST/NAME"
        ) from None
    if parsed.drivername in _POSTGRES_NAMES:
        return parsed.set(drivername="postgresql+psycopg")
    if parsed.drivername in _SQLITE_NAMES:
        raise Invalid("give the database a file: sqlite:///FILE")
    raise Invalid(f"'{parsed.drivername}' is no database known here; use sqlite or postgresql")
