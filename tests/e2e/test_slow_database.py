"""Writes to a slow database are completed, even after the client has left."""

from __future__ import annotations

import socket
import sqlite3
from collections.abc import Iterator
from contextlib import closing

import httpx
import pytest

from tests.worlds.relay_process import Relay
from tests.worlds.waiting import PATIENCE, wait_for


@pytest.fixture(scope="module")
def relay(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Relay]:
    """A relay on a SQLite file."""
    started = Relay(tmp_path_factory.mktemp("slow"))
    yield started
    started.stop()


def status(relay: Relay, token: str) -> int:
    """The status of a session's request."""
    url = f"http://127.0.0.1:{relay.http_port}/api/v1/session"
    return httpx.get(url, headers={"Authorization": f"Bearer {token}"}, timeout=PATIENCE).status_code


def logs_out(relay: Relay, token: str) -> socket.socket:
    """A user logs out, as bytes."""
    connection = socket.create_connection(("127.0.0.1", relay.http_port), timeout=PATIENCE)
    head = f"DELETE /api/v1/session HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {token}\r\n\r\n"
    connection.sendall(head.encode())
    return connection


def test_logout_completes_when_the_page_is_closed_at_once(relay: Relay) -> None:
    """While another write occupies the database."""
    relay.user("ann")
    waits, leaves, witness = (relay.token("ann") for _ in range(3))
    assert {status(relay, each) for each in (waits, leaves, witness)} == {200}
    path = relay.data / "switchboard.db"
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        waiting = logs_out(relay, waits)
        assert status(relay, witness) == 200
        logs_out(relay, leaves).close()
        # Each on its own connection: the relay has seen the disconnection by now.
        assert [status(relay, witness) for _ in range(3)] == [200] * 3
        other.execute("ROLLBACK")
    with waiting:
        assert waiting.recv(100).startswith(b"HTTP/1.1 204")
    wait_for("the session is over", lambda: status(relay, leaves) == 401)
    assert status(relay, witness) == 200
