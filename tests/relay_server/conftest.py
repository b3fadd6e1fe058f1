"""A relay world in memory, and a relay's database in a file, for tests of the relay's parts."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from twisted.internet import reactor

from relay_db.engine import Database
from relay_server.common.database import AsyncDatabase
from tests.worlds.empty_database import write_empty_database
from tests.worlds.relay import Time, World
from tests.worlds.session_manager import SessionsWorld


@pytest.fixture
def world() -> World:
    """One offline robot, and no clients."""
    return World()


@pytest.fixture
def time() -> Time:
    """A clock at 1000 s."""
    return Time()


@pytest.fixture
def database(tmp_path: Path) -> Database:
    """A new database; :func:`store` closes it."""
    path = tmp_path / "switchboard.db"
    write_empty_database(path)
    return Database(f"sqlite:///{path}")


@pytest.fixture
def store(database: Database) -> Iterator[AsyncDatabase]:
    """A relay's database access, on the reactor of the tests."""
    running = AsyncDatabase(reactor, database)  # type: ignore[arg-type]  # to mypy it is a module
    running.start()
    yield running
    running.stop()


@pytest.fixture
def front(store: AsyncDatabase) -> Iterator[SessionsWorld]:
    """A session manager; ann operates rover and does not know of the robot hidden."""
    made = SessionsWorld(store)
    yield made
    made.auth.stop()
