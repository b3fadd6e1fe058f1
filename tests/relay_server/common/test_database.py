"""Access to the database from the reactor."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import CancelledError, Deferred

from relay_db import queries
from relay_protocol.errors import Unavailable
from relay_server.common.database import READERS, AsyncDatabase, BoundedThreadPool


@pytest.fixture
def threads() -> Iterator[BoundedThreadPool]:
    """One thread and a queue of two."""
    running = BoundedThreadPool(reactor, "test", 1, 2, "come back later")  # type: ignore[arg-type]
    running.start()
    yield running
    running.stop()


@pytest_twisted.ensureDeferred
async def test_a_write_is_seen_by_the_next_read(store: AsyncDatabase) -> None:
    """The write is committed when it returns."""
    user = await store.write(queries.add_user, "ann", None)
    assert await store.read(queries.find_user, "ann") == user


@pytest_twisted.ensureDeferred
async def test_a_failed_write_leaves_nothing(store: AsyncDatabase) -> None:
    """The error is raised unchanged, and the transaction is rolled back."""

    def half(session: queries.Session) -> None:  # type: ignore[name-defined]
        queries.add_user(session, "ann", None)
        raise KeyError("half way")

    with pytest.raises(KeyError, match="half way"):
        await store.write(half)
    assert await store.read(queries.find_user, "ann") is None


@pytest_twisted.ensureDeferred
async def test_too_many_waiting_requests_are_refused_with_a_reason(threads: BoundedThreadPool) -> None:
    """The queue has room again when work is done."""
    go = threading.Event()
    waiting = [Deferred.fromCoroutine(threads.run(go.wait, 20)) for _ in range(2)]
    with pytest.raises(Unavailable, match="come back later"):
        await threads.run(int)
    go.set()
    for each in waiting:
        await each
    assert await threads.run(int, "7") == 7


@pytest_twisted.ensureDeferred
async def test_cancelled_requests_keep_their_place_until_the_work_is_done(threads: BoundedThreadPool) -> None:
    """Otherwise cancelled requests could fill the queue while a database hangs."""
    go = threading.Event()
    waiting = [Deferred.fromCoroutine(threads.run(go.wait, 20)) for _ in range(2)]
    for each in waiting:
        each.cancel()
        with pytest.raises(CancelledError):
            await each
    with pytest.raises(Unavailable):
        await threads.run(int)
    go.set()
    while threads._under_way:
        done: Deferred[None] = Deferred()
        reactor.callLater(0.005, done.callback, None)  # type: ignore[attr-defined]
        await done
    assert await threads.run(int, "7") == 7


@pytest_twisted.ensureDeferred
async def test_a_write_is_done_also_when_its_asker_has_left(store: AsyncDatabase) -> None:
    """A write waits its turn as before. A read without a caller is skipped."""
    go = threading.Event()
    done: list[str] = []
    busy = [Deferred.fromCoroutine(store.write(lambda session: go.wait(20)))]
    busy += [Deferred.fromCoroutine(store.read(lambda session: go.wait(20))) for _ in range(READERS)]
    left = Deferred.fromCoroutine(store.write(lambda session: done.append("written")))
    unread = Deferred.fromCoroutine(store.read(lambda session: done.append("read")))
    for each in (left, unread):
        each.cancel()
        with pytest.raises(CancelledError):
            await each
    go.set()
    for each in busy:
        assert await each
    await store.write(lambda session: done.append("next"))
    await store.read(lambda session: None)
    assert done == ["written", "next"]


@pytest_twisted.ensureDeferred
async def test_a_damaged_database_is_unavailable_with_a_reason(store: AsyncDatabase, tmp_path: Path) -> None:
    """The error has no internals."""
    (tmp_path / "switchboard.db").write_bytes(b"junk" * 4096)
    with pytest.raises(Unavailable) as reported:
        await store.read(queries.list_users)
    assert "SELECT" not in str(reported.value)
    assert str(tmp_path) not in str(reported.value)
