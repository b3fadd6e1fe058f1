"""``switchboard directory``."""

from __future__ import annotations

import json
import time
from typing import Any

import pytest

from relay_db import queries
from relay_db.engine import Database


@pytest.fixture
def entries(cli: Any) -> Any:
    """Ann has registered two entries, one about rover, and one with an expired lease."""
    cli.user("ann")
    cli.ok("robot", "add", "rover")
    database = Database(f"sqlite:///{cli.data / 'switchboard.db'}")
    now = time.time()
    with database.begin() as s:
        ann = queries.find_user(s, "ann")
        assert ann is not None
        for id, kind, name, robot, since in (
            ("a1", "application", "map", None, now),
            ("a2", "service", "speech", 1, now),
            ("a3", "service", "over", None, now - 4000),
        ):
            new = queries.NewEntry("default", kind, name, "http://a/", "x", robot, ann.id, '{"a":1}', 3600.0)
            queries.register_entry(s, new, id, since, of_user=9, of_realm=9)
    database.close()
    return cli


def test_registered_entries_are_listed(entries: Any) -> None:
    assert [each["id"] for each in entries.json("directory")] == ["a1", "a2"]
    (reported,) = entries.json("directory", "--kind", "application")
    assert {name: reported[name] for name in ("name", "robot", "address", "user", "data", "ttl")} == {
        "name": "map",
        "robot": None,
        "address": "http://a/",
        "user": "ann",
        "data": {"a": 1},
        "ttl": 3600.0,
    }
    assert [each["id"] for each in entries.json("directory", "--robot", "rover")] == ["a2"]
    assert entries.json("directory", "--robot", "rover", "--kind", "application") == []
    shown = entries.ok("directory")
    assert "speech" in shown and "rover" in shown and "over" not in shown.replace("rover", "")
    assert "no robot 'arm'" in entries.fails("directory", "--robot", "arm")


def test_an_entry_is_removed_once(entries: Any) -> None:
    """It makes an audit entry and an event; a running relay applies it."""
    assert entries.json("directory", "remove", "a2", "--yes") == {"id": "a2", "removed": True}
    assert [each["id"] for each in entries.json("directory")] == ["a1"]
    for id in ("a2", "a3", "nobody's"):
        assert f"there is no entry '{id}'" in entries.fails("directory", "remove", id, "--yes")
    (audited,) = [each for each in entries.json("audit", "list") if each["action"] == "directory.remove"]
    assert (audited["target"], audited["data"]["name"], audited["data"]["registrant"]) == (
        "a2",
        "speech",
        "ann",
    )
    (event,) = entries.json("events", "--kind", "removed")
    assert (event["source"], event["robot"], event["user"]) == ("relay:rover", "rover", None)
    assert event["data"]["entry"] == "a2" and event["data"]["address"] == "http://a/"
    asked = entries("directory", "remove", "a1", stdin="n\n")
    assert asked.exit_code == 1 and "Remove the application map of ann" in asked.stderr
    assert "Removed the application map." in entries.ok("directory", "remove", "a1", "--yes")


def test_its_help_shows_examples(cli: Any) -> None:
    shown = cli.ok("directory", "--help")
    assert "switchboard directory --robot rover" in shown and "remove" in shown
    assert "switchboard directory remove" in cli.ok("directory", "remove", "--help")
    assert json.loads(cli.ok("directory", "--json")) == []
