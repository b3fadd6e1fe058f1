"""Users' actions on a robot are audited, even if the database fails meanwhile."""

from __future__ import annotations

import resource
import shutil
import sqlite3
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pgserver
import psutil
import psycopg
import pytest

from tests.worlds.relay_process import Relay
from tests.worlds.small_robot import SmallRobot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

DONE = ["control.taken", "robot.stopped", "robot.resumed", "control.released"]
"""What :func:`acts` leaves, in this order."""


class Breakdown:
    """A relay whose database fails and recovers."""

    def __init__(self, folder: Path, database: str | None = None) -> None:
        self.relay = Relay(folder, database=database)
        self.file = self.relay.data / "switchboard.db"

    @property
    def pid(self) -> int:
        """Process id of the relay."""
        assert self.relay.process is not None
        return self.relay.process.popen.pid

    @contextmanager
    def broken(self) -> Iterator[None]:
        """No write succeeds in this block."""
        yield

    def end(self) -> None:
        self.relay.stop()


class Locked(Breakdown):
    """Another process holds the lock of the SQLite file."""

    @contextmanager
    def broken(self) -> Iterator[None]:
        """See :class:`Breakdown`."""
        other = sqlite3.connect(self.file, isolation_level=None, timeout=60)
        other.execute("BEGIN IMMEDIATE")
        try:
            yield
        finally:
            other.execute("ROLLBACK")
            other.close()


class Full(Breakdown):
    """The database cannot grow; the relay's log, which is smaller, can."""

    @contextmanager
    def broken(self) -> Iterator[None]:
        """See :class:`Breakdown`."""
        wal = Path(f"{self.file}-wal")
        process = psutil.Process(self.pid)
        process.rlimit(resource.RLIMIT_FSIZE, (wal.stat().st_size, resource.RLIM_INFINITY))
        try:
            yield
        finally:
            process.rlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


class Stopped(Breakdown):
    """The PostgreSQL server is not running."""

    def __init__(self, folder: Path) -> None:
        # Outside pytest's folder, which other users cannot enter: under root the server runs as another
        # user.
        self._folder = Path(tempfile.mkdtemp(prefix="pg-of-audit-"))
        self._begin()
        with psycopg.connect(self._server.get_uri(), autocommit=True) as connection:
            connection.execute('CREATE DATABASE "relay"')
        super().__init__(folder, self._server.get_uri().replace("/postgres?", "/relay?"))

    def _begin(self) -> None:
        self._server = pgserver.get_server(self._folder / "data", cleanup_mode="stop")

    @contextmanager
    def broken(self) -> Iterator[None]:
        """See :class:`Breakdown`."""
        self._server.cleanup()
        try:
            yield
        finally:
            self._begin()

    def end(self) -> None:
        super().end()
        self._server.cleanup()
        shutil.rmtree(self._folder, ignore_errors=True)


def acts(client: Client, robot: SmallRobot) -> None:
    """A user takes control, stops the robot, resumes it and releases control."""
    for service in ("take_control", "stop", "resume", "release_control"):
        answer = client.call(f"/relay/{service}", {"why": "fire drill"})
        assert answer["values"]["success"], answer


@pytest.mark.parametrize("kind", [Locked, Full, Stopped])
def test_audit_entries_survive_an_absent_database(kind: type[Breakdown], tmp_path: Path) -> None:
    """In order, each with its own time, with a valid chain; this includes later actions."""
    world = kind(tmp_path)
    robot: SmallRobot | None = None
    try:
        relay = world.relay
        robot = SmallRobot(relay, "rover", {}).comes()
        token = relay.user("olga")
        relay.cli("right", "grant", "olga", "rover", "owner")
        with relay.connect("rover", token) as client:
            with world.broken():
                begun = time.time()
                acts(client, robot)
                ended = time.time()
                wait_for("writing has failed", lambda: "audit entries wait" in relay.log)
            client.call("/relay/take_control")
            wait_for("all is on record", lambda: len(entries(relay)) == len(DONE) + 1)
            kept = entries(relay)
        assert [each["action"] for each in kept] == [*DONE, "control.taken"]
        assert all(begun <= each["at"] <= ended for each in kept[: len(DONE)])
        assert {each["actor"] for each in kept} == {"user:olga"}
        assert relay.cli("audit", "verify")["whole"]
        assert "Traceback" not in relay.log
    finally:
        if robot is not None:
            robot.goes()
        world.end()


def test_audit_entries_waiting_at_a_stop_are_written_at_the_next_start(tmp_path: Path) -> None:
    """The database is locked until the relay has ended."""
    world = Locked(tmp_path)
    relay = world.relay
    robot = SmallRobot(relay, "rover", {}).comes()
    try:
        token = relay.user("olga")
        relay.cli("right", "grant", "olga", "rover", "owner")
        with world.broken(), relay.connect("rover", token) as client:
            acts(client, robot)
            relay.stop()
        relay.start()
        wait_for("all is on record", lambda: len(entries(relay)) >= len(DONE))
        assert [each["action"] for each in entries(relay)] == DONE
        assert relay.cli("audit", "verify")["whole"]
        assert not (relay.data / "audit.waiting").exists()
    finally:
        robot.goes()
        world.end()


def entries(relay: Relay) -> list[dict[str, str | float]]:
    """Entries of the audit log about control, oldest first."""
    found = relay.cli("audit", "list", "--limit", "1000")
    return [
        each for each in found if each["action"].startswith(("control.", "robot.stopped", "robot.resumed"))
    ]
