"""Settings for PostgreSQL: a lost server is noticed in seconds, and every query has a time limit."""

from __future__ import annotations

from typing import Any

from sqlalchemy import URL, Connection, Engine, create_engine, event

from relay_protocol.errors import Invalid

WRITERS = 4
"""Write transactions at a time; changes are small and rare."""

_DEFAULTS = {
    "connect_timeout": "5",
    "keepalives_idle": "5",
    "keepalives_interval": "2",
    "keepalives_count": "3",
    "tcp_user_timeout": "8000",
    "application_name": "switchboard",
}
"""libpq parameters, which the URL may override. Seconds; tcp_user_timeout in milliseconds."""

_TRANSACTION = (
    "SET LOCAL lock_timeout = '5s'; SET LOCAL statement_timeout = '20s'; "
    "SET LOCAL idle_in_transaction_session_timeout = '60s'"
)
"""Begins each transaction. A pooler such as PgBouncer passes on no settings of a session."""


def open_engine(url: URL) -> Engine:
    """:raises Invalid: psycopg is not installed"""
    arguments: dict[str, Any] = {name: value for name, value in _DEFAULTS.items() if name not in url.query}
    # A pooler may give the next transaction another server, which lacks the prepared statements.
    arguments["prepare_threshold"] = None
    try:
        engine = create_engine(
            url,
            connect_args=arguments,
            pool_size=WRITERS,
            max_overflow=WRITERS,
            pool_timeout=5,
            pool_pre_ping=True,
            hide_parameters=True,
        )
        if "options" not in url.query:
            event.listen(engine, "begin", _limit_transaction)
        return engine
    except ImportError:
        raise Invalid(
            "PostgreSQL needs its driver: install robot-switchboard with the extra 'postgresql'"
        ) from None


def _limit_transaction(connection: Connection) -> None:
    connection.exec_driver_sql(_TRANSACTION)
