"""Uploads of files from a robot to a relay, with a cut link or a killed process at each step."""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from twisted.internet.defer import Deferred

from relay_protocol.limits import KIB
from relay_server.files import incoming
from tests.worlds.file_uploads import OLD, FileWorld, Steps

CONTENT = bytes(range(256)) * 4 * 40
"""40 KiB: several parts."""


@pytest.fixture
def world(tmp_path: Path) -> FileWorld:
    return FileWorld(tmp_path)


def test_a_file_is_stored_confirmed_and_then_deleted_on_the_robot(world: FileWorld) -> None:
    path = world.write("day 1/straße ☃.bag", CONTENT)
    world.run(5)
    world.check("day 1/straße ☃.bag", CONTENT)
    assert not path.exists()
    assert [kind for kind, _ in world.received] == ["file.stored"]


def test_a_file_of_0_bytes_is_uploaded(world: FileWorld) -> None:
    path = world.write("empty", b"")
    world.run(5)
    world.check("empty", b"")
    assert not path.exists()


def test_a_kept_file_is_uploaded_once_also_by_a_new_daemon(tmp_path: Path) -> None:
    world = FileWorld(tmp_path, after="keep")
    path = world.write("a", CONTENT)
    world.run(30)
    world.start_robot(Steps())
    world.run(30)
    world.check("a", CONTENT)
    assert path.exists()
    assert len(world.received) == 1


STEPS = range(1, 16)
"""More than either end takes for the file of these tests: those beyond the last strike nothing."""


@pytest.mark.parametrize("done", [False, True], ids=["before", "after"])
@pytest.mark.parametrize("at", STEPS)
def test_a_relay_that_dies_at_any_step_loses_nothing(world: FileWorld, at: int, done: bool) -> None:
    path = world.write("a.bag", CONTENT)
    world.start_relay(Steps(at, done, world.cut))
    world.run(3)
    assert path.exists() or [world.read(each) for each in world.stored()] == [CONTENT]
    world.cut()
    world.start_relay(Steps())
    world.run(40)
    world.check("a.bag", CONTENT)
    assert not path.exists()
    assert world.incoming() == []


@pytest.mark.parametrize("done", [False, True], ids=["before", "after"])
@pytest.mark.parametrize("at", STEPS)
@pytest.mark.parametrize("after", ["delete", "keep"])
def test_a_daemon_that_dies_at_any_step_loses_nothing(
    tmp_path: Path, at: int, done: bool, after: str
) -> None:
    world = FileWorld(tmp_path, after=after)
    path = world.write("a.bag", CONTENT)
    world.start_robot(Steps(at, done, world.cut))
    world.run(3)
    assert path.exists() or [world.read(each) for each in world.stored()] == [CONTENT]
    world.cut()
    world.start_robot(Steps())
    world.run(40)
    world.check("a.bag", CONTENT)
    assert path.exists() is (after == "keep")


@pytest.mark.parametrize("of", ["robot", "relay"])
@pytest.mark.parametrize("at", STEPS)
def test_a_link_that_is_cut_at_any_step_loses_nothing(world: FileWorld, at: int, of: str) -> None:
    path = world.write("a.bag", CONTENT)
    steps = Steps(at, True)

    def cut() -> None:
        steps.dead = False
        world.cut()

    steps.struck = cut
    world.start_robot(steps) if of == "robot" else world.start_relay(steps)
    world.run(60)
    world.check("a.bag", CONTENT)
    assert not path.exists()


def test_an_upload_continues_where_it_was_broken_off(world: FileWorld) -> None:
    world.write("a.bag", CONTENT * 20)
    world.start_relay(Steps(8, True, world.cut))
    world.run(3)
    held = sum(each.stat().st_size for each in world.incoming())
    assert 0 < held < len(CONTENT) * 20
    sent = world.offered_bytes
    world.start_relay(Steps())
    world.run(40)
    world.check("a.bag", CONTENT * 20)
    assert world.offered_bytes - sent < len(CONTENT) * 20 - held / 2


def test_a_file_that_changes_while_it_is_uploaded_is_not_deleted(world: FileWorld) -> None:
    path = world.write("a.bag", CONTENT)

    def change() -> None:
        world.robot_steps.dead = False
        path.write_bytes(CONTENT[::-1])
        os.utime(path, (OLD + 2000, OLD + 2000))

    world.start_robot(Steps(5, True, change))
    world.run(5)
    assert path.read_bytes() == CONTENT[::-1]
    world.clock.advance(2000)
    world.cut()
    world.run(40)
    assert not path.exists()
    assert CONTENT[::-1] in [world.read(each) for each in world.stored()]
    assert all(hashlib.sha256(world.read(each)).hexdigest() == each.sha256 for each in world.stored())


def test_new_content_of_an_old_name_replaces_nothing(world: FileWorld) -> None:
    for content in (b"first", b"second"):
        world.write("log", content)
        world.run(20)
    assert sorted(map(world.read, world.stored())) == [b"first", b"second"]


def test_a_full_disk_of_the_relay_is_an_alert_and_loses_nothing(
    world: FileWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = world.write("a.bag", CONTENT)
    monkeypatch.setattr(incoming, "free_bytes", lambda folder: 20 * KIB)
    world.run(10)
    assert path.exists()
    assert world.stored() == []
    assert world.alerts == [
        (
            "a file of the group bags can't be uploaded: the relay's disk is full; its administrator must make room",
            False,
        )
    ]
    monkeypatch.undo()
    world.run(90)
    world.check("a.bag", CONTENT)
    assert not path.exists()
    assert world.alerts[-1][1]


@pytest.mark.parametrize(
    ("quota", "words"),
    [
        ("robot", "files of this robot may take 0.1 MB, of which 0.0 MB are left, and this one needs 0.0 MB"),
        ("realm", "files of this realm may take"),
        ("relay", "the relay's space for files is used up"),
    ],
)
def test_a_used_up_quota_is_explained(world: FileWorld, quota: str, words: str) -> None:
    world.quotas = world.quotas._replace(**{quota: 60_000})
    world.start_relay(Steps())
    world.write("a.bag", CONTENT)
    world.run(10)
    path = world.write("b.bag", CONTENT[1:])
    world.run(10)
    assert [each.name for each in world.stored()] == ["bags/a.bag"]
    assert path.exists()
    assert words in world.alerts[0][0]


def test_links_and_files_outside_of_the_folder_are_left_alone(world: FileWorld, tmp_path: Path) -> None:
    outside = tmp_path / "secret"
    outside.mkdir()
    (outside / "key").write_bytes(b"secret")
    os.utime(outside / "key", (OLD, OLD))
    (world.folder / "link").symlink_to(outside / "key")
    (world.folder / "folder").symlink_to(outside)
    os.mkfifo(world.folder / "pipe")
    world.write("good", b"good")
    world.run(20)
    world.check("good", b"good")
    assert (outside / "key").read_bytes() == b"secret"


def test_a_folder_that_becomes_a_link_while_it_is_searched_is_not_followed(
    world: FileWorld, tmp_path: Path
) -> None:
    path = world.write("sub/a", b"good")
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "a").write_bytes(b"secret")

    def swap() -> None:
        world.robot_steps.dead = False
        path.unlink()
        path.parent.rmdir()
        path.parent.symlink_to(tmp_path / "outside")

    world.start_robot(Steps(1, True, swap))
    world.run(20)
    assert world.stored() == []
    assert (tmp_path / "outside" / "a").exists()


def test_a_file_whose_name_can_not_be_sent_stays_and_is_reported(world: FileWorld) -> None:
    paths = [
        world.write("new\nline", b"a"),
        world.write("\ufffd.bag", b"c"),
        world.folder / os.fsdecode(b"\xff.bag"),
    ]
    paths[2].write_bytes(b"b")
    os.utime(paths[2], (OLD, OLD))
    world.run(20)
    assert all(each.exists() for each in paths)
    assert world.stored() == []
    assert any("its name is not UTF-8; rename it" in text for text, _ in world.alerts)
    assert sum("control characters or U+FFFD" in text for text, _ in world.alerts) == 2


def test_a_database_that_does_not_answer_delays_an_upload(world: FileWorld) -> None:
    path = world.write("a.bag", CONTENT)
    world.store.down = True
    world.run(10)
    assert path.exists()
    world.store.down = False
    world.run(30)
    world.check("a.bag", CONTENT)
    assert not path.exists()


def test_a_file_is_not_uploaded_while_it_is_written(world: FileWorld) -> None:
    path = world.write("a.bag", CONTENT)
    now = OLD + world.clock.seconds()
    os.utime(path, (now, now))
    world.run(5)
    assert world.stored() == []
    world.run(30)
    world.check("a.bag", CONTENT)


def test_a_group_for_a_full_disk_waits_for_it(tmp_path: Path) -> None:
    world = FileWorld(tmp_path, when="full")
    world.write("a.bag", CONTENT)
    world.run(20)
    assert world.stored() == []
    world.full = True
    world.run(20)
    world.check("a.bag", CONTENT)


def test_patterns_choose_files(tmp_path: Path) -> None:
    world = FileWorld(tmp_path, patterns=["*.bag", "maps/*.yaml"])
    for name in ("a.bag", "deep/er/b.bag", "maps/c.yaml", "d.yaml", "e.bag.tmp"):
        world.write(name, name.encode())
    world.run(20)
    assert [each.name for each in world.stored()] == ["bags/a.bag", "bags/deep/er/b.bag", "bags/maps/c.yaml"]


def test_contents_of_many_files_are_remembered_in_batches(world: FileWorld) -> None:
    for number in range(600):
        world.write(f"{number:03}", b"%d" % number)
    most = 0
    for _ in range(60):
        world.run(1)
        most = max(most, world.uploader.remembered)
    assert len(world.stored()) == 600
    assert most <= 256 + 8
    assert list(world.folder.iterdir()) == []


def test_contents_of_another_file_under_the_same_number_are_not_confirmed(tmp_path: Path) -> None:
    """The database was restored, and is older than the storage: it gives a number again. Both files are of one size."""
    (tmp_path / "before").mkdir()
    (tmp_path / "after").mkdir()
    before, after = FileWorld(tmp_path / "before"), FileWorld(tmp_path / "after")
    before.write("a.log", b"A" * 1000)
    before.run(10)
    before.check("a.log", b"A" * 1000)
    shutil.copytree(before.data, after.data, dirs_exist_ok=True)
    path = after.write("b.log", b"B" * 1000)
    after.run(15)
    assert not path.exists()
    after.check("b.log", b"B" * 1000)


def test_files_that_are_being_stored_do_not_hold_up_the_parts_of_others(world: FileWorld) -> None:
    """As with an S3-compatible storage that takes minutes."""

    class Slow:
        """Stores nothing until it may."""

        def __init__(self) -> None:
            self.held: list[Deferred[None]] = []

        async def run(self, work: Any, *arguments: object) -> Any:
            waiting: Deferred[None] = Deferred()
            self.held.append(waiting)
            await waiting
            return work(*arguments)

    slow = Slow()
    world.uploads._storing = slow  # type: ignore[assignment]
    for name in ("a.bag", "b.bag", "c.bag"):
        world.write(name, bytes(3_000_000))
        world.run(10)
    assert len(slow.held) > 1
    assert sum(each.received for each in world.uploads.of(world.robot_id)) == 3_000_000 * len(slow.held)
    while slow.held:
        slow.held.pop(0).callback(None)
        world.run(10)
    assert len(world.stored()) == 3
