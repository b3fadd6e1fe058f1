"""``switchboard events``."""

from __future__ import annotations

import csv
import io
import json
from typing import Any

import pytest

from relay_db import queries
from relay_db.engine import Database
from relay_server.cli import events as module


def new(
    at: float, source: str, kind: str, robot: int | None = None, data: str = "{}"
) -> queries.NewStoredEvent:
    """An event by ann."""
    return queries.NewStoredEvent("default", at, source, kind, robot, "ann", data)


def write(cli: Any, *new_ones: queries.NewStoredEvent) -> None:
    """As a relay does."""
    database = Database(f"sqlite:///{cli.data / 'switchboard.db'}")
    with database.begin() as s:
        queries.store_events(s, new_ones)
    database.close()


@pytest.fixture
def memory(cli: Any) -> Any:
    """Three events, two of them about rover."""
    cli.ok("robot", "add", "rover")
    write(
        cli,
        new(10.0, "relay:rover", "robot.online", 1),
        new(20.0, "app", "=greeted", None, '{"who":"bob"}'),
        new(30.0, "relay:rover", "client.joined", 1, '{"why":"\\u001b[2J"}'),
    )
    return cli


def test_events_are_listed_the_latest_last(memory: Any) -> None:
    kinds = ["robot.online", "=greeted", "client.joined"]
    assert [each["kind"] for each in memory.json("events")] == kinds
    assert memory.json("events", "--source", "app") == [
        {
            "id": 2,
            "source": "app",
            "kind": "=greeted",
            "robot": None,
            "user": "ann",
            "at": 20.0,
            "data": {"who": "bob"},
            "use_count": 0,
        }
    ]
    assert [each["kind"] for each in memory.json("events", "--robot", "r*", "--limit", "1")] == kinds[2:]
    assert memory.json("events", "--robot", "other") == memory.json("events", "--last", "60") == []
    assert [each["id"] for each in memory.json("events", "--user", "ann", "--kind", "robot.*")] == [1]
    shown = memory.ok("events")
    assert "rover" in shown and "1970-01-01 00:00:30Z" in shown and "\x1b" not in shown


def test_events_are_written_as_a_table(memory: Any) -> None:
    """Newest first, without formulas, as many as requested."""
    rows = list(csv.DictReader(io.StringIO(memory.ok("events", "--csv", "--limit", "2"))))
    assert [(row["id"], row["kind"], row["robot"]) for row in rows] == [
        ("3", "client.joined", "rover"),
        ("2", "'=greeted", ""),
    ]


@pytest.mark.parametrize(
    "options",
    [("--csv", "--json"), ("--csv", "--follow"), ("--kind", "*x"), ("--last", "soon"), ("--last", "0")],
)
def test_invalid_requests_are_refused(memory: Any, options: tuple[str, ...]) -> None:
    assert memory.fails("events", *options)


@pytest.mark.parametrize("as_json", [True, False])
def test_new_events_follow(memory: Any, monkeypatch: pytest.MonkeyPatch, as_json: bool) -> None:
    """One event per line until Ctrl-C."""
    turns = iter([lambda: write(memory, new(40.0, "app", "x"), new(50.0, "other", "y"))])

    def sleep(seconds: float) -> None:
        for each in turns:
            each()
            return
        raise KeyboardInterrupt

    monkeypatch.setattr(module.time, "sleep", sleep)
    lines = memory.ok("events", "--follow", "--source", "app", *(["--json"] if as_json else [])).splitlines()
    if as_json:
        assert [json.loads(line)["id"] for line in lines] == [2, 4]
    else:
        assert lines[1] == "1970-01-01 00:00:40Z  app  x  ann"
