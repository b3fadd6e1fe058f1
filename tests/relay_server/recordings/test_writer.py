"""The thread that writes a recording: a bounded queue before it, a valid file after it."""

from __future__ import annotations

import os
import shutil
import struct
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from relay_protocol.errors import Invalid
from relay_server.recordings import writer as module
from relay_server.recordings.mcap_file import repair_file
from relay_server.recordings.writer import RecordedMessage, RecordingWriter, WriteOutcome, flush_pause
from tests.worlds.mcap_reader import CHATTER, read
from tests.worlds.relay import text
from tests.worlds.waiting import wait_for


class Reactor:
    """Stores calls from threads."""

    def __init__(self) -> None:
        self._said = threading.Event()
        self._call: Callable[[], object] = lambda: None

    def callFromThread(self, call: Callable[..., object], *args: object) -> None:
        """Stores the call."""
        self._call = lambda: call(*args)
        self._said.set()

    def run(self) -> None:
        """Waits for a call and runs it."""
        assert self._said.wait(20)
        self._call()


class WriterWorld:
    """A writer and its result."""

    def __init__(self, path: Path, limit: int = 10**7) -> None:
        self.reactor = Reactor()
        self.path = path
        self.outcomes: list[WriteOutcome] = []
        self.nearly_full = False
        self.writer = RecordingWriter(
            self.reactor, path, limit, True, lambda: self.nearly_full, self.outcomes.append
        )

    def put(self, word: str, make: Callable[[bytes], bytes] | None = None) -> bool:
        """Adds a message."""
        return self.writer.put(RecordedMessage(CHATTER, 1, 1, text(word), make))

    def finish(self) -> WriteOutcome:
        """Ends the file."""
        self.writer.finish()
        self.reactor.run()
        return self.outcomes[0]


@pytest.fixture
def world(tmp_path: Path) -> WriterWorld:
    """A writer that has not started."""
    return WriterWorld(tmp_path / "a.mcap")


def test_queued_entries_are_written(world: WriterWorld) -> None:
    """They are written in order and completely."""
    world.writer.start()
    for number in range(100):
        assert world.put(f"{number}")
    assert world.finish() == WriteOutcome(True, "")
    assert [each.body for each in read(world.path)] == [text(f"{number}") for number in range(100)]
    assert (world.writer.messages, world.writer.bytes) == (100, world.path.stat().st_size)


def test_messages_the_slow_disk_cannot_take_are_dropped(
    world: WriterWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The number and the bytes of waiting messages are limited; after the end none is accepted."""
    monkeypatch.setattr(module, "QUEUE_MESSAGES", 3)
    assert [world.put("x") for _ in range(5)] == [True, True, True, False, False]
    monkeypatch.setattr(module, "QUEUE_MESSAGES", 1000)
    monkeypatch.setattr(module, "QUEUE_BYTES", 100)
    assert not world.put("y" * 100)
    world.writer.start()
    world.finish()
    assert not world.put("late")
    assert len(read(world.path)) == 3


def test_failed_conversions_are_counted(world: WriterWorld) -> None:
    """Other messages are written."""

    def broken(body: bytes) -> bytes:
        raise Invalid("no message")

    world.writer.start()
    world.put("a", broken)
    world.put("b", lambda body: text("B"))
    assert world.finish().finished
    assert [each.body for each in read(world.path)] == [text("B")]
    assert world.writer.broken == 1


@pytest.mark.parametrize("error", [struct.error, KeyError, OSError, MemoryError])
def test_no_error_of_a_message_ends_the_file(world: WriterWorld, error: type[Exception]) -> None:
    """A message that cannot be converted is counted, even if the exception is unexpected."""

    def broken(body: bytes) -> bytes:
        raise error("surprise")

    world.writer.start()
    for word in ("a", "b"):
        world.put(word, broken)
    world.put("c")
    assert world.finish() == WriteOutcome(True, "")
    assert [each.body for each in read(world.path)] == [text("c")]
    assert world.writer.broken == 2


def test_running_recording_keeps_its_space(world: WriterWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    """Messages that the thread is writing still count, by number and by bytes."""
    begun, go = threading.Event(), threading.Event()

    def slow(body: bytes) -> bytes:
        begun.set()
        assert go.wait(20)
        return body

    monkeypatch.setattr(module, "QUEUE_MESSAGES", 3)
    world.writer.start()
    assert world.put("a", slow)
    assert begun.wait(20)
    assert [world.put("b") for _ in range(3)] == [True, True, False]
    monkeypatch.setattr(module, "QUEUE_MESSAGES", 1000)
    monkeypatch.setattr(module, "QUEUE_BYTES", 3 * len(text("a")) + 1)
    assert not world.put("c"), "there is place for two bytes at most"
    go.set()
    wait_for("all is written", lambda: world.put("d"))
    world.finish()
    assert len(read(world.path)) == 4


def test_written_message_frees_its_space(world: WriterWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    """Afterwards the queue has its full capacity."""
    world.writer.start()
    for number in range(3 * module.BATCH):
        assert world.put(f"{number}")
    wait_for("all is written", lambda: world.writer.messages == 3 * module.BATCH)
    monkeypatch.setattr(module, "QUEUE_MESSAGES", 1)
    monkeypatch.setattr(module, "QUEUE_BYTES", len(text("a")))
    wait_for("there is place for one", lambda: world.put("a"))
    world.finish()
    assert len(read(world.path)) == 3 * module.BATCH + 1


def test_it_ends_whole_when_the_disk_is_nearly_full(
    world: WriterWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even without new messages."""
    monkeypatch.setattr(module, "CHECK_SECONDS", 0.01)
    world.put("a")
    world.nearly_full = True
    world.writer.start()
    world.reactor.run()
    assert world.outcomes == [WriteOutcome(True, "the disk is nearly full")]
    assert [each.body for each in read(world.path)] == [text("a")]
    assert not world.put("late")


def test_it_ends_by_itself_at_its_size(tmp_path: Path) -> None:
    """The file is valid."""
    world = WriterWorld(tmp_path / "a.mcap", 100_000)
    for _ in range(10):
        world.put(os.urandom(10_000).hex())
    world.writer.start()
    world.reactor.run()
    assert world.outcomes == [WriteOutcome(True, "it has reached its size limit")]
    assert 1 <= len(read(world.path)) < 10
    assert world.path.stat().st_size <= 100_000


def test_a_file_that_can_not_be_written_ends_the_recording_with_a_reason(tmp_path: Path) -> None:
    """The folder does not exist."""
    world = WriterWorld(tmp_path / "none" / "a.mcap")
    world.writer.start()
    world.reactor.run()
    assert world.outcomes == [WriteOutcome(False, "the file cannot be written: No such file or directory")]
    assert not world.put("x")


def test_messages_are_in_the_file_soon(
    world: WriterWorld, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A killed relay loses only the messages of the last moment."""
    monkeypatch.setattr(module, "FLUSH_SECONDS", (0.01, 0.01))
    world.writer.start()
    world.put("a")
    killed = tmp_path / "killed.mcap"

    def kept() -> bool:
        shutil.copyfile(world.path, killed)
        return repair_file(killed, lambda: False) == 1

    wait_for("the message is in the file", lambda: world.path.exists() and kept())
    world.finish()
    assert len(read(world.path)) == 1


def test_a_long_recording_is_flushed_less_often() -> None:
    """The index must not grow by an entry each second: a day has about 9000 chunks by time."""
    assert [flush_pause(age) for age in (0, 60, 300, 600, 86400)] == [1, 1, 5, 10, 10]
    age, flushes = 0.0, 0
    while age < 86400:
        age += flush_pause(age)
        flushes += 1
    assert flushes < 9000
