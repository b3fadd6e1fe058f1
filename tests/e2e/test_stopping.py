"""A relay that is asked to end does so, for any state of its database."""

from __future__ import annotations

import signal
import sqlite3
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from tests.worlds.relay_process import Relay
from tests.worlds.waiting import wait_for


def test_sigterm_ends_a_relay_whose_database_is_locked(tmp_path: Path) -> None:
    """Writes that wait for a locked database are abandoned; the relay exits with 0."""
    relay = Relay(tmp_path)
    relay.user("ann")
    locker = sqlite3.connect(relay.data / "switchboard.db")
    try:
        locker.execute("BEGIN IMMEDIATE")
        for _ in range(3):  # each is counted in the database first, and waits for it
            request = urllib.request.Request(
                f"http://127.0.0.1:{relay.http_port}/api/v1/session",
                b'{"user": "ann", "password": "not hers"}',
                {"Content-Type": "application/json"},
            )
            with pytest.raises(OSError, match=r"timed out|HTTP Error"):
                urllib.request.urlopen(request, timeout=2)
        assert relay.stop() == 0
    finally:
        locker.close()


def test_further_signals_do_not_disturb_a_relay_that_ends(tmp_path: Path) -> None:
    """Repeated SIGTERM and Ctrl-C until it ends: it ends as by one, without further output."""
    relay = Relay(tmp_path)
    assert relay.process is not None
    process = relay.process

    def gone() -> bool:
        process.signal(signal.SIGTERM)
        process.signal(signal.SIGINT)
        return process.popen.poll() is not None

    wait_for("the relay has ended", gone)
    assert process.popen.returncode == 0
    assert "Traceback" not in relay.log
