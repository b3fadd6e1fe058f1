"""Tasks that one relay of a cluster at a time holds a lease of."""

from __future__ import annotations

from relay_db import queries
from relay_db.engine import Database


def test_one_relay_at_a_time_has_a_task(database: Database) -> None:
    with database.begin() as s:
        assert queries.acquire_relay_lease(s, "alerts", "one", 15)
        assert not queries.acquire_relay_lease(s, "alerts", "two", 15)
        assert queries.acquire_relay_lease(s, "purges", "two", 15)
    with database.begin() as s:
        assert queries.acquire_relay_lease(s, "alerts", "one", 15)
        queries.release_relay_leases(s, "one")
        assert queries.acquire_relay_lease(s, "alerts", "two", 15)
        assert not queries.acquire_relay_lease(s, "purges", "one", 15)


def test_a_task_is_free_when_its_time_is_over(database: Database) -> None:
    with database.begin() as s:
        assert queries.acquire_relay_lease(s, "alerts", "one", -5)
        assert queries.acquire_relay_lease(s, "alerts", "two", 15)
        assert not queries.acquire_relay_lease(s, "alerts", "one", 15)
