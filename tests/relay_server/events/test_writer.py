"""Events are written in batches, and confirmed only after the transaction is committed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import pytest_twisted
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock
from twisted.logger import capturedLogs

from relay_db.queries import NewStoredEvent, StoredEventRecord
from relay_protocol.errors import NotFound, Unavailable
from relay_server.events import writer as module
from relay_server.events.limits import DROP_REPORT_SECONDS, GATHER_SECONDS, RETRY_SECONDS
from relay_server.events.writer import EventQueueFull, EventWriter


class MemoryStore:
    """A store that writes when the test says so."""

    def __init__(self) -> None:
        self.asked: list[tuple[list[NewStoredEvent], Deferred[list[StoredEventRecord | None]]]] = []
        self.number = 0

    def write(self, query: Any, events: list[NewStoredEvent]) -> Deferred[list[StoredEventRecord | None]]:
        """Begins a transaction."""
        done: Deferred[list[StoredEventRecord | None]] = Deferred()
        self.asked.append((events, done))
        return done

    def commit(self, *gone: str) -> list[NewStoredEvent]:
        """Commits; returns its events.

        :param gone: realms that have been removed
        """
        events, done = self.asked.pop(0)
        self.number += len(events)
        first = self.number - len(events) + 1
        done.callback(
            [
                None if each.realm in gone else StoredEventRecord(first + at, *each, use_count=0)
                for at, each in enumerate(events)
            ]
        )
        return events

    def fail(self, error: Exception) -> None:
        """Fails the transaction."""
        self.asked.pop(0)[1].errback(error)


class Scene:
    """A writer with its clock and store."""

    def __init__(self) -> None:
        self.clock, self.memory_store = Clock(), MemoryStore()
        self.reported: list[int] = []
        store: Any = self.memory_store
        self.writer = EventWriter(self.clock, store, lambda: 7.0, self._written)

    def _written(self, events: list[StoredEventRecord]) -> None:
        self.reported += [each.number for each in events]

    def write(self, count: int = 1) -> Deferred[list[StoredEventRecord]]:
        """A client writes this many events at once."""
        return Deferred.fromCoroutine(self.writer.write([new()] * count))

    def gather(self) -> None:
        """The time to gather events passes."""
        self.clock.advance(GATHER_SECONDS)


def new(realm: str = "default", kind: str = "x") -> NewStoredEvent:
    """An event."""
    return NewStoredEvent(realm, 1.0, "app", kind, None, None, "{}")


@pytest.fixture
def scene() -> Scene:
    """A scene without events."""
    return Scene()


@contextmanager
def fails(work: Deferred[Any], kind: type[Exception]) -> Iterator[None]:
    """The waiting write must fail with this error during the block."""
    caught: list[Any] = []
    work.addErrback(caught.append)
    yield
    assert [each.type for each in caught] == [kind]


def test_events_close_together_are_one_transaction(scene: Scene) -> None:
    first, second = scene.write(), scene.write(2)
    scene.writer.append(new(kind="own"))
    assert scene.memory_store.asked == []
    scene.gather()
    assert not first.called and scene.reported == []
    assert [each.kind for each in scene.memory_store.commit()] == ["x", "x", "x", "own"]
    assert [each.number for each in first.result] == [1]
    assert [each.number for each in second.result] == [2, 3]
    assert (scene.reported, scene.writer.waiting, scene.writer.written) == ([1, 2, 3, 4], 0, 4)


def test_a_full_transaction_is_written_at_once(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """One transaction is active at a time; later events follow in whole batches."""
    monkeypatch.setattr(module, "BATCH", 10)
    works = [scene.write(4) for _ in range(6)]
    assert [len(events) for events, _ in scene.memory_store.asked] == [8]
    scene.gather()
    assert len(scene.memory_store.asked) == 1
    assert len(scene.memory_store.commit()) == 8
    assert len(scene.memory_store.commit()) == 8
    assert not works[4].called and scene.memory_store.asked == []
    scene.gather()
    scene.memory_store.commit()
    assert [each.number for each in works[5].result] == [21, 22, 23, 24]


def test_events_of_a_realm_that_is_gone_are_lost_alone(scene: Scene) -> None:
    first, second = scene.write(), Deferred.fromCoroutine(scene.writer.write([new("lab")]))
    scene.writer.append(new("lab"))
    scene.gather()
    with fails(second, NotFound):
        scene.memory_store.commit("lab")
    assert [each.number for each in first.result] == scene.reported == [1]
    assert (scene.writer.waiting, scene.writer.own_waiting, scene.writer.written) == (0, 0, 1)


def test_realms_named_by_unauthenticated_clients_are_not_counted_one_by_one(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "RELAY_QUEUE", 1)
    for name in ("default", "a", "b", "c"):
        scene.writer.append(new(name))
    scene.gather()
    assert [each.kind for each in scene.memory_store.commit()] == ["x"]
    assert scene.writer.dropped == 3


def test_a_full_queue_refuses_further_events(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "QUEUE", 10)
    monkeypatch.setattr(module, "RELAY_QUEUE", 3)
    scene.writer.append(new("lab"))
    scene.gather()
    scene.memory_store.commit()
    for _ in range(5):
        scene.writer.append(new())
    scene.write(7)
    with fails(scene.write(1), EventQueueFull):
        pass
    scene.writer.append(new("lab"))
    assert (scene.writer.waiting, scene.writer.dropped) == (10, 3)
    scene.gather()
    drops = scene.memory_store.commit()[10:]
    assert [(each.realm, each.source, each.kind, each.data) for each in drops] == [
        ("default", "relay.dropped", "events.dropped", '{"count":2}'),
        ("lab", "relay.dropped", "events.dropped", '{"count":1}'),
    ]
    scene.write(10)
    scene.gather()
    assert len(scene.memory_store.commit()) == 10


def test_drops_are_reported_at_intervals(scene: Scene) -> None:
    """In each realm, with the number of dropped events."""
    reported = []
    scene.writer.append(new("lab"))
    scene.gather()
    scene.memory_store.commit()
    for _ in range(4):
        scene.writer.count_drop("default")
        scene.write()
        scene.gather()
        reported += [each.data for each in scene.memory_store.commit()[1:]]
    scene.writer.count_drop("lab")
    scene.write()
    scene.gather()
    reported += [each.realm for each in scene.memory_store.commit()[1:]]
    scene.clock.advance(DROP_REPORT_SECONDS)
    scene.write()
    scene.gather()
    reported += [each.data for each in scene.memory_store.commit()[1:]]
    assert reported == ['{"count":1}', "lab", '{"count":3}']
    assert scene.writer.dropped == 5


def test_a_database_failure_fails_waiting_writes(scene: Scene) -> None:
    """The relay's own events wait, and are written in order when the database works again."""
    waiting = scene.write()
    scene.writer.append(new(kind="own"))
    scene.gather()
    with fails(waiting, Unavailable):
        scene.memory_store.fail(Unavailable("the disk is full"))
    assert (scene.writer.waiting, scene.writer.own_waiting, scene.writer.dropped) == (1, 1, 0)
    following = scene.write()
    scene.writer.append(new(kind="later"))
    scene.gather()
    assert scene.memory_store.asked == []
    scene.clock.advance(RETRY_SECONDS)
    with fails(following, Unavailable):
        scene.memory_store.fail(Unavailable("the disk is full"))
    scene.clock.advance(RETRY_SECONDS)
    assert [each.kind for each in scene.memory_store.commit()] == ["own", "later"]
    assert (scene.writer.waiting, scene.writer.own_waiting, scene.writer.dropped) == (0, 0, 0)


def test_events_that_wait_for_the_database_are_bounded(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Further events are dropped and counted in the next write."""
    monkeypatch.setattr(module, "RELAY_QUEUE", 3)
    for number in range(3):
        scene.writer.append(new(kind=f"own{number}"))
    scene.gather()
    scene.memory_store.fail(Unavailable("the disk is full"))
    for _ in range(4):
        scene.writer.append(new(kind="late"))
    assert (scene.writer.waiting, scene.writer.dropped) == (3, 4)
    scene.clock.advance(RETRY_SECONDS)
    assert [each.kind for each in scene.memory_store.commit()] == ["own0", "own1", "own2", "events.dropped"]


def test_an_unexpected_error_does_not_end_writing(scene: Scene) -> None:
    waiting = scene.write()
    scene.gather()
    with capturedLogs() as logs, fails(waiting, Unavailable):
        scene.memory_store.fail(KeyError("insides"))
    assert logs[0]["log_failure"].type is KeyError
    assert scene.write() is not None
    scene.gather()
    scene.memory_store.commit()
    assert scene.reported == [1]


def test_a_cancelled_write_is_still_written(scene: Scene) -> None:
    gone, stays = scene.write(), scene.write()
    gone.addErrback(lambda failure: None)
    gone.cancel()
    scene.gather()
    assert len(scene.memory_store.commit()) == 2
    assert [each.number for each in stays.result] == [2]


@pytest_twisted.ensureDeferred
async def test_flush_waits_for_running_writes(scene: Scene) -> None:
    await scene.writer.flush()
    scene.write()
    flushing = Deferred.fromCoroutine(scene.writer.flush())
    assert not flushing.called
    scene.gather()
    assert not flushing.called
    scene.memory_store.commit()
    assert flushing.called


def test_drops_in_a_removed_realm_are_not_reported(scene: Scene) -> None:
    scene.writer.set_realms(["lab"])
    scene.writer.count_drop("lab")
    scene.writer.append(new())
    scene.gather()
    assert [each.realm for each in scene.memory_store.commit()] == ["default", "lab"]
    scene.writer.count_drop("lab")
    scene.writer.forget_realm("lab")
    assert not scene.writer.knows_realm("lab") and scene.writer.knows_realm("default")
    scene.writer.set_realms(["lab"])
    assert scene.writer.knows_realm("lab")
    scene.clock.advance(DROP_REPORT_SECONDS)
    scene.writer.append(new())
    scene.gather()
    assert [each.realm for each in scene.memory_store.commit()] == ["default"]
    scene.writer.count_drop("lab")
    scene.writer.forget_realm("lab")
    scene.writer.set_realms(["lab"])
    scene.writer.count_drop("lab")
    scene.writer.append(new("lab"))
    scene.gather()
    assert [each.data for each in scene.memory_store.commit()] == ["{}", '{"count":1}']
