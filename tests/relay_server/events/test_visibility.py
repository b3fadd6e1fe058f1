"""An event's details about a robot are visible only with the right to them."""

from __future__ import annotations

import json
from typing import Any

import pytest

from relay_db.queries import NameCondition, StoredEventRecord
from relay_protocol.rights import Grant, Level, Rules
from relay_server.events.query import NAMING_FIELDS, EventFormatter, may_search

VIEWER = Rules([Grant(Level.VIEWER, (), ())])
NARROW = Rules([Grant(Level.OPERATOR, (), ("*:/secret*", "view:/eye"))])

NAMED = [
    ("publication.begun", {"topic": "/odom"}, True, True),
    ("motion.begun", {"topic": "/secret"}, True, False),
    ("publication.begun", {"topic": "/eye"}, True, True),
    ("robot.suppressed", {"resource": "/secret/wheels"}, True, False),
    ("robot.inhibited", {"resource": "/secret/cam", "ms": 500}, True, False),
    ("robot.inhibited", {"resource": "/scan", "ms": 500}, True, True),
    ("video.joined", {"camera": "/eye"}, True, False),
    ("video.left", {"camera": "/usb", "pictures": 3}, True, True),
    ("call.begun", {"service": "/reset"}, False, True),
    ("call.ended", {"service": "/secret/open", "ok": True}, False, False),
    ("goal.begun", {"action": "/dock", "goal": "g"}, False, True),
    ("param.set", {"param": "/secret:speed", "deleted": False}, False, False),
    ("param.set", {"param": "/base:speed", "deleted": False}, False, True),
]
"""Events, and whether a viewer and somebody who is denied something are told what they name."""


def record(kind: str, data: dict[str, Any], source: str = "relay:rover") -> StoredEventRecord:
    """An event about rover."""
    return StoredEventRecord(1, "default", 1.0, source, kind, 1, "ann", json.dumps(data), 0)


def read(rules: Rules, event: StoredEventRecord) -> Any:
    """The data that its reader gets."""
    formatter = EventFormatter({1: "rover"}, {1: rules})
    reported = json.loads(bytes(formatter.info(event).data))
    assert json.loads(formatter.cells(event)[-1]) == reported
    return reported


@pytest.mark.parametrize(("kind", "data", "viewer", "narrow"), NAMED)
def test_names_are_visible_with_the_right_to_use_them(
    kind: str, data: dict[str, Any], viewer: bool, narrow: bool
) -> None:
    rest = {name: value for name, value in data.items() if name != NAMING_FIELDS[kind]}
    asked = ((NAMING_FIELDS[kind], data[NAMING_FIELDS[kind]]),)
    for rules, reported in ((VIEWER, viewer), (NARROW, narrow)):
        assert read(rules, record(kind, data)) == (data if reported else rest)
        assert (
            may_search(rules, None, asked)
            is may_search(rules, NameCondition("relay:r", prefix=True), asked)
            is reported
        )


def test_why_a_module_failed_is_visible_with_the_right_to_manage_it() -> None:
    data = {
        "module": "base",
        "state": "failed",
        "why": "settings: got an unexpected keyword argument 'volume'",
    }
    owner = Rules([Grant(Level.OWNER, (), ())])
    assert read(owner, record("module.changed", data)) == data
    assert read(VIEWER, record("module.changed", data)) == {"state": "failed"}


def test_events_of_clients_are_not_changed() -> None:
    """For any type, and clients may query it."""
    event = record("call.begun", {"service": "/secret/open"}, source="inspection")
    assert read(VIEWER, event) == {"service": "/secret/open"}
    asked = (("service", "/secret/open"), ("n", "1"))
    for source in (NameCondition("inspection"), NameCondition("rel"), NameCondition("x", prefix=True)):
        assert may_search(VIEWER, source, asked)
    for source in (
        None,
        NameCondition("re", prefix=True),
        NameCondition("", prefix=True),
        NameCondition("relay:rover"),
    ):
        assert not may_search(VIEWER, source, asked)
