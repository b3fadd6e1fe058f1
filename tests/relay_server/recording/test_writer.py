"""The thread that writes: bounded before it, whole behind it."""

from __future__ import annotations

import os
import shutil
import struct
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from switchboard_waiting import wait_for

from relay_protocol.errors import Invalid
from relay_server.recordings import writer as module
from relay_server.recordings.mcap_file import repair_file
from relay_server.recordings.writer import RecordedMessage, RecordingWriter, WriteOutcome, flush_pause
from tests.relay_server.memory import text
from tests.relay_server.recording.reading import CHATTER, read


class Reactor:
    """Keeps what a thread has to say."""

    def __init__(self) -> None:
        self._said = threading.Event()
        self._call: Callable[[], object] = lambda: None

    def callFromThread(self, call: Callable[..., object], *args: object) -> None:
        """Keep it."""
        self._call = lambda: call(*args)
        self._said.set()

    def run(self) -> None:
        """Wait for it, and do it."""
        assert self._said.wait(20)
        self._call()


class Book:
    """A writer and how it ended."""

    def __init__(self, path: Path, limit: int = 10**7) -> None:
        self.reactor = Reactor()
        self.path = path
        self.outcomes: list[WriteOutcome] = []
        self.nearly_full = False
        self.writer = RecordingWriter(
            self.reactor, path, limit, True, lambda: self.nearly_full, self.outcomes.append
        )

    def put(self, word: str, make: Callable[[bytes], bytes] | None = None) -> bool:
        """A message."""
        return self.writer.put(RecordedMessage(CHATTER, 1, 1, text(word), make))

    def finish(self) -> WriteOutcome:
        """The end."""
        self.writer.finish()
        self.reactor.run()
        return self.outcomes[0]


@pytest.fixture
def book(tmp_path: Path) -> Book:
    """A writer that has not begun."""
    return Book(tmp_path / "a.mcap")


def test_what_is_put_is_written(book: Book) -> None:
    """In order, and all of it when it ends."""
    book.writer.start()
    for number in range(100):
        assert book.put(f"{number}")
    assert book.finish() == WriteOutcome(True, "")
    assert [each.body for each in read(book.path)] == [text(f"{number}") for number in range(100)]
    assert (book.writer.messages, book.writer.bytes) == (100, book.path.stat().st_size)


def test_what_the_disk_does_not_take_in_time_has_no_place(
    book: Book, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither too many messages nor too many bytes wait; nor does anything come after the end."""
    monkeypatch.setattr(module, "QUEUE_MESSAGES", 3)
    assert [book.put("x") for _ in range(5)] == [True, True, True, False, False]
    monkeypatch.setattr(module, "QUEUE_MESSAGES", 1000)
    monkeypatch.setattr(module, "QUEUE_BYTES", 100)
    assert not book.put("y" * 100)
    book.writer.start()
    book.finish()
    assert not book.put("late")
    assert len(read(book.path)) == 3


def test_what_can_not_be_made_is_counted(book: Book) -> None:
    """And the others are written."""

    def broken(body: bytes) -> bytes:
        raise Invalid("no message")

    book.writer.start()
    book.put("a", broken)
    book.put("b", lambda body: text("B"))
    assert book.finish().finished
    assert [each.body for each in read(book.path)] == [text("B")]
    assert book.writer.broken == 1


@pytest.mark.parametrize("error", [struct.error, KeyError, OSError, MemoryError])
def test_whatever_a_message_does_the_file_goes_on(book: Book, error: type[Exception]) -> None:
    """One that can't be made is counted, also if nobody thought that it could fail so."""

    def broken(body: bytes) -> bytes:
        raise error("surprise")

    book.writer.start()
    for word in ("a", "b"):
        book.put(word, broken)
    book.put("c")
    assert book.finish() == WriteOutcome(True, "")
    assert [each.body for each in read(book.path)] == [text("c")]
    assert book.writer.broken == 2


def test_what_is_being_written_keeps_its_place(book: Book, monkeypatch: pytest.MonkeyPatch) -> None:
    """By number and by bytes: what the thread has in hand is in memory still."""
    begun, go = threading.Event(), threading.Event()

    def slow(body: bytes) -> bytes:
        begun.set()
        assert go.wait(20)
        return body

    monkeypatch.setattr(module, "QUEUE_MESSAGES", 3)
    book.writer.start()
    assert book.put("a", slow)
    assert begun.wait(20)
    assert [book.put("b") for _ in range(3)] == [True, True, False]
    monkeypatch.setattr(module, "QUEUE_MESSAGES", 1000)
    monkeypatch.setattr(module, "QUEUE_BYTES", 3 * len(text("a")) + 1)
    assert not book.put("c"), "there is place for two bytes at most"
    go.set()
    wait_for("all is written", lambda: book.put("d"))
    book.finish()
    assert len(read(book.path)) == 4


def test_what_is_written_gives_its_place_back(book: Book, monkeypatch: pytest.MonkeyPatch) -> None:
    """All of it: the queue is not smaller afterwards."""
    book.writer.start()
    for number in range(3 * module.BATCH):
        assert book.put(f"{number}")
    wait_for("all is written", lambda: book.writer.messages == 3 * module.BATCH)
    monkeypatch.setattr(module, "QUEUE_MESSAGES", 1)
    monkeypatch.setattr(module, "QUEUE_BYTES", len(text("a")))
    wait_for("there is place for one", lambda: book.put("a"))
    book.finish()
    assert len(read(book.path)) == 3 * module.BATCH + 1


def test_it_ends_whole_when_the_disk_is_nearly_full(book: Book, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if nothing comes."""
    monkeypatch.setattr(module, "LOOK_SECONDS", 0.01)
    book.put("a")
    book.nearly_full = True
    book.writer.start()
    book.reactor.run()
    assert book.outcomes == [WriteOutcome(True, "the disk is nearly full")]
    assert [each.body for each in read(book.path)] == [text("a")]
    assert not book.put("late")


def test_it_ends_by_itself_at_its_size(tmp_path: Path) -> None:
    """The file is whole."""
    book = Book(tmp_path / "a.mcap", 100_000)
    for _ in range(10):
        book.put(os.urandom(10_000).hex())
    book.writer.start()
    book.reactor.run()
    assert book.outcomes == [WriteOutcome(True, "it has reached its size")]
    assert 1 <= len(read(book.path)) < 10
    assert book.path.stat().st_size <= 100_000


def test_a_file_that_can_not_be_written_ends_it_in_words(tmp_path: Path) -> None:
    """There is no folder."""
    book = Book(tmp_path / "none" / "a.mcap")
    book.writer.start()
    book.reactor.run()
    assert book.outcomes == [WriteOutcome(False, "the file can't be written: No such file or directory")]
    assert not book.put("x")


def test_what_came_is_in_the_file_soon(book: Book, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A relay that is killed loses no more than comes in a moment."""
    monkeypatch.setattr(module, "FLUSH_SECONDS", (0.01, 0.01))
    book.writer.start()
    book.put("a")
    killed = tmp_path / "killed.mcap"

    def kept() -> bool:
        shutil.copyfile(book.path, killed)
        return repair_file(killed, lambda: False) == 1

    wait_for("the message is in the file", lambda: book.path.exists() and kept())
    book.finish()
    assert len(read(book.path)) == 1


def test_a_long_recording_is_flushed_less_often() -> None:
    """So that its index does not grow with every second: it has some 9000 chunks by time in a day."""
    assert [flush_pause(age) for age in (0, 60, 300, 600, 86400)] == [1, 1, 5, 10, 10]
    age, flushes = 0.0, 0
    while age < 86400:
        age += flush_pause(age)
        flushes += 1
    assert flushes < 9000
