"""Events are written many at once, and nobody is told that one is safe before it is."""

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
from relay_server.events.limits import DROPS_SECONDS, GATHER_SECONDS, RETRY_SECONDS
from relay_server.events.writer import EventQueueFull, EventWriter


class Paper:
    """A store that writes when the test says so."""

    def __init__(self) -> None:
        self.asked: list[tuple[list[NewStoredEvent], Deferred[list[StoredEventRecord | None]]]] = []
        self.number = 0

    def write(self, query: Any, events: list[NewStoredEvent]) -> Deferred[list[StoredEventRecord | None]]:
        """One transaction."""
        done: Deferred[list[StoredEventRecord | None]] = Deferred()
        self.asked.append((events, done))
        return done

    def commit(self, *gone: str) -> list[NewStoredEvent]:
        """It is safe; what it holds.

        :param gone: realms that are not there any more
        """
        events, done = self.asked.pop(0)
        self.number += len(events)
        first = self.number - len(events) + 1
        done.callback(
            [
                None if each.realm in gone else StoredEventRecord(first + at, *each, used=0)
                for at, each in enumerate(events)
            ]
        )
        return events

    def fail(self, error: Exception) -> None:
        """It is not."""
        self.asked.pop(0)[1].errback(error)


class Scene:
    """A writer with its clock and its paper."""

    def __init__(self) -> None:
        self.clock, self.paper = Clock(), Paper()
        self.told: list[int] = []
        store: Any = self.paper
        self.writer = EventWriter(self.clock, store, lambda: 7.0, self._written)

    def _written(self, events: list[StoredEventRecord]) -> None:
        self.told += [each.number for each in events]

    def write(self, count: int = 1) -> Deferred[list[StoredEventRecord]]:
        """Somebody brings so many at once."""
        return Deferred.fromCoroutine(self.writer.write([new()] * count))

    def gather(self) -> None:
        """What waits is gathered."""
        self.clock.advance(GATHER_SECONDS)


def new(realm: str = "default", kind: str = "x") -> NewStoredEvent:
    """An event."""
    return NewStoredEvent(realm, 1.0, "app", kind, None, None, "{}")


@pytest.fixture
def scene() -> Scene:
    """Nothing written yet."""
    return Scene()


@contextmanager
def fails(work: Deferred[Any], kind: type[Exception]) -> Iterator[None]:
    """What somebody waits for fails by what is done here."""
    caught: list[Any] = []
    work.addErrback(caught.append)
    yield
    assert [each.type for each in caught] == [kind]


def test_what_comes_within_a_moment_is_one_transaction(scene: Scene) -> None:
    """And nobody hears that his is safe before it is."""
    first, second = scene.write(), scene.write(2)
    scene.writer.note(new(kind="own"))
    assert scene.paper.asked == []
    scene.gather()
    assert not first.called and scene.told == []
    assert [each.kind for each in scene.paper.commit()] == ["x", "x", "x", "own"]
    assert [each.number for each in first.result] == [1]
    assert [each.number for each in second.result] == [2, 3]
    assert (scene.told, scene.writer.waiting, scene.writer.written) == ([1, 2, 3, 4], 0, 4)


def test_what_fills_a_transaction_does_not_wait(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """One is under way at a time; what came meanwhile follows, never torn apart."""
    monkeypatch.setattr(module, "BATCH", 10)
    works = [scene.write(4) for _ in range(6)]
    assert [len(events) for events, _ in scene.paper.asked] == [8]
    scene.gather()
    assert len(scene.paper.asked) == 1
    assert len(scene.paper.commit()) == 8
    assert len(scene.paper.commit()) == 8
    assert not works[4].called and scene.paper.asked == []
    scene.gather()
    scene.paper.commit()
    assert [each.number for each in works[5].result] == [21, 22, 23, 24]


def test_events_of_a_realm_that_is_gone_are_lost_alone(scene: Scene) -> None:
    """Who brought them is told so; all that was written with them is safe."""
    first, second = scene.write(), Deferred.fromCoroutine(scene.writer.write([new("lab")]))
    scene.writer.note(new("lab"))
    scene.gather()
    with fails(second, NotFound):
        scene.paper.commit("lab")
    assert [each.number for each in first.result] == scene.told == [1]
    assert (scene.writer.waiting, scene.writer.own_waiting, scene.writer.written) == (0, 0, 1)


def test_realms_that_strangers_name_are_not_counted_one_by_one(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is dropped of a realm nobody has seen is dropped, and nothing is kept of it."""
    monkeypatch.setattr(module, "OWN_QUEUE", 1)
    for name in ("default", "a", "b", "c"):
        scene.writer.note(new(name))
    scene.gather()
    assert [each.kind for each in scene.paper.commit()] == ["x"]
    assert scene.writer.dropped == 3


def test_when_the_queue_is_full_who_brings_more_has_to_come_again(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The relay's own are dropped; how many is told with what is written next."""
    monkeypatch.setattr(module, "QUEUE", 10)
    monkeypatch.setattr(module, "OWN_QUEUE", 3)
    scene.writer.note(new("lab"))
    scene.gather()
    scene.paper.commit()
    for _ in range(5):
        scene.writer.note(new())
    scene.write(7)
    with fails(scene.write(1), EventQueueFull):
        pass
    scene.writer.note(new("lab"))
    assert (scene.writer.waiting, scene.writer.dropped) == (10, 3)
    scene.gather()
    drops = scene.paper.commit()[10:]
    assert [(each.realm, each.source, each.kind, each.data) for each in drops] == [
        ("default", "relay.dropped", "events.dropped", '{"count":2}'),
        ("lab", "relay.dropped", "events.dropped", '{"count":1}'),
    ]
    scene.write(10)
    scene.gather()
    assert len(scene.paper.commit()) == 10


def test_that_something_was_dropped_is_not_told_all_the_time(scene: Scene) -> None:
    """In each realm once in a while, with all that were dropped meanwhile."""
    told = []
    scene.writer.note(new("lab"))
    scene.gather()
    scene.paper.commit()
    for _ in range(4):
        scene.writer.drop("default")
        scene.write()
        scene.gather()
        told += [each.data for each in scene.paper.commit()[1:]]
    scene.writer.drop("lab")
    scene.write()
    scene.gather()
    told += [each.realm for each in scene.paper.commit()[1:]]
    scene.clock.advance(DROPS_SECONDS)
    scene.write()
    scene.gather()
    told += [each.data for each in scene.paper.commit()[1:]]
    assert told == ['{"count":1}', "lab", '{"count":3}']
    assert scene.writer.dropped == 5


def test_a_database_that_fails_is_told_to_who_waits(scene: Scene) -> None:
    """The relay's own wait, and are written in their order when the database is back."""
    waiting = scene.write()
    scene.writer.note(new(kind="own"))
    scene.gather()
    with fails(waiting, Unavailable):
        scene.paper.fail(Unavailable("the disk is full"))
    assert (scene.writer.waiting, scene.writer.own_waiting, scene.writer.dropped) == (1, 1, 0)
    following = scene.write()
    scene.writer.note(new(kind="later"))
    scene.gather()
    assert scene.paper.asked == []
    scene.clock.advance(RETRY_SECONDS)
    with fails(following, Unavailable):
        scene.paper.fail(Unavailable("the disk is full"))
    scene.clock.advance(RETRY_SECONDS)
    assert [each.kind for each in scene.paper.commit()] == ["own", "later"]
    assert (scene.writer.waiting, scene.writer.own_waiting, scene.writer.dropped) == (0, 0, 0)


def test_events_that_wait_for_the_database_are_bounded(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Further ones are dropped, and counted in what is written next."""
    monkeypatch.setattr(module, "OWN_QUEUE", 3)
    for number in range(3):
        scene.writer.note(new(kind=f"own{number}"))
    scene.gather()
    scene.paper.fail(Unavailable("the disk is full"))
    for _ in range(4):
        scene.writer.note(new(kind="late"))
    assert (scene.writer.waiting, scene.writer.dropped) == (3, 4)
    scene.clock.advance(RETRY_SECONDS)
    assert [each.kind for each in scene.paper.commit()] == ["own0", "own1", "own2", "events.dropped"]


def test_what_nobody_has_foreseen_is_not_the_end_of_writing(scene: Scene) -> None:
    """It is in the log, and told without its words."""
    waiting = scene.write()
    scene.gather()
    with capturedLogs() as logs, fails(waiting, Unavailable):
        scene.paper.fail(KeyError("insides"))
    assert logs[0]["log_failure"].type is KeyError
    assert scene.write() is not None
    scene.gather()
    scene.paper.commit()
    assert scene.told == [1]


def test_who_leaves_does_not_keep_his_event_from_being_written(scene: Scene) -> None:
    """Nor the others from hearing of theirs."""
    gone, stays = scene.write(), scene.write()
    gone.addErrback(lambda failure: None)
    gone.cancel()
    scene.gather()
    assert len(scene.paper.commit()) == 2
    assert [each.number for each in stays.result] == [2]


@pytest_twisted.ensureDeferred
async def test_who_goes_down_waits_for_what_is_under_way(scene: Scene) -> None:
    """And not at all when there is nothing."""
    await scene.writer.flush()
    scene.write()
    flushing = Deferred.fromCoroutine(scene.writer.flush())
    assert not flushing.called
    scene.gather()
    assert not flushing.called
    scene.paper.commit()
    assert flushing.called


def test_what_was_dropped_in_a_realm_that_is_gone_is_told_to_nobody(scene: Scene) -> None:
    """In another of its name that something was dropped is told at once."""
    scene.writer.exist(["lab"])
    scene.writer.drop("lab")
    scene.writer.note(new())
    scene.gather()
    assert [each.realm for each in scene.paper.commit()] == ["default", "lab"]
    scene.writer.drop("lab")
    scene.writer.forget("lab")
    assert not scene.writer.knows("lab") and scene.writer.knows("default")
    scene.writer.exist(["lab"])
    assert scene.writer.knows("lab")
    scene.clock.advance(DROPS_SECONDS)
    scene.writer.note(new())
    scene.gather()
    assert [each.realm for each in scene.paper.commit()] == ["default"]
    scene.writer.drop("lab")
    scene.writer.forget("lab")
    scene.writer.exist(["lab"])
    scene.writer.drop("lab")
    scene.writer.note(new("lab"))
    scene.gather()
    assert [each.data for each in scene.paper.commit()] == ["{}", '{"count":1}']
