"""The stop on the disk."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from relay_protocol import link
from relay_protocol.errors import Unavailable
from robot_client.motion.stop_store import FILE, GOALS, DiskStopStore

STOP = link.Stopped(by="eve", since=12.5, why="a child on the floor")


def test_without_a_record_the_robot_is_not_stopped(tmp_path: Path) -> None:
    """A folder without one says so."""
    assert DiskStopStore(tmp_path).load() is None


def test_what_is_kept_is_found_by_the_next(tmp_path: Path) -> None:
    """Who, since when and why; for the owner's eyes alone, and nothing is left beside it."""
    DiskStopStore(tmp_path).keep(STOP)
    assert DiskStopStore(tmp_path).load() == STOP
    assert [each.name for each in tmp_path.iterdir()] == [FILE]
    assert stat.S_IMODE((tmp_path / FILE).stat().st_mode) == 0o600


def test_another_stop_takes_its_place(tmp_path: Path) -> None:
    """The record is written anew as a whole."""
    latch = DiskStopStore(tmp_path)
    latch.keep(link.Stopped(by="x" * 200, since=1.0, why="y" * 2000))
    latch.keep(STOP)
    assert latch.load() == STOP


def test_what_was_cleared_is_gone(tmp_path: Path) -> None:
    """Clearing may be done twice."""
    latch = DiskStopStore(tmp_path)
    latch.keep(STOP)
    latch.clear()
    latch.clear()
    assert DiskStopStore(tmp_path).load() is None


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[]", b'{"by": 3}', b"[" * 5000, b'{"by":"x"'])
def test_a_damaged_record_counts_as_a_stop(tmp_path: Path, content: bytes) -> None:
    """Whatever stands in the file, the robot is stopped, and says why."""
    (tmp_path / FILE).write_bytes(content)
    stopped = DiskStopStore(tmp_path).load()
    assert stopped is not None
    assert "damaged" in stopped.why
    assert stopped.since > 0


def test_a_record_that_can_not_be_read_counts_as_a_stop(tmp_path: Path) -> None:
    """Here a folder of its name."""
    (tmp_path / FILE).mkdir()
    stopped = DiskStopStore(tmp_path).load()
    assert stopped is not None
    assert "can't be read" in stopped.why


def test_a_disk_that_takes_nothing_is_told(tmp_path: Path) -> None:
    """Here the folder is gone."""
    latch = DiskStopStore(tmp_path / "gone")
    with pytest.raises(Unavailable, match="can't be kept"):
        latch.keep(STOP)
    with pytest.raises(Unavailable, match="can't be taken away"):
        latch.clear()


def test_what_a_crash_left_half_written_is_not_the_record(tmp_path: Path) -> None:
    """The record before it still counts."""
    DiskStopStore(tmp_path).keep(STOP)
    (tmp_path / (FILE + ".pending")).write_bytes(b"{")
    assert DiskStopStore(tmp_path).load() == STOP
    DiskStopStore(tmp_path).keep(STOP)
    assert [each.name for each in tmp_path.iterdir()] == [FILE]


def test_actions_with_goals_are_found_by_the_next(tmp_path: Path) -> None:
    """Which they are, for the owner's eyes alone; with none left there is no file either."""
    assert DiskStopStore(tmp_path).goals() == []
    for kept in (["/spin"], ["/left/spin", "/right/spin"]):
        DiskStopStore(tmp_path).keep_goals(kept)
        assert DiskStopStore(tmp_path).goals() == kept
    assert [each.name for each in tmp_path.iterdir()] == [GOALS]
    assert stat.S_IMODE((tmp_path / GOALS).stat().st_mode) == 0o600
    DiskStopStore(tmp_path).keep_goals([])
    assert DiskStopStore(tmp_path).goals() == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("body", [b"", b"[", b"{}", b"[1]", b"\xff", b"[" * 5000])
def test_a_damaged_note_of_goals_says_nothing(tmp_path: Path, body: bytes) -> None:
    """It is not taken for an empty one."""
    (tmp_path / GOALS).write_bytes(body)
    assert DiskStopStore(tmp_path).goals() is None


def test_goals_that_can_not_be_noted_are_said(tmp_path: Path) -> None:
    """In words."""
    with pytest.raises(Unavailable, match="can't be kept"):
        DiskStopStore(tmp_path / "gone").keep_goals(["/spin"])
