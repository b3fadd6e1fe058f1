"""Failed logins by account, and networks that users have logged in from."""

from __future__ import annotations

import threading

from relay_db import queries
from relay_db.engine import Database
from relay_db.queries.login_limits import NETWORKS

ANN, BOB = "a" * 64, "b" * 64


def test_failures_of_an_account_count_until_they_expire(database: Database) -> None:
    with database.begin() as s:
        first = queries.add_login_failure(s, ANN, 10.0)
        queries.add_login_failure(s, ANN, 20.0)
        queries.add_login_failure(s, BOB, 30.0)
        assert sorted(queries.login_failures(s, ANN, 9.0)) == [10.0, 20.0]
        assert queries.login_failures(s, ANN, 10.0) == [20.0]
        queries.remove_login_failure(s, first)
        assert queries.login_failures(s, ANN, 9.0) == [20.0]
        assert queries.purge_expired(s, 20.0) == 1
        assert queries.login_failures(s, ANN, 0.0) == []
        assert queries.login_failures(s, BOB, 0.0) == [30.0]


def test_tries_at_the_same_time_count_each_other(database: Database) -> None:
    """As if one came after the other."""
    seen: list[int] = []

    def count() -> None:
        with database.begin() as s:
            seen.append(len(queries.login_failures(s, ANN, 0.0)))
            queries.add_login_failure(s, ANN, 10.0)

    threads = [threading.Thread(target=count) for _ in range(5)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert sorted(seen) == [0, 1, 2, 3, 4]


def test_the_latest_networks_of_a_user_are_remembered(database: Database) -> None:
    """A further login makes a network one of the latest."""
    with database.begin() as s:
        ann, bob = (queries.add_user(s, name, None).id for name in ("ann", "bob"))
        queries.remember_login_network(s, ann, "home", 1.0)
        queries.remember_login_network(s, bob, "home", 2.0)
        for number in range(NETWORKS):
            queries.remember_login_network(s, ann, f"n{number}", 10.0 + number)
            queries.remember_login_network(s, ann, "home", 10.5 + number)
        queries.remember_login_network(s, 99, "home", 1.0)
    with database.reading() as s:
        assert queries.last_login_from(s, ann, "home") == 9.5 + NETWORKS
        assert queries.last_login_from(s, ann, "n0") is None
        assert queries.last_login_from(s, ann, "n1") == 11.0
        assert queries.last_login_from(s, bob, "home") == 2.0
        assert queries.last_login_from(s, 99, "home") is None
    with database.begin() as s:
        queries.remove_user(s, bob)
        assert queries.last_login_from(s, bob, "home") is None
