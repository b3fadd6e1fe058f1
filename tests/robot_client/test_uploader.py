"""The robot's uploader: what it hashes how often, and when people learn that a group has a problem."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from twisted.internet.defer import Deferred

from robot_client.files import folder as folders
from robot_client.files.folder import OpenFile
from robot_client.files.uploader import MISMATCHES
from tests.worlds.file_uploads import FileWorld, Steps


class NamedSteps(Steps):
    """Counts the work in threads by its name, in order."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def run(self, work: Callable[..., Any], *args: Any, **more: Any) -> Deferred[Any]:
        self.names.append(getattr(work, "__name__", ""))
        return super().run(work, *args, **more)


def test_a_lost_link_does_not_cost_the_hash(tmp_path: Path) -> None:
    world = FileWorld(tmp_path)
    steps = NamedSteps()
    world.start_robot(steps)
    path = world.write("a.bag", b"x" * 3_000_000)
    world.uploader.check()
    while "hash_part" not in steps.names:
        world.clock.advance(0)
        world.pump()
    world.cut()
    world.run(30)
    assert not path.exists()
    world.check("a.bag", b"x" * 3_000_000)
    assert Counter(steps.names)["hash_part"] == 1


def test_a_large_file_is_hashed_in_turns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small file that comes later is stored before the hash of the large one is known."""
    monkeypatch.setattr(folders, "HASHED_AT_ONCE", 1)
    monkeypatch.setattr(folders, "MIB", 2000)
    world = FileWorld(tmp_path)
    finished: list[int] = []

    def turn(file: OpenFile) -> bool:
        more = hash_part(file)
        if not more:
            finished.append(file.state.size)
        return more

    hash_part = OpenFile.hash_part
    monkeypatch.setattr(OpenFile, "hash_part", turn)

    class LaterSteps(Steps):
        """Does one step for each turn of the clock, as a pool of one thread does."""

        def run(self, work: Callable[..., Any], *args: Any, **more: Any) -> Deferred[Any]:
            waiting: Deferred[Any] = Deferred()
            queue.append((waiting, lambda: work(*args, **more)))
            return waiting

    queue: list[tuple[Deferred[Any], Callable[[], Any]]] = []
    world.start_robot(LaterSteps())
    large, small = world.write("large.bag", b"x" * 2_000_000), world.folder / "small.bag"
    for turn_number in range(3000):
        if turn_number == 100:
            world.write("small.bag", b"small")
        world.clock.advance(0.02)
        world.uploader.check()
        world.pump()
        if queue:
            waiting, work = queue.pop(0)
            try:
                waiting.callback(work())
            except OSError as error:
                waiting.errback(error)
    assert finished == [5, 2_000_000]
    assert not small.exists()
    assert not large.exists()


def test_a_file_that_always_arrives_changed_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot with bad memory or a bad disk: the first copies may be chance."""
    world = FileWorld(tmp_path)
    path = world.write("a.bag", b"right")
    read = OpenFile.read
    seen: list[int] = []

    def wrong(file: OpenFile, offset: int, size: int) -> bytes:
        seen.append(len(world.alerts))
        return b"wrong"[offset:]

    monkeypatch.setattr(OpenFile, "read", wrong)
    world.run(120)
    assert path.exists()
    assert seen[:MISMATCHES] == [0] * MISMATCHES
    ((text, over),) = world.alerts
    assert "a file of the group bags can't be uploaded" in text
    assert not over
    monkeypatch.setattr(OpenFile, "read", read)
    world.run(30)
    assert world.alerts[-1] == ("files of the group bags are uploaded again", True)
    world.check("a.bag", b"right")


def test_a_group_whose_folder_is_missing_is_reported_once(tmp_path: Path) -> None:
    world = FileWorld(tmp_path)
    world.folder.rmdir()
    world.run(60)
    assert world.alerts == [
        ("the folder of the file group bags can't be read: No such file or directory", False)
    ]
    world.folder.mkdir()
    world.run(60)
    assert world.alerts[1:] == [("the folder of the file group bags can be read again", True)]
    world.write("a.bag", b"a")
    world.run(30)
    world.check("a.bag", b"a")
