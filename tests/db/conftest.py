"""Real databases: a SQLite file and a PostgreSQL server, a fresh one of both kinds for each test."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import pgserver
import psycopg
import pytest

from relay_db.engine import Database


@pytest.fixture(scope="session")
def postgres() -> Iterator[str]:
    """URL of the database ``postgres`` of a server of our own.

    Not in pytest's folder: the next run that starts closes that to other users, and under root the server is
    another user's.
    """
    folder = Path(tempfile.mkdtemp(prefix="pg-of-tests-"))
    server = pgserver.get_server(folder / "data", cleanup_mode="stop")
    try:
        with psycopg.connect(server.get_uri(), autocommit=True) as connection:
            connection.execute("ALTER SYSTEM SET fsync = off")
            connection.execute("SELECT pg_reload_conf()")
        yield server.get_uri()
    finally:
        server.cleanup()
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def new_postgres_url(postgres: str) -> Iterator[Callable[[], str]]:
    """Makes URLs of empty PostgreSQL databases."""
    numbers = count(1)
    assert "/postgres?" in postgres
    with psycopg.connect(postgres, autocommit=True) as connection:

        def make() -> str:
            name = f"test_{next(numbers)}"
            connection.execute(f'CREATE DATABASE "{name}"')
            return postgres.replace("/postgres?", f"/{name}?")

        yield make


@pytest.fixture
def sqlite_url(tmp_path: Path) -> str:
    """URL of a SQLite database that is not there yet."""
    return f"sqlite:///{tmp_path}/data/switchboard.db"


@pytest.fixture
def postgres_url(new_postgres_url: Callable[[], str]) -> str:
    """URL of an empty PostgreSQL database."""
    return new_postgres_url()


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest) -> str:
    """URL of an empty database, of each kind in turn."""
    name = "sqlite_url" if request.param == "sqlite" else "postgres_url"
    made: str = request.getfixturevalue(name)
    return made


@pytest.fixture
def database(url: str) -> Iterator[Database]:
    """A database with all tables, of each kind in turn."""
    opened = Database(url)
    opened.upgrade()
    yield opened
    opened.close()


@pytest.fixture
def sqlite(sqlite_url: str) -> Iterator[Database]:
    """A SQLite database with all tables."""
    opened = Database(sqlite_url)
    opened.upgrade()
    yield opened
    opened.close()


@pytest.fixture
def postgresql(postgres_url: str) -> Iterator[Database]:
    """A PostgreSQL database with all tables."""
    opened = Database(postgres_url)
    opened.upgrade()
    yield opened
    opened.close()
