"""Finished recordings that are moved into a storage, with real files and threads."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_protocol.errors import Unavailable
from relay_server.channels.channel import Channels
from relay_server.files.storage import LocalStorage, StoringStopped, never
from relay_server.recordings import archive as module
from relay_server.recordings.library import (
    READABLE,
    Library,
    RecordingEntry,
    RecordingState,
    kept_of,
    text_of,
)
from relay_server.recordings.recordings import Recordings
from relay_server.video.streams import CameraStreams
from tests.worlds.robot_links import until

CONTENT = bytes(range(256)) * 8


class RemoteStorage(LocalStorage):
    """Another disk, which may fail.

    :ivar stored: keys in the order in which they came
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.folder = folder
        self.fails = False
        self.dies = False
        self.waits = threading.Event()
        self.waits.set()
        self.entered = threading.Event()
        self.stored: list[str] = []

    def store(self, source: Path, key: str, stopping: Callable[[], bool] = never) -> None:
        self.entered.set()
        while not self.waits.wait(0.01):
            if stopping():
                raise StoringStopped("stopped")
        self._check()
        (self.folder / key).write_bytes(source.read_bytes())
        self.stored.append(key)
        if self.dies:
            raise OSError("the relay died before it deleted its own file")
        source.unlink()

    def delete(self, key: str) -> None:
        self._check()
        super().delete(key)

    def _path(self, key: str) -> Path:
        return self.folder / key

    def _check(self) -> None:
        if self.fails:
            raise OSError(5, "the storage does not answer")


class ArchiveWorld:
    """A relay whose recordings are moved into a storage."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "recordings"
        self.folder.mkdir()
        (folder / "remote").mkdir()
        self.storage = RemoteStorage(folder / "remote")
        self.clock = Clock()
        self.relays: list[Recordings] = []

    def put(self, id: str, state: RecordingState = RecordingState.COMPLETE) -> RecordingEntry:
        """A recording that an earlier relay left on its disk."""
        entry = RecordingEntry(id, 1, "rover", 1, "ann", ("/odom",), (), 1000.0, 5000, 60.0, state=state)
        entry.bytes = len(CONTENT)
        (self.folder / f"{id}.json").write_bytes(text_of(entry))
        (self.folder / f"{id}.mcap").write_bytes(CONTENT)
        return entry

    def start(self) -> Recordings:
        """A relay that starts."""
        library = Library(self.folder, 10**6, storage=self.storage)
        channels = Channels(self.clock, linger=1.0, new_ticket=str, wall_ns=lambda: 0)
        videos = CameraStreams(self.clock, new_ticket=str)
        made = Recordings(reactor, self.clock, library, channels, videos, lambda: 1000.0)
        self.relays.append(made)
        made.open()
        made.recover()
        return made

    async def moved(self, *ids: str) -> None:
        """Wait until recordings have left the disk."""
        await until(lambda: set(ids) <= set(self.storage.stored) and not set(ids) & self.on_disk())

    def on_disk(self) -> set[str]:
        """Recordings whose contents are on the disk."""
        return {each.stem for each in self.folder.glob("*.mcap")}

    def remote(self) -> dict[str, bytes]:
        """Contents of the storage."""
        return {each.name: each.read_bytes() for each in self.storage.folder.iterdir()}


@pytest.fixture
def world(tmp_path: Path) -> Iterator[ArchiveWorld]:
    made = ArchiveWorld(tmp_path)
    yield made
    made.storage.waits.set()
    for relay in made.relays:
        pytest_twisted.blockon(Deferred.fromCoroutine(relay.shut("the test is over")))
        relay.close()


async def read(relay: Recordings, entry: RecordingEntry, offset: int, size: int) -> bytes:
    content = await relay.open_content(entry)
    try:
        return await relay.read(entry, content, offset, size)
    finally:
        content.close()


@pytest.mark.parametrize("state", sorted(READABLE, key=str))
@pytest_twisted.ensureDeferred
async def test_a_finished_recording_of_a_killed_relay_is_moved(
    world: ArchiveWorld, state: RecordingState
) -> None:
    world.put("a", state)
    relay = world.start()
    entry = relay.library.find(1, "a")
    await world.moved("a")
    assert world.remote() == {"a": CONTENT}
    assert relay.library.used == len(CONTENT)
    assert kept_of(world.folder, 1) == (1, len(CONTENT))
    assert await read(relay, entry, 0, 10_000) == CONTENT
    assert await read(relay, entry, 300, 5) == CONTENT[300:305]
    assert relay.library.of(1) == [entry]
    await relay.delete(entry)
    assert world.remote() == {}
    assert list(world.folder.iterdir()) == []


@pytest_twisted.ensureDeferred
async def test_a_recording_that_is_in_both_places_is_moved_again(world: ArchiveWorld) -> None:
    world.put("a")
    world.storage.dies = True
    world.start()
    await until(lambda: world.storage.stored == ["a"])
    assert world.on_disk() == {"a"}
    world.storage.dies = False
    relay = world.start()
    await world.moved("a")
    assert await read(relay, relay.library.find(1, "a"), 0, 10_000) == CONTENT


@pytest_twisted.ensureDeferred
async def test_recordings_that_are_not_finished_stay_on_the_disk(world: ArchiveWorld) -> None:
    """A broken one is repaired first."""
    world.put("a", RecordingState.RECORDING)
    relay = world.start()
    entry = relay.library.find(1, "a")
    assert entry.state is RecordingState.INCOMPLETE
    await world.moved("a")
    assert entry.state is RecordingState.RECOVERED
    assert len(world.remote()["a"]) == entry.bytes


@pytest_twisted.ensureDeferred
async def test_while_the_storage_fails_recordings_are_read_from_the_disk(world: ArchiveWorld) -> None:
    """They are moved once it answers; what can't be deleted there stays listed."""
    world.put("a")
    world.storage.fails = True
    relay = world.start()
    entry = relay.library.find(1, "a")
    await until(lambda: bool(world.clock.getDelayedCalls()))
    assert await read(relay, entry, 0, 10_000) == CONTENT
    with pytest.raises(Unavailable, match="does not answer"):
        await relay.delete(entry)
    assert relay.library.has(entry)
    await until(lambda: bool(world.clock.getDelayedCalls()))
    world.storage.fails = False
    world.clock.advance(module.RETRY_SECONDS)
    await world.moved("a")


@pytest_twisted.ensureDeferred
async def test_a_recording_is_deleted_while_it_is_moved(world: ArchiveWorld) -> None:
    """The next one is moved."""
    world.put("a")
    world.put("b")
    world.storage.waits.clear()
    relay = world.start()
    await until(world.storage.entered.is_set)
    for entry in relay.library:
        if entry.id == "a":
            await relay.delete(entry)
    world.storage.waits.set()
    await world.moved("b")
    assert world.remote() == {"b": CONTENT}
    assert [each.id for each in relay.library] == ["b"]


@pytest_twisted.ensureDeferred
async def test_a_relay_that_shuts_down_leaves_the_rest_to_the_next_one(world: ArchiveWorld) -> None:
    world.put("a")
    world.storage.waits.clear()
    relay = world.start()
    await until(world.storage.entered.is_set)
    await relay.shut("the relay ends")
    relay.close()
    world.relays.remove(relay)
    assert world.on_disk() == {"a"}
    assert world.remote() == {}
    world.storage.waits.set()
    world.start()
    await world.moved("a")


@pytest_twisted.ensureDeferred
async def test_a_recording_whose_description_is_not_saved_stays_on_the_disk(
    world: ArchiveWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A relay that finds it as running would miss its file."""
    world.put("a")

    def fails(library: Library, id: str, text: bytes) -> None:
        raise OSError(28, "no space")

    with monkeypatch.context() as patch:
        patch.setattr(Library, "save", fails)
        world.start()
        await until(lambda: bool(world.clock.getDelayedCalls()))
    assert world.on_disk() == {"a"}
    assert world.storage.stored == []
    world.clock.advance(module.RETRY_SECONDS)
    await world.moved("a")


@pytest_twisted.ensureDeferred
async def test_a_missing_file_is_an_error(world: ArchiveWorld) -> None:
    world.put("a")
    relay = world.start()
    await world.moved("a")
    world.storage.delete("a")
    with pytest.raises(FileNotFoundError):
        await relay.open_content(relay.library.find(1, "a"))
