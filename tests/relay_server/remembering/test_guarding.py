"""What an event names of a robot is told to who may use that."""

from __future__ import annotations

import json
from typing import Any

import pytest

from relay_db.queries import NameIs, StoredEventRecord
from relay_protocol.rights import Grant, Level, Rules
from relay_server.events.query import EventFormatter
from relay_server.events.visibility import FIELDS, may_ask

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
    """What its reader is told."""
    forms = EventFormatter({1: "rover"}, {1: rules})
    told = json.loads(bytes(forms.json(event)["data"]))
    assert json.loads(forms.cells(event)[-1]) == told
    return told


@pytest.mark.parametrize(("kind", "data", "viewer", "narrow"), NAMED)
def test_names_are_told_to_who_may_use_them(
    kind: str, data: dict[str, Any], viewer: bool, narrow: bool
) -> None:
    """All else is told to everybody of the robot; and nobody finds them out by asking for them."""
    rest = {name: value for name, value in data.items() if name != FIELDS[kind]}
    asked = ((FIELDS[kind], data[FIELDS[kind]]),)
    for rules, told in ((VIEWER, viewer), (NARROW, narrow)):
        assert read(rules, record(kind, data)) == (data if told else rest)
        assert may_ask(rules, None, asked) is may_ask(rules, NameIs("relay:r", prefix=True), asked) is told


def test_what_programs_write_is_theirs() -> None:
    """Under whatever name, and one may ask for it."""
    event = record("call.begun", {"service": "/secret/open"}, source="inspection")
    assert read(VIEWER, event) == {"service": "/secret/open"}
    asked = (("service", "/secret/open"), ("n", "1"))
    for source in (NameIs("inspection"), NameIs("rel"), NameIs("x", prefix=True)):
        assert may_ask(VIEWER, source, asked)
    for source in (None, NameIs("re", prefix=True), NameIs("", prefix=True), NameIs("relay:rover")):
        assert not may_ask(VIEWER, source, asked)
