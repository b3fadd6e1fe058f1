"""The thread that writes: bounded before it, whole behind it."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from switchboard_waiting import wait_for

from relay_protocol.errors import Invalid
from relay_server.recording import writer as module
from relay_server.recording.mcap_file import mend
from relay_server.recording.writer import Message, Outcome, Writer
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
        self.outcomes: list[Outcome] = []
        self.writer = Writer(self.reactor, path, limit, True, self.outcomes.append)

    def put(self, word: str, make: Callable[[bytes], bytes] | None = None) -> bool:
        """A message."""
        return self.writer.put(Message(CHATTER, 1, 1, text(word), make))

    def finish(self) -> Outcome:
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
    assert book.finish() == Outcome(True, "")
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


def test_it_ends_by_itself_at_its_size(tmp_path: Path) -> None:
    """The file is whole."""
    book = Book(tmp_path / "a.mcap", 100_000)
    for _ in range(10):
        book.put(os.urandom(10_000).hex())
    book.writer.start()
    book.reactor.run()
    assert book.outcomes == [Outcome(True, "it has reached its size")]
    assert 1 <= len(read(book.path)) < 10
    assert book.path.stat().st_size <= 100_000


def test_a_file_that_can_not_be_written_ends_it_in_words(tmp_path: Path) -> None:
    """There is no folder."""
    book = Book(tmp_path / "none" / "a.mcap")
    book.writer.start()
    book.reactor.run()
    assert book.outcomes == [Outcome(False, "the file can't be written: No such file or directory")]
    assert not book.put("x")


def test_what_came_is_in_the_file_soon(book: Book, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A relay that is killed loses no more than comes in a second."""
    monkeypatch.setattr(module, "FLUSH_SECONDS", 0.01)
    book.writer.start()
    book.put("a")
    killed = tmp_path / "killed.mcap"

    def kept() -> bool:
        shutil.copyfile(book.path, killed)
        return mend(killed, lambda: False) == 1

    wait_for("the message is in the file", lambda: book.path.exists() and kept())
    book.finish()
    assert len(read(book.path)) == 1
