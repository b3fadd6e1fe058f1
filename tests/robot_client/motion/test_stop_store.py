"""The stop on the disk."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from relay_protocol import link
from relay_protocol.errors import Unavailable
from robot_client.motion.stop_store import GOALS_FILE, STOP_FILE, DiskStopStore

STOP = link.Stopped(by="eve", since=12.5, why="a child on the floor")


def test_without_a_record_the_robot_is_not_stopped(tmp_path: Path) -> None:
    assert DiskStopStore(tmp_path).load() is None


def test_stored_stop_is_loaded_by_the_next_daemon(tmp_path: Path) -> None:
    """Only its owner may read the file."""
    DiskStopStore(tmp_path).store(STOP)
    assert DiskStopStore(tmp_path).load() == STOP
    assert [each.name for each in tmp_path.iterdir()] == [STOP_FILE]
    assert stat.S_IMODE((tmp_path / STOP_FILE).stat().st_mode) == 0o600


def test_later_stop_replaces_the_record(tmp_path: Path) -> None:
    stop_store = DiskStopStore(tmp_path)
    stop_store.store(link.Stopped(by="x" * 200, since=1.0, why="y" * 2000))
    stop_store.store(STOP)
    assert stop_store.load() == STOP


def test_clear_removes_the_record(tmp_path: Path) -> None:
    """Also when there is none."""
    stop_store = DiskStopStore(tmp_path)
    stop_store.store(STOP)
    stop_store.clear()
    stop_store.clear()
    assert DiskStopStore(tmp_path).load() is None


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[]", b'{"by": 3}', b"[" * 5000, b'{"by":"x"'])
def test_a_damaged_record_counts_as_a_stop(tmp_path: Path, content: bytes) -> None:
    (tmp_path / STOP_FILE).write_bytes(content)
    stopped = DiskStopStore(tmp_path).load()
    assert stopped is not None
    assert "damaged" in stopped.why
    assert stopped.since > 0


def test_a_record_that_can_not_be_read_counts_as_a_stop(tmp_path: Path) -> None:
    """Here a folder of its name."""
    (tmp_path / STOP_FILE).mkdir()
    stopped = DiskStopStore(tmp_path).load()
    assert stopped is not None
    assert "can't be read" in stopped.why


def test_store_that_fails_raises_unavailable(tmp_path: Path) -> None:
    """Here the folder is missing."""
    stop_store = DiskStopStore(tmp_path / "gone")
    with pytest.raises(Unavailable, match="can't be stored"):
        stop_store.store(STOP)
    with pytest.raises(Unavailable, match="can't be removed"):
        stop_store.clear()


def test_unfinished_write_does_not_replace_the_record(tmp_path: Path) -> None:
    DiskStopStore(tmp_path).store(STOP)
    (tmp_path / (STOP_FILE + ".pending")).write_bytes(b"{")
    assert DiskStopStore(tmp_path).load() == STOP
    DiskStopStore(tmp_path).store(STOP)
    assert [each.name for each in tmp_path.iterdir()] == [STOP_FILE]


def test_stored_actions_are_loaded_by_the_next_daemon(tmp_path: Path) -> None:
    """Without any, there is no file."""
    assert DiskStopStore(tmp_path).load_actions() == []
    for kept in (["/spin"], ["/left/spin", "/right/spin"]):
        DiskStopStore(tmp_path).store_actions(kept)
        assert DiskStopStore(tmp_path).load_actions() == kept
    assert [each.name for each in tmp_path.iterdir()] == [GOALS_FILE]
    assert stat.S_IMODE((tmp_path / GOALS_FILE).stat().st_mode) == 0o600
    DiskStopStore(tmp_path).store_actions([])
    assert DiskStopStore(tmp_path).load_actions() == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("body", [b"", b"[", b"{}", b"[1]", b"\xff", b"[" * 5000])
def test_damaged_list_of_actions_loads_as_none(tmp_path: Path, body: bytes) -> None:
    (tmp_path / GOALS_FILE).write_bytes(body)
    assert DiskStopStore(tmp_path).load_actions() is None


def test_list_of_actions_that_can_not_be_stored_raises_unavailable(tmp_path: Path) -> None:
    with pytest.raises(Unavailable, match="can't be stored"):
        DiskStopStore(tmp_path / "gone").store_actions(["/spin"])
