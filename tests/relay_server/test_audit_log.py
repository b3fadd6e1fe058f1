"""Audit entries survive a database that cannot be written."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock, deferLater
from twisted.logger import LogLevel, capturedLogs, formatEvent

from relay_db import queries, sqlite
from relay_db.queries import AuditRecord
from relay_server import audit_log as module
from relay_server.audit_log import (
    BATCH,
    CLOSE_SECONDS,
    FILE,
    RETRY_SECONDS,
    UNREADABLE,
    AuditLog,
    AuditLogEntry,
)
from relay_server.common.database import AsyncDatabase

ROVER = 7


class Scene:
    """An audit log on a real SQLite file; its retries wait for the test."""

    def __init__(self, store: AsyncDatabase, folder: Path) -> None:
        self.store, self.folder = store, folder
        self.clock = Clock()
        self.reported: list[tuple[str, int]] = []
        self.audit = self.another()

    def another(self) -> AuditLog:
        """The audit log of the next relay."""
        return AuditLog(
            self.clock, self.store, self.folder, lambda kind, robot: self.reported.append((kind, robot))
        )

    def append(self, *numbers: int) -> None:
        """Appends entries with these times."""
        for number in numbers:
            self.audit.append(
                AuditLogEntry(number, "user:ann", "control.taken", "rover", data={}, robots=(ROVER,))
            )

    async def settled(self, audit: AuditLog | None = None) -> None:
        """Waits until no write is active."""
        while (audit or self.audit)._writing:
            await deferLater(reactor, 0.01)  # type: ignore[arg-type]  # to mypy it is a module

    async def tries_again(self) -> None:
        """The pause after a failure ends."""
        self.clock.advance(RETRY_SECONDS)
        await self.settled()

    async def kept(self) -> list[AuditRecord]:
        """Entries in the database, whose chain must be valid."""
        assert await self.store.read(queries.verify_audit) is None
        return (await self.store.read(queries.list_audit, limit=10_000))[::-1]

    async def times(self) -> list[float]:
        """Times of these entries."""
        return [each.at for each in await self.kept()]


@pytest.fixture
def scene(store: AsyncDatabase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scene:
    """An empty audit log. A write to a locked file fails soon."""
    monkeypatch.setattr(sqlite, "BUSY_SECONDS", 0.05)
    return Scene(store, tmp_path)


@contextmanager
def locked(scene: Scene) -> Iterator[None]:
    """Another process holds the lock of the file."""
    other = sqlite3.connect(scene.folder / "switchboard.db", isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    try:
        yield
    finally:
        other.execute("ROLLBACK")
        other.close()


@contextmanager
def full(scene: Scene) -> Iterator[None]:
    """SQLite may not enlarge the file, on each connection."""

    def limit(on: bool) -> None:
        with scene.store.database.connection() as connection:
            pages = connection.exec_driver_sql("PRAGMA page_count").scalar() if on else 1_000_000
            connection.exec_driver_sql(f"PRAGMA max_page_count = {pages}")

    limit(True)
    try:
        yield
    finally:
        limit(False)


@pytest_twisted.ensureDeferred
async def test_entries_of_a_locked_database_are_written_in_order_with_their_time(scene: Scene) -> None:
    """For any number of failures; later entries follow."""
    with locked(scene):
        scene.append(1, 2)
        await scene.settled()
        scene.append(3)
        await scene.tries_again()
        assert await scene.times() == []
    scene.append(4)
    await scene.tries_again()
    assert await scene.times() == [1, 2, 3, 4]
    assert scene.reported == []


@pytest_twisted.ensureDeferred
async def test_entries_of_a_full_disk_are_written_when_there_is_room(scene: Scene) -> None:
    """SQLITE_FULL: a transaction that does not fit waits as a whole."""
    with full(scene):
        for first in range(0, 1000, 50):
            scene.append(*range(first, first + 50))
            await scene.settled()
            if scene.audit._retry is not None:
                break
        assert scene.audit._retry is not None
        before = await scene.times()
        assert len(before) < first + 50
    await scene.tries_again()
    assert await scene.times() == list(range(first + 50))


@pytest_twisted.ensureDeferred
async def test_lost_entries_are_one_entry_and_an_event(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes the place of the lost ones, with their number and their last time."""
    monkeypatch.setattr(module, "WAITING", 3)
    with locked(scene), capturedLogs() as logs:
        scene.append(1, 2, 3, 4, 5)
        await scene.settled()
        assert scene.reported == [("audit.lost", ROVER)] * 2
    lines = [formatEvent(each) for each in logs if each["log_level"] is LogLevel.error]
    assert (
        lines == ["'control.taken' of rover by user:ann is not on record: the database does not keep up"] * 2
    )
    await scene.tries_again()
    scene.append(6)
    await scene.settled()
    kept = await scene.kept()
    assert [each.at for each in kept] == [1, 2, 3, 4, 6]
    assert (kept[3].actor, kept[3].action, kept[3].data) == ("relay", "audit.lost", {"count": 2, "until": 5})
    assert scene.reported[2:] == [("audit.written", ROVER)]
    assert scene.audit.lost == 2


@pytest_twisted.ensureDeferred
async def test_many_are_written_in_several_transactions(scene: Scene) -> None:
    """In order."""
    numbers = list(range(3 * BATCH + 1))
    with locked(scene):
        scene.append(*numbers)
        await scene.settled()
    await scene.tries_again()
    assert await scene.times() == numbers


@pytest_twisted.ensureDeferred
async def test_an_entry_that_can_not_be_written_at_all_holds_up_no_other(scene: Scene) -> None:
    with locked(scene), capturedLogs() as logs:
        scene.append(1)
        scene.audit.append(
            AuditLogEntry(2, "user:ann", "x", "rover", data={"bad": float("nan")}, robots=(ROVER,))
        )
        scene.append(3)
        await scene.settled()
    with capturedLogs() as logs:
        await scene.tries_again()
    kept = await scene.kept()
    assert [(each.at, each.action) for each in kept] == [
        (1, "control.taken"),
        (3, "control.taken"),
        (2, "audit.lost"),
    ]
    assert kept[2].data == {"count": 1, "until": 2}
    assert any("not on record" in str(formatEvent(each)) for each in logs)
    assert scene.reported == [("audit.lost", ROVER), ("audit.written", ROVER)]


@pytest_twisted.ensureDeferred
async def test_waiting_entries_are_written_by_the_next_relay(scene: Scene) -> None:
    """They are read from a file with restricted permissions, which is removed afterwards."""
    before = os.umask(0)
    try:
        with locked(scene):
            scene.append(1, 2)
            await scene.settled()
            closing = Deferred.fromCoroutine(scene.audit.close())
            await scene.settled()
            scene.clock.advance(CLOSE_SECONDS)
            await closing
    finally:
        os.umask(before)
    path = scene.folder / FILE
    assert path.stat().st_mode & 0o777 == 0o600
    following = scene.another()
    following.restore()
    await scene.settled(following)
    assert await scene.times() == [1, 2]
    assert not path.exists()


@pytest_twisted.ensureDeferred
async def test_an_entry_of_that_file_that_is_in_the_database_already_is_not_written_twice(
    scene: Scene,
) -> None:
    """A commit may succeed without the relay noticing."""
    scene.append(1, 2)
    await scene.settled()
    line = b'{"at":%d,"actor":"user:ann","action":"control.taken","target":"rover"}\n'
    (scene.folder / FILE).write_bytes(line % 2 + line % 3 + b"{broken\n")
    following = scene.another()
    following.restore()
    await scene.settled(following)
    assert await scene.times() == [1, 2, 3]
    assert following.lost == 1
    assert b"{broken" in (scene.folder / UNREADABLE).read_bytes()
    assert not (scene.folder / FILE).exists()


@pytest_twisted.ensureDeferred
async def test_a_relay_that_stops_in_order_leaves_no_file(scene: Scene) -> None:
    """All entries are written before the end, including those that waited for a retry."""
    with locked(scene):
        scene.append(1)
        await scene.settled()
    await scene.audit.close()
    assert await scene.times() == [1]
    assert not (scene.folder / FILE).exists()


@pytest_twisted.ensureDeferred
async def test_entries_that_cannot_be_stored_are_logged(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With all their fields."""

    def no_space(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with locked(scene), capturedLogs() as logs:
        scene.append(1)
        await scene.settled()
        closing = Deferred.fromCoroutine(scene.audit.close())
        await scene.settled()
        scene.clock.advance(CLOSE_SECONDS)
        await closing
    (line,) = [formatEvent(each) for each in logs if each["log_level"] is LogLevel.critical]
    assert line.startswith("not on record, No space left on device: AuditLogEntry(at=1")
    assert "control.taken" in line and "user:ann" in line
