"""A PostgreSQL server with an empty database."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pgserver
import psycopg


@contextmanager
def postgresql_database() -> Iterator[str]:
    """URL of an empty database on a new server.

    Its folder is outside pytest's, which other users cannot enter: under root the server runs as another user.
    """
    folder = Path(tempfile.mkdtemp(prefix="pg-of-e2e-"))
    server = pgserver.get_server(folder / "data", cleanup_mode="stop")
    try:
        with psycopg.connect(server.get_uri(), autocommit=True) as connection:
            connection.execute('CREATE DATABASE "relay"')
        yield server.get_uri().replace("/postgres?", "/relay?")
    finally:
        server.cleanup()
        shutil.rmtree(folder, ignore_errors=True)
