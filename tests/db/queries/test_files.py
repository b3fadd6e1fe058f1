"""Lists of files by name."""

from __future__ import annotations

import sys
import threading
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import pytest
from sqlalchemy import insert, inspect

from relay_db import queries
from relay_db.engine import Database
from relay_db.models import StoredFile

LAST = chr(sys.maxunicode)
NAMES = [
    "B",
    "a",
    "a/1",
    "a/2",
    "a/" + LAST,
    "a0",
    "b_c",
    "bxc",
    "b%c",
    "Ärger",
    "é/1",
    "\ud7ff1".encode("utf-16", "surrogatepass").decode("utf-16"),
    "\ue000",
    LAST,
    LAST + "x",
]
IN_ORDER = sorted(NAMES, key=str.encode)


@pytest.fixture
def filled(database: Database) -> Database:
    """The files of robot 1, and others of robot 2."""
    with database.begin() as s:
        for number, name in enumerate(NAMES):
            for robot in (1, 2):
                values = {"robot_id": robot, "name": name, "sha256": f"{number:064x}", "size": 1}
                states = {"state": "stored", "origin": "bags", "modified": 1.0, "state_since": 1.0}
                s.execute(insert(StoredFile).values(**values, **states))
    return database


@pytest.mark.parametrize(
    "prefix",
    ["", "a", "a/", "b_", "b%", "B", "é", "zz", "a/" + LAST, LAST, LAST * 2, "\ud7ff", "\ue000", "Ä"],
)
def test_files_with_a_prefix_are_listed_by_the_bytes_of_their_names(filled: Database, prefix: str) -> None:
    with filled.begin() as s:
        found = queries.list_files(s, 1, prefix, None, 100)
    assert [each.name for each in found] == [each for each in IN_ORDER if each.startswith(prefix)]
    assert {each.robot_id for each in found} <= {1}


def test_pages_of_files_follow_each_other(filled: Database) -> None:
    found: list[str] = []
    after = None
    with filled.begin() as s:
        while page := queries.list_files(s, 1, "", after, 4):
            found += [each.name for each in page]
            after = (page[-1].name, page[-1].id)
    assert found == IN_ORDER


def test_postgresql_orders_names_of_files_by_their_bytes(database: Database) -> None:
    with database.connection() as connection:
        if connection.dialect.name == "postgresql":
            [name] = [
                each for each in inspect(connection).get_columns("stored_file") if each["name"] == "name"
            ]
            assert name["type"].collation == "C"


def test_files_of_two_robots_that_are_added_at_once_do_not_pass_a_quota(database: Database) -> None:
    """Neither sees the other's before it is committed, so the second waits."""
    quotas = queries.FileQuotas(robot=100_000, realm=10_000, relay=10_000)
    with database.begin() as s:
        robots = [queries.add_robot(s, name).id for name in ("one", "two")]

    def add(s: Any, robot: int) -> None:
        new = queries.NewFile(name="a", sha256="0" * 64, size=6000, origin="bags", modified=1.0)
        queries.add_file(s, robot, new, quotas, 1.0)

    def second() -> None:
        with database.begin() as s:
            begun.set()
            add(s, robots[1])

    begun = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        with database.begin() as s:
            add(s, robots[0])
            waiting = pool.submit(second)
            begun.wait(1)
            wait({waiting}, 0.3)
            assert not waiting.done()
        with pytest.raises(queries.FileQuotaExceeded):
            waiting.result(60)
