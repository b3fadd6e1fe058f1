"""Repair of interrupted recordings: after a pause, a few times, and only with free space."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.task import Clock
from twisted.logger import capturedLogs

from relay_server.common.database import BoundedThreadPool
from relay_server.recordings import repair as module
from relay_server.recordings.library import Library, RecordingEntry, RecordingState
from relay_server.recordings.mcap_file import McapFile
from relay_server.recordings.repair import PAUSE_SECONDS, TRIES, Repair
from tests.worlds.mcap_reader import CHATTER, read
from tests.worlds.relay import text

NO_DISK = 2**62
"""No disk has so much to spare."""


class RepairWorld:
    """The repair service with a folder."""

    def __init__(self, folder: Path) -> None:
        self.clock = Clock()
        self.library = Library(folder, 10**6)
        self.library.open()
        self.threads = BoundedThreadPool(reactor, "test", 1, 8, "too much")  # type: ignore[arg-type]  # to mypy it is a module
        self.threads.start()
        self.stopping = threading.Event()
        self.busy: set[str] = set()
        self.saved: list[tuple[str, RecordingState]] = []
        self.dropped: list[str] = []
        self.repaired: list[str] = []
        self.mender = Repair(
            self.clock,
            self.library,
            self.threads,
            self.stopping,
            busy=lambda entry: entry.id in self.busy,
            save=self._save,
            drop=self._drop,
            repaired=lambda entry: self.repaired.append(entry.id),
        )

    async def _save(self, entry: RecordingEntry) -> None:
        self.saved.append((entry.id, entry.state))

    async def _drop(self, entry: RecordingEntry) -> None:
        self.dropped.append(entry.id)

    def broken(self, id: str = "a", *, file: bool = True) -> RecordingEntry:
        """An interrupted recording with two complete messages."""
        entry = RecordingEntry(
            id, 1, "rover", 7, "ann", ("/chatter",), (), begun=1.0, limit=1000, seconds=60.0
        )
        entry.state = RecordingState.INCOMPLETE
        if file:
            with self.library.path(entry).open("wb") as stream:
                begun = McapFile(stream, 10**6, ros=True)
                for word in ("a", "b"):
                    begun.add(CHATTER, 1, 1, text(word))
                begun.flush()
            entry.bytes = self.library.size(entry)
        self.library.add(entry)
        return entry

    async def waits(self, seconds: float = PAUSE_SECONDS) -> None:
        """Lets time pass and waits for the attempts."""
        self.clock.advance(seconds)
        async with self.mender._one_at_a_time:
            pass


def fails_with(number: int) -> Callable[[Path, Callable[[], bool]], int | None]:
    """A disk on which every repair fails."""

    def fails(path: Path, stopping: Callable[[], bool]) -> int | None:
        raise OSError(number, os.strerror(number))

    return fails


@pytest.fixture
def world(tmp_path: Path) -> Iterator[RepairWorld]:
    """The repair service with an empty folder."""
    made = RepairWorld(tmp_path / "recordings")
    yield made
    made.threads.stop()


@pytest_twisted.ensureDeferred
async def test_interrupted_recording_is_readable_after_a_pause(world: RepairWorld) -> None:
    """Its end is the time of its last write, not of its repair."""
    entry = world.broken()
    written = world.library.path(entry).stat().st_mtime
    world.mender.later(entry)
    await world.waits(PAUSE_SECONDS - 1)
    assert entry.state is RecordingState.INCOMPLETE
    await world.waits(1)
    assert (entry.state, entry.messages, entry.ended) == (RecordingState.RECOVERED, 2, written)
    assert entry.bytes == world.library.path(entry).stat().st_size
    assert [each.body for each in read(world.library.path(entry))] == [text("a"), text("b")]
    assert world.saved == [("a", RecordingState.RECOVERED)]
    assert world.clock.getDelayedCalls() == []


@pytest_twisted.ensureDeferred
async def test_it_is_tried_a_few_times_and_then_with_all_others(
    world: RepairWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An unreadable file is not deleted, and its space counts."""
    entry = world.broken()
    size = entry.bytes
    with monkeypatch.context() as bad:
        bad.setattr(module, "repair_file", fails_with(errno.EIO))
        world.mender.later(entry)
        for left in reversed(range(TRIES)):
            await world.waits()
            assert len(world.clock.getDelayedCalls()) == min(1, left)
    assert (entry.state, world.library.used) == (RecordingState.INCOMPLETE, size)
    world.mender.recover()
    await world.mender.done
    assert entry.state.value == "recovered"


@pytest.mark.parametrize("lack", ["reserve", errno.ENOSPC, errno.EDQUOT])
@pytest.mark.parametrize("at_the_start", [False, True])
@pytest_twisted.ensureDeferred
async def test_recording_without_space_is_readable_soon_after_there_is_some(
    world: RepairWorld, monkeypatch: pytest.MonkeyPatch, lack: str | int, at_the_start: bool
) -> None:
    """It is tried after each pause, for any number of times, and logged once."""
    entry = world.broken()
    with capturedLogs() as logged, monkeypatch.context() as full:
        if isinstance(lack, int):
            full.setattr(module, "repair_file", fails_with(lack))
        else:
            full.setattr(world.library, "reserve", NO_DISK)
        if at_the_start:
            world.mender.recover()
            await world.mender.done
        else:
            world.mender.later(entry)
        for _ in range(4 * TRIES):
            await world.waits()
            assert len(world.clock.getDelayedCalls()) == 1
    assert (entry.state, len(logged)) == (RecordingState.INCOMPLETE, 1)
    await world.waits()
    assert entry.state.value == "recovered"
    assert world.clock.getDelayedCalls() == []


@pytest_twisted.ensureDeferred
async def test_lack_of_room_does_not_count_as_an_attempt(
    world: RepairWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attempts for other reasons are not added either, while all others are tried."""
    entry = world.broken()
    monkeypatch.setattr(module, "repair_file", fails_with(errno.ENOSPC))
    world.mender.later(entry)
    await world.waits()
    world.mender.recover()
    await world.mender.done
    monkeypatch.setattr(module, "repair_file", fails_with(errno.EIO))
    for left in reversed(range(TRIES)):
        await world.waits()
        assert len(world.clock.getDelayedCalls()) == min(1, left)


@pytest_twisted.ensureDeferred
async def test_deletion_needs_no_space(world: RepairWorld) -> None:
    """It is not searched again."""
    world.library.reserve = NO_DISK
    entry = world.broken()
    world.mender.later(entry)
    await world.waits()
    world.library.forget(entry)
    await world.waits()
    assert world.clock.getDelayedCalls() == []


@pytest_twisted.ensureDeferred
async def test_a_copy_counts_while_it_is_made(world: RepairWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same space is not given to another recording."""
    entry = world.broken()
    counted: list[int] = []
    mend = module.repair_file

    def noted(path: Path, stopping: Callable[[], bool]) -> int | None:
        counted.append(world.library.used)
        return mend(path, stopping)

    monkeypatch.setattr(module, "repair_file", noted)
    size = entry.bytes
    world.mender.recover()
    await world.mender.done
    assert counted == [2 * size]
    assert world.library.used == entry.bytes


@pytest_twisted.ensureDeferred
async def test_a_copy_stops_when_others_fill_the_disk(
    world: RepairWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The original file is unchanged, and the copy is removed."""
    entry = world.broken()
    path = world.library.path(entry)
    before = path.read_bytes()
    mend = module.repair_file

    def filled(path: Path, stopping: Callable[[], bool]) -> int | None:
        world.library.reserve = NO_DISK
        return mend(path, stopping)

    monkeypatch.setattr(module, "CHECK_SECONDS", 0.0)
    monkeypatch.setattr(module, "repair_file", filled)
    world.mender.recover()
    await world.mender.done
    assert (entry.state, path.read_bytes()) == (RecordingState.INCOMPLETE, before)
    assert list(path.parent.iterdir()) == [path]


@pytest_twisted.ensureDeferred
async def test_unrepairable_recording_does_not_block_others(
    world: RepairWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For any reason."""
    bad, good = world.broken("a"), world.broken("b")
    mend = module.repair_file

    def fails(path: Path, stopping: Callable[[], bool]) -> int | None:
        if path.stem == "a":
            raise KeyError("surprise")
        return mend(path, stopping)

    monkeypatch.setattr(module, "repair_file", fails)
    world.mender.recover()
    await world.mender.done
    assert (bad.state, good.state) == (RecordingState.INCOMPLETE, RecordingState.RECOVERED)


@pytest_twisted.ensureDeferred
async def test_recording_without_file_is_forgotten(world: RepairWorld) -> None:
    """It had only been requested."""
    world.broken(file=False)
    world.mender.recover()
    await world.mender.done
    assert (world.dropped, list(world.library)) == (["a"], [])


@pytest_twisted.ensureDeferred
async def test_running_recordings_are_not_repaired(world: RepairWorld) -> None:
    """Its deletion belongs to the recorder."""
    entry = world.broken()
    world.busy.add("a")
    world.mender.recover()
    await world.mender.done
    assert entry.state is RecordingState.INCOMPLETE
    world.library.forget(entry)
    world.busy.clear()
    world.mender.later(entry)
    await world.waits()
    assert (entry.state, world.saved) == (RecordingState.INCOMPLETE, [])


@pytest_twisted.ensureDeferred
async def test_a_relay_that_shuts_down_repairs_nothing_more(world: RepairWorld) -> None:
    """Waiting and active repairs are abandoned; no file is lost."""
    entry = world.broken()
    world.mender.later(entry)
    world.stopping.set()
    world.mender.shut()
    assert world.clock.getDelayedCalls() == []
    world.mender.later(entry)
    assert world.clock.getDelayedCalls() == []
    world.mender.recover()
    await world.mender.done
    assert entry.state is RecordingState.INCOMPLETE
