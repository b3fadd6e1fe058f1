"""The robot's database of confirmed files when it is damaged."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path

from robot_client.files.confirmed import ConfirmedFiles
from robot_client.files.folder import FileState
from robot_client.files.settings import FileGroupSettings
from tests.worlds.file_uploads import OLD, FileWorld, Steps

STATE = FileState(1, 2, 3)


def filled(path: Path) -> None:
    confirmed = ConfirmedFiles(path)
    for number in range(500):
        confirmed.add("bags", f"{number}.bag", STATE)
    confirmed.close()


def test_a_database_whose_pages_are_damaged_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "confirmed.db"
    filled(path)
    content = bytearray(path.read_bytes())
    content[4096:] = b"\xff" * (len(content) - 4096)
    path.write_bytes(content)
    confirmed = ConfirmedFiles(path)
    assert not confirmed.has("bags", "7.bag", STATE)
    confirmed.add("bags", "7.bag", STATE)
    assert confirmed.has("bags", "7.bag", STATE)
    confirmed.close()


def test_a_database_without_its_table_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "confirmed.db"
    confirmed = ConfirmedFiles(path)
    confirmed.add("bags", "a.bag", STATE)
    with sqlite3.connect(path) as other:
        other.execute("DROP TABLE confirmed")
    other.close()
    assert not confirmed.has("bags", "a.bag", STATE)
    confirmed.close()


def test_a_database_that_can_not_be_used_stops_only_the_groups_that_need_it(tmp_path: Path) -> None:
    world = FileWorld(tmp_path)
    kept = tmp_path / "kept"
    kept.mkdir()
    (kept / "a").write_bytes(b"a")
    os.utime(kept / "a", (OLD, OLD))
    (world.state / "confirmed.db").mkdir()
    world.groups.insert(0, FileGroupSettings(name="kept", folder=str(kept)))
    world.start_robot(Steps())
    world.write("b.bag", b"b")
    world.run(30)
    world.check("b.bag", b"b")
