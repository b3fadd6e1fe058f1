"""Files that are opened in threads while their callers leave, and contents that are lost."""

from __future__ import annotations

import base64
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from twisted.internet.defer import CancelledError, Deferred

from relay_db.queries import NewFile
from relay_protocol.errors import Invalid
from relay_server.files import incoming
from relay_server.files.service import _place_of
from relay_server.files.storage import open_in_thread
from relay_server.files.uploads import UploadRefused
from tests.worlds.file_uploads import FileWorld, Steps

CONTENT = b"content" * 1000
NEW = NewFile("a.bag", "0" * 64, 1000, "", 0.0)


class HeldPool:
    """Threads that work only when they are released; their callers may have left by then."""

    def __init__(self) -> None:
        self._held: list[tuple[Deferred[Any], Callable[[], Any]]] = []

    async def run(self, work: Callable[..., Any], *arguments: Any) -> Any:
        waiting: Deferred[Any] = Deferred()
        self._held.append((waiting, lambda: work(*arguments)))
        return await waiting

    def go_on(self) -> None:
        while self._held:
            waiting, work = self._held.pop(0)
            waiting.callback(work())


def open_below(folder: Path) -> int:
    """Descriptors of this process that are files below a folder."""
    found = 0
    for each in Path("/proc/self/fd").iterdir():
        try:
            found += each.readlink().is_relative_to(folder / "incoming")
        except FileNotFoundError:
            continue
    return found


def test_50_offers_of_one_file_at_once_leave_no_descriptor(tmp_path: Path) -> None:
    world, pool = FileWorld(tmp_path), HeldPool()
    world.uploads.pool = pool  # type: ignore[assignment]
    begun: list[Any] = []
    for _ in range(50):
        Deferred.fromCoroutine(world.uploads.begin(world.robot_id, NEW)).addBoth(begun.append)
    pool.go_on()
    assert len(begun) == 50
    assert open_below(world.data) == 1
    for each in begun:
        if not hasattr(each, "check"):
            Deferred.fromCoroutine(each.cancel())
        else:
            assert each.check(UploadRefused)
    assert open_below(world.data) == 0
    assert list(world.uploads.of(world.robot_id)) == []


def test_what_is_opened_after_its_caller_has_left_is_closed(tmp_path: Path) -> None:
    world, pool = FileWorld(tmp_path), HeldPool()
    work: Any = open_in_thread(pool, world.incoming_folder.open, "1", 10)  # type: ignore[arg-type]
    opening = Deferred.fromCoroutine(work)
    opening.cancel()
    opening.addErrback(lambda failure: failure.trap(CancelledError))
    pool.go_on()
    assert open_below(world.data) == 0


@pytest.mark.parametrize("left", [None, b"short"])
def test_a_file_whose_contents_are_lost_is_uploaded_again(tmp_path: Path, left: bytes | None) -> None:
    world = FileWorld(tmp_path, after="keep")
    world.write("a.bag", CONTENT)
    world.run(10)
    file = world.stored()[0]
    blob = next(each for each in world.data.rglob(str(file.id)) if each.is_file())
    blob.unlink() if left is None else blob.write_bytes(left)
    (world.state / "confirmed.db").unlink()
    world.start_robot(Steps())
    world.run(30)
    world.check("a.bag", CONTENT)


def test_contents_that_the_disk_has_lost_are_not_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = FileWorld(tmp_path)
    file = world.incoming_folder.open("1", len(CONTENT))
    file.write(CONTENT)

    def fails(descriptor: int) -> None:
        raise OSError(5, "the disk failed")

    monkeypatch.setattr(incoming.os, "fsync", fails)
    with pytest.raises(OSError, match="the disk failed"):
        world.incoming_folder.store(file, "1", len(CONTENT), "0" * 64)
    monkeypatch.undo()
    file.close()
    again = world.incoming_folder.open("1", len(CONTENT))
    assert again.received == 0
    again.close()


@pytest.mark.parametrize("number", ["1" + "0" * 30, "-1", "[" * 2000])
def test_a_cursor_that_the_relay_did_not_make_is_invalid(number: str) -> None:
    cursor = base64.urlsafe_b64encode(f'["a",{number}]'.encode()).decode()
    with pytest.raises(Invalid, match="'after'"):
        _place_of(cursor)


def test_a_file_takes_no_more_than_was_offered(tmp_path: Path) -> None:
    """Neither by more bytes, nor by a second offer of the same content with another size: quotas count the first."""
    world = FileWorld(tmp_path)

    def begin(size: int) -> Any:
        done: list[Any] = []
        Deferred.fromCoroutine(world.uploads.begin(world.robot_id, NEW._replace(size=size))).addBoth(
            done.append
        )
        return done[0]

    upload = begin(1000)
    Deferred.fromCoroutine(upload.write(bytes(1000))).addErrback(pytest.fail)
    refused: list[Any] = []
    Deferred.fromCoroutine(upload.write(b"x")).addErrback(refused.append)
    assert str(refused[0].value) == "more came than the 1000 bytes that were offered"
    assert upload.ended
    again = begin(50_000_000_000)
    assert again.check(UploadRefused)
    assert again.value.code == "mismatch"
    assert str(again.value) == "the file of this name and SHA-256 has 1000 bytes, not 50000000000"
