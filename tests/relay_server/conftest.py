"""A world in memory, and a relay's database in a file, for the tests of the relay's parts."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from twisted.internet import reactor

from relay_db.engine import Database
from relay_server.common.database import AsyncDatabase
from tests.relay_server.front_desk import Desk
from tests.relay_server.memory import Time, World


@pytest.fixture
def world() -> World:
    """One robot, offline, and nobody there."""
    return World()


@pytest.fixture
def time() -> Time:
    """A thousand seconds after the beginning."""
    return Time()


@pytest.fixture(scope="session")
def upgraded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A SQLite file with all tables, to be copied."""
    path = tmp_path_factory.mktemp("db") / "switchboard.db"
    database = Database(f"sqlite:///{path}")
    database.upgrade()
    database.close()
    return path


@pytest.fixture
def database(upgraded: Path, tmp_path: Path) -> Database:
    """A database of its own; :func:`store` closes it."""
    path = tmp_path / "switchboard.db"
    shutil.copyfile(upgraded, path)
    return Database(f"sqlite:///{path}")


@pytest.fixture
def store(database: Database) -> Iterator[AsyncDatabase]:
    """The store of a relay, running on the reactor of the tests."""
    running = AsyncDatabase(reactor, database)  # type: ignore[arg-type]  # to mypy it is a module
    running.start()
    yield running
    running.stop()


@pytest.fixture
def front(store: AsyncDatabase) -> Iterator[Desk]:
    """A desk with ann, who operates rover and knows nothing of hidden."""
    made = Desk(store)
    yield made
    made.auth.stop()
