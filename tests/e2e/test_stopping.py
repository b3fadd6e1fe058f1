"""A relay that is told to end, ends, whatever its database does."""

from __future__ import annotations

import sqlite3
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest
from switchboard_harness import Relay


def test_sigterm_ends_a_relay_whose_database_is_locked(tmp_path: Path) -> None:
    """Writes that wait for a locked database are given up; the relay leaves with exit code 0 within 10 s."""
    relay = Relay(tmp_path)
    relay.user("ann")
    locker = sqlite3.connect(relay.data / "switchboard.db")
    try:
        locker.execute("BEGIN IMMEDIATE")
        for _ in range(3):  # each leaves an event that can't be written
            request = urllib.request.Request(
                f"http://127.0.0.1:{relay.http_port}/api/v1/session",
                b'{"user": "ann", "password": "not hers"}',
                {"Content-Type": "application/json"},
            )
            with pytest.raises(urllib.error.HTTPError):
                urllib.request.urlopen(request, timeout=10)
        begun = time.monotonic()
        assert relay.stop() == 0
        assert time.monotonic() - begun < 10
    finally:
        locker.close()
