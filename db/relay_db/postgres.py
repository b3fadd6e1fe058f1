"""Settings for PostgreSQL: a lost server is noticed in seconds, and every query has a time limit."""

from __future__ import annotations

from sqlalchemy import URL, Engine, create_engine

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
    "options": "-c lock_timeout=5s -c statement_timeout=20s -c idle_in_transaction_session_timeout=60s",
}
"""libpq parameters, which the URL may override. Seconds; tcp_user_timeout in milliseconds."""


def open_engine(url: URL) -> Engine:
    """:raises Invalid: psycopg is not installed"""
    arguments = {name: value for name, value in _DEFAULTS.items() if name not in url.query}
    try:
        return create_engine(
            url,
            connect_args=arguments,
            pool_size=WRITERS,
            max_overflow=WRITERS,
            pool_timeout=5,
            pool_pre_ping=True,
            hide_parameters=True,
        )
    except ImportError:
        raise Invalid(
            "PostgreSQL needs its driver: install robot-switchboard with the extra 'postgresql'"
        ) from None
