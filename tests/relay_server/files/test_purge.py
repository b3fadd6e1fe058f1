"""Deletions from the relay's storage: files of removed robots, interrupted removals, abandoned uploads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select
from twisted.internet.defer import Deferred

from relay_db import queries
from relay_db.models import StoredFile
from relay_protocol.errors import Unavailable
from relay_server.events.bus import EventBus
from relay_server.files.build import FileCore
from relay_server.files.service import FileService
from tests.worlds.file_uploads import OLD, FileWorld, StepPool, Steps

CONTENT = bytes(100_000)
LATER = OLD + 8 * 86400.0


class Service:
    """The file service of a world with one stored file."""

    def __init__(self, world: FileWorld) -> None:
        pool: Any = StepPool(world.relay_steps)
        database: Any = world.store
        sessions: Any = None
        core = FileCore(pool, pool, world.incoming_folder, world.content, world.uploads, world.links)
        self.world = world
        self.core = core
        self.service = FileService(sessions, core, database, EventBus(), 0, lambda: LATER)

    def purge(self) -> None:
        done: list[object] = []
        Deferred.fromCoroutine(self.service.purge()).addBoth(done.append)
        assert done == [None]

    def blobs(self) -> list[Path]:
        return [each for each in self.world.data.rglob("*") if each.is_file()]

    def usage(self) -> queries.FileUsageRecord:
        with self.world.database.reading() as session:
            return queries.usage_of_robot(session, self.world.robot_id)


@pytest.fixture
def stored(tmp_path: Path) -> Service:
    world = FileWorld(tmp_path)
    world.write("a.bag", CONTENT)
    world.run(10)
    assert len(world.stored()) == 1
    return Service(world)


def test_a_stored_file_stays(stored: Service) -> None:
    stored.purge()
    assert len(stored.blobs()) == 1
    assert stored.usage() == (1, len(CONTENT))


def test_files_of_a_removed_robot_are_deleted(stored: Service) -> None:
    with stored.world.database.begin() as session:
        queries.remove_robot(session, stored.world.robot_id)
    stored.purge()
    assert stored.blobs() == []
    assert stored.usage() == (0, 0)


def test_a_removal_that_was_interrupted_is_finished(stored: Service) -> None:
    with stored.world.database.begin() as session:
        queries.begin_file_removal(session, stored.world.stored()[0].id, OLD)
    stored.purge()
    assert stored.blobs() == []


def test_an_upload_that_is_not_continued_is_deleted(tmp_path: Path) -> None:
    world = FileWorld(tmp_path)
    world.write("a.bag", CONTENT)
    world.start_relay(Steps(6, True, world.cut))
    world.run(3)
    world.start_relay(Steps())
    service = Service(world)
    assert len(service.blobs()) == 1
    service.purge()
    assert service.blobs() == []
    assert service.usage() == (0, 0)


def test_a_file_that_can_not_be_deleted_does_not_stop_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = FileWorld(tmp_path)
    for name in ("a.bag", "b.bag"):
        world.write(name, CONTENT)
    world.run(20)
    first = min(each.id for each in world.stored())
    service = Service(world)
    with world.database.begin() as session:
        queries.remove_robot(session, world.robot_id)
    delete = world.content.delete

    def failing(key: str) -> None:
        if key == str(first):
            raise OSError(5, "the disk failed")
        delete(key)

    monkeypatch.setattr(world.content, "delete", failing)
    done: list[Any] = []
    Deferred.fromCoroutine(service.service.purge()).addBoth(done.append)
    assert done[0].check(Unavailable)
    assert len(service.blobs()) == 1
    monkeypatch.undo()
    service.purge()
    assert service.blobs() == []


def test_an_upload_that_begins_while_its_file_is_removed_ends(stored: Service) -> None:
    file = stored.world.stored()[0]
    ended: list[str] = []
    uploads: Any = stored.core.uploads
    end = uploads.end

    async def noted(file_id: int) -> None:
        with stored.world.database.reading() as session:
            row = session.execute(select(StoredFile.state)).scalar_one()
        ended.append(row)
        await end(file_id)

    uploads.end = noted
    Deferred.fromCoroutine(stored.service.remove(file))
    assert ended == ["stored", "removing"]


def test_contents_of_a_file_that_another_relay_has_removed_are_deleted(stored: Service) -> None:
    """Only if the database does not have the file any more."""
    (file,) = stored.world.stored()

    def notified() -> int:
        Deferred.fromCoroutine(stored.service.delete_removed(file.id))
        return len(stored.blobs())

    assert notified() == 1
    with stored.world.database.begin() as session:
        queries.remove_file(session, file.id)
    assert notified() == 0


class SlowPool(StepPool):
    """Its first work waits."""

    def __init__(self, steps: Steps) -> None:
        super().__init__(steps)
        self.go_on: Deferred[None] | None = Deferred()

    async def run(self, work: Any, *args: Any, **more: Any) -> Any:
        waiting, self.go_on = self.go_on, None
        if waiting is not None:
            self.begun = waiting
            await waiting
        return await super().run(work, *args, **more)


def test_an_upload_that_goes_on_during_a_purge_stays(tmp_path: Path) -> None:
    """It is stored and confirmed between the list of what is to be deleted and its turn."""
    world = FileWorld(tmp_path)
    paths = [world.write(name, CONTENT) for name in ("a.bag", "b.bag")]
    world.start_relay(Steps(6, True, world.cut))
    world.run(3)
    world.start_relay(Steps())
    service = Service(world)
    pool: Any = SlowPool(world.relay_steps)
    core = FileCore(pool, pool, world.incoming_folder, world.content, world.uploads, world.links)
    database: Any = world.store
    purging = FileService(service.service._sessions, core, database, EventBus(), 0, lambda: LATER)
    done: list[object] = []
    Deferred.fromCoroutine(purging.purge()).addBoth(done.append)
    assert done == []
    world.cut()
    world.start_robot(Steps())
    world.run(20)
    confirmed = {each.name for each in world.stored()}
    assert confirmed
    pool.begun.callback(None)
    world.run(60)
    assert done == [None]
    stored = {each.name: world.read(each) for each in world.stored()}
    assert stored.keys() >= confirmed
    for path in paths:
        assert path.exists() or stored[f"bags/{path.name}"] == CONTENT
