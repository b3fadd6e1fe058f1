"""Transactions, and errors of the database."""

from __future__ import annotations

import sys

import psycopg
import pytest
from sqlalchemy import text

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.errors import Invalid, Unavailable


def test_a_transaction_is_committed_at_its_end(database: Database) -> None:
    with database.begin() as s:
        queries.add_robot(s, "rover")
    with database.reading() as s:
        assert queries.find_robot(s, "rover") is not None


def test_an_error_rolls_the_transaction_back(database: Database) -> None:
    """An error in the block leaves nothing behind and is raised unchanged."""
    with pytest.raises(Invalid), database.begin() as s:
        queries.add_robot(s, "rover")
        queries.add_robot(s, "rover")
    with database.reading() as s:
        assert queries.find_robot(s, "rover") is None


def test_a_reading_session_cannot_write(database: Database) -> None:
    """The database refuses a change through reading(); later changes succeed."""
    with pytest.raises(Unavailable), database.reading() as s:
        queries.add_robot(s, "rover")
    with database.begin() as s:
        queries.add_robot(s, "rover")


def test_a_reading_session_sees_one_state(database: Database) -> None:
    """A change made meanwhile is not visible in a reading session that has begun."""
    with database.reading() as reader:
        before = queries.revision(reader)
        with database.begin() as s:
            queries.add_robot(s, "rover")
        assert queries.revision(reader) == before


def test_sqlite_has_one_writer_and_postgresql_several(sqlite: Database, postgresql: Database) -> None:
    assert sqlite.writers == 1
    assert postgresql.writers > 1


def test_a_locked_row_is_unavailable(postgresql: Database) -> None:
    """On PostgreSQL a change that waits too long for another fails with a reason."""
    with postgresql.begin() as holder:
        queries.add_robot(holder, "one")
        with pytest.raises(Unavailable, match="locked"), postgresql.begin() as s:
            s.execute(text("SET LOCAL lock_timeout = '50ms'"))
            queries.add_robot(s, "two")


def test_two_conflicting_changes_are_unavailable(postgresql: Database) -> None:
    """On PostgreSQL the second of two users of one name, added at once, is refused by the constraint."""
    with postgresql.begin() as s:
        realm = s.execute(text("SELECT id FROM realm")).scalar_one()
        insert = text(
            "INSERT INTO user_account (realm_id, name, admin, disabled) VALUES (:realm, 'ann', false, false)"
        )
        s.execute(insert, {"realm": realm})
    with pytest.raises(Unavailable, match="conflicts with another"), postgresql.begin() as s:
        s.execute(insert, {"realm": realm})


def test_a_text_with_the_character_nul_is_invalid(postgresql: Database) -> None:
    """PostgreSQL stores none; SQLite finds nothing by it."""
    with pytest.raises(Invalid, match="NUL"), postgresql.reading() as s:
        queries.find_role(s, "default", "a\0b")


def test_lost_connections_are_replaced(postgresql: Database, postgres_url: str) -> None:
    """When the server drops the connections, the next session gets a new one."""
    with postgresql.reading() as s:
        before = queries.revision(s)
    with psycopg.connect(postgres_url, autocommit=True) as other:
        other.execute(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
            "WHERE datname = current_database() AND pid <> pg_backend_pid()"
        )
    with postgresql.reading() as s:
        assert queries.revision(s) == before


def test_a_connection_lost_in_a_transaction_is_unavailable(postgresql: Database, postgres_url: str) -> None:
    """The change fails with a reason and nothing is written."""
    with pytest.raises(Unavailable), postgresql.begin() as s:
        queries.add_robot(s, "rover")
        with psycopg.connect(postgres_url, autocommit=True) as other:
            other.execute(
                "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
                "WHERE datname = current_database() AND pid <> pg_backend_pid()"
            )
        queries.add_robot(s, "other")
    with postgresql.reading() as s:
        assert queries.list_robots(s) == []


def test_an_absent_server_has_a_clear_error(free_port: int) -> None:
    """The error contains neither user nor password."""
    database = Database(f"postgresql://someone:hunter22@127.0.0.1:{free_port}/switchboard")
    with pytest.raises(Unavailable, match="can't be reached") as caught:
        database.upgrade()
    assert "hunter22" not in str(caught.value)
    assert "hunter22" not in database.url


@pytest.fixture
def free_port() -> int:
    """An unused port."""
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


def test_a_missing_database_has_a_clear_error(postgres_url: str) -> None:
    """A server without the named database."""
    database = Database(postgres_url.replace("/test_", "/nowhere_"))
    with pytest.raises(Unavailable, match="refuses the connection"):
        database.upgrade()


@pytest.mark.parametrize("scheme", ["postgresql", "postgres", "postgresql+psycopg"])
def test_the_usual_ways_to_name_postgresql_work(empty_postgres_url: str, scheme: str) -> None:
    """The driver need not be named."""
    database = Database(empty_postgres_url.replace("postgresql:", f"{scheme}:"))
    database.upgrade()
    with database.reading() as s:
        assert queries.revision(s) == 1
    database.close()


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("nonsense", "not a database URL"),
        ("mysql://host/name", "mysql"),
        ("sqlite://", "file"),
        ("sqlite:///:memory:", "file"),
        ("sqlite:///some.db?mode=ro", "nothing after it"),
    ],
)
def test_a_url_that_cannot_be_is_refused(url: str, words: str) -> None:
    """The error says what to write instead."""
    with pytest.raises(Invalid, match=words):
        Database(url)


def test_without_the_driver_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "psycopg", None)
    with pytest.raises(Invalid, match="extra 'postgresql'"):
        Database("postgresql://localhost/switchboard")


def test_errors_show_no_parameters(database: Database) -> None:
    """Values of a failed statement, among them hashes, stay out of errors and logs."""
    insert = text("INSERT INTO realm (id, name) VALUES (1, :name)")
    with pytest.raises(Unavailable) as caught, database.connection() as connection:
        connection.execute(insert, {"name": "f00dface"})
    assert "f00dface" not in str(caught.value)
    assert "f00dface" not in str(caught.value.__cause__)
