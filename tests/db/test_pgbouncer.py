"""PostgreSQL behind PgBouncer with transaction pooling: no transaction may rely on the session of the one before."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from sqlalchemy import text

from relay_db import queries
from relay_db.engine import Database
from tests.worlds.pgbouncer import pgbouncer


@pytest.fixture
def pooled(empty_postgres_url: str) -> Iterator[Database]:
    """A database that was created through PgBouncer."""
    # Outside pytest's folder, which other users cannot enter.
    with tempfile.TemporaryDirectory(prefix="pgbouncer-") as name:
        folder = Path(name)
        folder.chmod(0o755)
        with pgbouncer(empty_postgres_url, folder) as url:
            database = Database(url)
            database.upgrade()
            yield database
            database.close()


def test_transactions_of_several_connections_share_servers(pooled: Database) -> None:
    """The same statements go to either server, often enough to be prepared by a driver that does so."""
    with pooled.begin() as s:
        queries.add_user(s, "ann", None)

    def look(number: int) -> list[str]:
        with pooled.reading() as s:
            return [each.name for each in queries.list_users(s)]

    with ThreadPoolExecutor(6) as pool:
        assert all(names == ["ann"] for names in pool.map(look, range(120)))


def test_each_transaction_has_its_time_limits(pooled: Database) -> None:
    """Also on a server whose session was changed by another client."""
    for begin in (pooled.begin, pooled.reading):
        with begin() as s:
            limits = {
                name: s.execute(text(f"SHOW {name}")).scalar()
                for name in ("lock_timeout", "statement_timeout")
            }
        assert limits == {"lock_timeout": "5s", "statement_timeout": "20s"}
