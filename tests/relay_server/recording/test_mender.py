"""What broke off is made readable: after a pause, a few times, and where there is room."""

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
from tests.relay_server.memory import text
from tests.relay_server.recording.reading import CHATTER, read

NO_DISK = 2**62
"""No disk has so much to spare."""


class Shop:
    """A mender, and what is brought to him."""

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
        self.mender = Repair(
            self.clock,
            self.library,
            self.threads,
            self.stopping,
            busy=lambda entry: entry.id in self.busy,
            save=self._save,
            drop=self._drop,
        )

    async def _save(self, entry: RecordingEntry) -> None:
        self.saved.append((entry.id, entry.state))

    async def _drop(self, entry: RecordingEntry) -> None:
        self.dropped.append(entry.id)

    def broken(self, id: str = "a", *, file: bool = True) -> RecordingEntry:
        """A recording that broke off, with two whole messages."""
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
        """Time goes by, and what is tried then has been."""
        self.clock.advance(seconds)
        async with self.mender._one_at_a_time:
            pass


def fails_with(number: int) -> Callable[[Path, Callable[[], bool]], int | None]:
    """A disk on which nothing can be mended."""

    def fails(path: Path, stopping: Callable[[], bool]) -> int | None:
        raise OSError(number, os.strerror(number))

    return fails


@pytest.fixture
def shop(tmp_path: Path) -> Iterator[Shop]:
    """A mender with an empty folder."""
    made = Shop(tmp_path / "recordings")
    yield made
    made.threads.stop()


@pytest_twisted.ensureDeferred
async def test_what_breaks_off_is_readable_after_a_pause(shop: Shop) -> None:
    """It ended when the last of it was written, not when it was mended."""
    entry = shop.broken()
    written = shop.library.path(entry).stat().st_mtime
    shop.mender.later(entry)
    await shop.waits(PAUSE_SECONDS - 1)
    assert entry.state is RecordingState.INCOMPLETE
    await shop.waits(1)
    assert (entry.state, entry.messages, entry.ended) == (RecordingState.RECOVERED, 2, written)
    assert entry.bytes == shop.library.path(entry).stat().st_size
    assert [each.body for each in read(shop.library.path(entry))] == [text("a"), text("b")]
    assert shop.saved == [("a", RecordingState.RECOVERED)]
    assert shop.clock.getDelayedCalls() == []


@pytest_twisted.ensureDeferred
async def test_it_is_tried_a_few_times_and_then_with_all_others(
    shop: Shop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As long as it can't be read nothing is lost, and its room is not forgotten."""
    entry = shop.broken()
    size = entry.bytes
    with monkeypatch.context() as bad:
        bad.setattr(module, "repair_file", fails_with(errno.EIO))
        shop.mender.later(entry)
        for left in reversed(range(TRIES)):
            await shop.waits()
            assert len(shop.clock.getDelayedCalls()) == min(1, left)
    assert (entry.state, shop.library.used) == (RecordingState.INCOMPLETE, size)
    shop.mender.recover()
    await shop.mender.done
    assert entry.state.value == "recovered"


@pytest.mark.parametrize("lack", ["reserve", errno.ENOSPC, errno.EDQUOT])
@pytest.mark.parametrize("at_the_start", [False, True])
@pytest_twisted.ensureDeferred
async def test_what_had_no_room_is_readable_soon_after_there_is(
    shop: Shop, monkeypatch: pytest.MonkeyPatch, lack: str | int, at_the_start: bool
) -> None:
    """However long that takes: it is tried after each pause, and logged once."""
    entry = shop.broken()
    with capturedLogs() as logged, monkeypatch.context() as full:
        if isinstance(lack, int):
            full.setattr(module, "repair_file", fails_with(lack))
        else:
            full.setattr(shop.library, "reserve", NO_DISK)
        if at_the_start:
            shop.mender.recover()
            await shop.mender.done
        else:
            shop.mender.later(entry)
        for _ in range(4 * TRIES):
            await shop.waits()
            assert len(shop.clock.getDelayedCalls()) == 1
    assert (entry.state, len(logged)) == (RecordingState.INCOMPLETE, 1)
    await shop.waits()
    assert entry.state.value == "recovered"
    assert shop.clock.getDelayedCalls() == []


@pytest_twisted.ensureDeferred
async def test_lack_of_room_takes_none_of_the_tries(shop: Shop, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does it give more, also when all others are tried meanwhile."""
    entry = shop.broken()
    monkeypatch.setattr(module, "repair_file", fails_with(errno.ENOSPC))
    shop.mender.later(entry)
    await shop.waits()
    shop.mender.recover()
    await shop.mender.done
    monkeypatch.setattr(module, "repair_file", fails_with(errno.EIO))
    for left in reversed(range(TRIES)):
        await shop.waits()
        assert len(shop.clock.getDelayedCalls()) == min(1, left)


@pytest_twisted.ensureDeferred
async def test_what_is_deleted_waits_for_no_room(shop: Shop) -> None:
    """It is not looked for again."""
    shop.library.reserve = NO_DISK
    entry = shop.broken()
    shop.mender.later(entry)
    await shop.waits()
    shop.library.forget(entry)
    await shop.waits()
    assert shop.clock.getDelayedCalls() == []


@pytest_twisted.ensureDeferred
async def test_a_copy_counts_while_it_is_made(shop: Shop, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody is promised the same room."""
    entry = shop.broken()
    counted: list[int] = []
    mend = module.repair_file

    def noted(path: Path, stopping: Callable[[], bool]) -> int | None:
        counted.append(shop.library.used)
        return mend(path, stopping)

    monkeypatch.setattr(module, "repair_file", noted)
    size = entry.bytes
    shop.mender.recover()
    await shop.mender.done
    assert counted == [2 * size]
    assert shop.library.used == entry.bytes


@pytest_twisted.ensureDeferred
async def test_a_copy_stops_when_others_fill_the_disk(shop: Shop, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file stays what it was, and nothing is left of the copy."""
    entry = shop.broken()
    path = shop.library.path(entry)
    before = path.read_bytes()
    mend = module.repair_file

    def filled(path: Path, stopping: Callable[[], bool]) -> int | None:
        shop.library.reserve = NO_DISK
        return mend(path, stopping)

    monkeypatch.setattr(module, "LOOK_SECONDS", 0.0)
    monkeypatch.setattr(module, "repair_file", filled)
    shop.mender.recover()
    await shop.mender.done
    assert (entry.state, path.read_bytes()) == (RecordingState.INCOMPLETE, before)
    assert list(path.parent.iterdir()) == [path]


@pytest_twisted.ensureDeferred
async def test_one_that_can_not_be_mended_does_not_keep_the_others(
    shop: Shop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever it has."""
    bad, good = shop.broken("a"), shop.broken("b")
    mend = module.repair_file

    def fails(path: Path, stopping: Callable[[], bool]) -> int | None:
        if path.stem == "a":
            raise KeyError("surprise")
        return mend(path, stopping)

    monkeypatch.setattr(module, "repair_file", fails)
    shop.mender.recover()
    await shop.mender.done
    assert (bad.state, good.state) == (RecordingState.INCOMPLETE, RecordingState.RECOVERED)


@pytest_twisted.ensureDeferred
async def test_what_has_no_file_is_forgotten(shop: Shop) -> None:
    """It had only been wanted."""
    shop.broken(file=False)
    shop.mender.recover()
    await shop.mender.done
    assert (shop.dropped, list(shop.library)) == (["a"], [])


@pytest_twisted.ensureDeferred
async def test_nobody_mends_what_others_work_on(shop: Shop) -> None:
    """Such as who deletes it."""
    entry = shop.broken()
    shop.busy.add("a")
    shop.mender.recover()
    await shop.mender.done
    assert entry.state is RecordingState.INCOMPLETE
    shop.library.forget(entry)
    shop.busy.clear()
    shop.mender.later(entry)
    await shop.waits()
    assert (entry.state, shop.saved) == (RecordingState.INCOMPLETE, [])


@pytest_twisted.ensureDeferred
async def test_a_relay_that_goes_down_mends_nothing_more(shop: Shop) -> None:
    """Neither what waits nor what is under way is finished; nothing is lost."""
    entry = shop.broken()
    shop.mender.later(entry)
    shop.stopping.set()
    shop.mender.shut()
    assert shop.clock.getDelayedCalls() == []
    shop.mender.later(entry)
    assert shop.clock.getDelayedCalls() == []
    shop.mender.recover()
    await shop.mender.done
    assert entry.state is RecordingState.INCOMPLETE
