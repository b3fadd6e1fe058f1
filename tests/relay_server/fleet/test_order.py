"""Valid fleet orders."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, MalformedMessage
from relay_server.fleet.order import MAX_PATTERNS, MAX_TARGETS, FleetStopOrder, Order


def order(**fields: Any) -> Order:
    """A checked order."""
    body = json.dumps({"robots": ["*"], **fields}).encode()
    if fields.get("do") == "stop":
        made = jsontext.decode(msgspec.json.Decoder(FleetStopOrder), body).order
    else:
        made = jsontext.decode(msgspec.json.Decoder(Order), body)
    made.check()
    return made


@pytest.mark.parametrize(
    ("fields", "subject"),
    [
        ({"do": "stop", "why": "fire"}, ""),
        ({"do": "resume"}, ""),
        ({"do": "call", "service": "/start"}, "/start"),
        ({"do": "call", "service": "/set", "type": "std_srvs/srv/SetBool", "args": {"data": True}}, "/set"),
        ({"do": "publish", "topic": "/mode", "msg": {"data": "dock"}}, "/mode"),
        ({"do": "set", "name": "/driver:speed", "value": 0.5}, "/driver:speed"),
        ({"do": "set", "name": "/driver:on", "value": False, "timeout": 0.1}, "/driver:on"),
        ({"do": "module", "module": "cleaning", "action": "start"}, "start cleaning"),
    ],
)
def test_known_orders(fields: dict[str, Any], subject: str) -> None:
    """Each kind with its fields."""
    assert order(**fields).subject == subject


@pytest.mark.parametrize(
    ("given", "kept"), [("press-1", "press-1"), (7, ""), (None, ""), ("x" * 65, ""), (["x"], "")]
)
def test_no_stop_is_refused_for_its_id(given: Any, kept: str) -> None:
    """An invalid id is ignored."""
    assert order(do="stop", stop_id=given).stop_id == kept


def test_only_a_stop_has_an_id() -> None:
    with pytest.raises(Invalid, match="'stop_id' does not go with 'resume'"):
        order(do="resume", stop_id="press-1")


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"do": "call"}, "'call' needs 'service'"),
        ({"do": "publish", "msg": {}}, "'publish' needs 'topic'"),
        ({"do": "set", "name": "/a:b"}, "'set' needs 'value'"),
        ({"do": "set", "value": 1}, "'set' needs 'name'"),
        ({"do": "resume", "service": "/start"}, "'service' does not go with 'resume'"),
        ({"do": "call", "service": "/start", "msg": {"a": 1}}, "'msg' does not go with 'call'"),
        ({"do": "publish", "topic": "/a", "value": 0}, "'value' does not go with 'publish'"),
        ({"do": "resume", "why": "x" * 501}, "'why' must be a string of at most 500 characters"),
        ({"do": "call", "service": "/start", "why": None}, "'why' must be a string"),
        ({"do": "publish", "topic": "/a", "why": "x"}, "'why' does not go with 'publish'"),
    ],
)
def test_invalid_value_is_reported(fields: dict[str, Any], words: str) -> None:
    with pytest.raises(Invalid, match=words):
        order(**fields)


@pytest.mark.parametrize(
    ("why", "kept"), [("fire", "fire"), (None, ""), (7, ""), ({"a": [1]}, ""), ("x" * 501, "x" * 500)]
)
def test_no_stop_is_refused_for_its_reason(why: Any, kept: str) -> None:
    """Invalid reasons are left out."""
    assert order(do="stop", why=why).why == kept


@pytest.mark.parametrize(
    "more",
    [
        {"wy": "typo"},
        {"service": "/start"},
        {"msg": 3},
        {"timeout": 0},
        {"timeout": "soon"},
        {"new": {"a": [1]}},
    ],
)
def test_no_stop_is_refused_for_what_does_not_go_with_it(more: dict[str, Any]) -> None:
    """Other fields are ignored: the sender wants the robots to stand."""
    made = order(do="stop", why="fire", **more)
    assert (made.robots, made.do, made.why, made.subject) == (["*"], "stop", "fire", "")


def test_an_order_may_name_many_robots() -> None:
    """As many as it may select, since a page with all robots names each."""
    names = [f"rover-{number}" for number in range(MAX_TARGETS)]
    for do in ("stop", "resume"):
        assert order(do=do, robots=names).robots == names


@pytest.mark.parametrize("one", ["rover-*", "rover-?", "rover-[12]", "group:hall"])
@pytest.mark.parametrize("do", ["stop", "resume"])
def test_an_order_has_few_patterns(one: str, do: str) -> None:
    """Each is matched against all robots."""
    order(do=do, robots=[one] * MAX_PATTERNS + ["tank"])
    with pytest.raises(Invalid, match="at most 64 patterns and groups"):
        order(do=do, robots=[one] * (MAX_PATTERNS + 1))


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"do": "dance"},
        {"do": "stop", "robots": []},
        {"do": "stop", "robots": [""]},
        {"do": "stop", "robots": "*"},
        {"do": "stop", "robots": None},
        {"do": "stop", "robots": ["a"] * (MAX_TARGETS + 1)},
        {"do": "stop", "robots": ["a" * 256]},
        {"do": "resume", "robots": ["a"] * (MAX_TARGETS + 1)},
        {"do": "resume", "timeout": 0},
        {"do": "resume", "timeout": 301},
        {"do": "resume", "wy": "typo"},
    ],
)
def test_other_messages_are_malformed(fields: dict[str, Any]) -> None:
    """Unknown fields are malformed too, since they may be typing errors."""
    with pytest.raises(MalformedMessage):
        order(**fields)
