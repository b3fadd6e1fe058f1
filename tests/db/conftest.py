"""Real databases: a SQLite file and a PostgreSQL server, a fresh one of both kinds for each test."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import count
from pathlib import Path

import pgserver
import psycopg
import pytest

from relay_db.engine import Database
from tests.worlds.empty_database import write_empty_database

EMPTY = "template0"


@pytest.fixture(scope="session")
def postgres() -> Iterator[str]:
    """URL of the database ``postgres`` of a new server.

    Outside pytest's folder: the next run closes that to other users, and under root the server runs as
    another user.
    """
    folder = Path(tempfile.mkdtemp(prefix="pg-of-tests-"))
    server = pgserver.get_server(folder / "data", cleanup_mode="stop")
    try:
        with psycopg.connect(server.get_uri(), autocommit=True) as connection:
            # no data here needs to survive a power cut
            connection.execute("ALTER SYSTEM SET fsync = off")
            connection.execute("SELECT pg_reload_conf()")
        yield server.get_uri()
    finally:
        server.cleanup()
        shutil.rmtree(folder, ignore_errors=True)


Copies = Callable[[str], AbstractContextManager[str]]
"""Makes the URL of a PostgreSQL database copied from a template, and drops the database at the end."""


@pytest.fixture(scope="session")
def copies(postgres: str) -> Iterator[Copies]:
    """Databases for the duration of a block."""
    numbers = count(1)
    assert "/postgres?" in postgres
    with psycopg.connect(postgres, autocommit=True) as connection:

        @contextmanager
        def copy(template: str) -> Iterator[str]:
            name = f"test_{next(numbers)}"
            connection.execute(f'CREATE DATABASE "{name}" TEMPLATE "{template}"')
            yield postgres.replace("/postgres?", f"/{name}?")
            connection.execute(f'DROP DATABASE "{name}" WITH (FORCE)')

        yield copy


@pytest.fixture(scope="session")
def with_tables(copies: Copies) -> Iterator[str]:
    """Name of a PostgreSQL database that was brought up from empty, to be copied."""
    with copies(EMPTY) as url:
        upgraded = Database(url)
        upgraded.upgrade()
        upgraded.close()
        yield url.partition("?")[0].rpartition("/")[2]


@pytest.fixture
def sqlite_url(tmp_path: Path) -> str:
    """URL of a SQLite database that is not there yet."""
    return f"sqlite:///{tmp_path}/data/switchboard.db"


@pytest.fixture
def full_sqlite_url(sqlite_url: str) -> str:
    """URL of a SQLite database with all tables."""
    write_empty_database(Path(sqlite_url.removeprefix("sqlite:///")))
    return sqlite_url


@pytest.fixture
def postgres_url(copies: Copies, with_tables: str) -> Iterator[str]:
    """URL of a PostgreSQL database with all tables."""
    with copies(with_tables) as url:
        yield url


@pytest.fixture
def empty_postgres_url(copies: Copies) -> Iterator[str]:
    """URL of an empty PostgreSQL database."""
    with copies(EMPTY) as url:
        yield url


@pytest.fixture(params=["sqlite_url", "empty_postgres_url"], ids=["sqlite", "postgresql"])
def empty_url(request: pytest.FixtureRequest) -> str:
    """URL of an empty database, of each kind in turn."""
    made: str = request.getfixturevalue(request.param)
    return made


@pytest.fixture(params=["full_sqlite_url", "postgres_url"], ids=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest) -> str:
    """URL of the database of :func:`database`, of each kind in turn."""
    made: str = request.getfixturevalue(request.param)
    return made


@pytest.fixture
def database(url: str) -> Iterator[Database]:
    """A database with all tables, of each kind in turn."""
    opened = Database(url)
    yield opened
    opened.close()


@pytest.fixture
def sqlite(full_sqlite_url: str) -> Iterator[Database]:
    """A SQLite database with all tables."""
    opened = Database(full_sqlite_url)
    yield opened
    opened.close()


@pytest.fixture
def postgresql(postgres_url: str) -> Iterator[Database]:
    """A PostgreSQL database with all tables."""
    opened = Database(postgres_url)
    yield opened
    opened.close()
