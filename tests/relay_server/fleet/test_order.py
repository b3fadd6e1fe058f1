"""What may be ordered."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, MalformedMessage
from relay_server.fleet.order import Order


def order(**fields: Any) -> Order:
    """An order as it comes, checked."""
    body = json.dumps({"robots": ["*"], **fields}).encode()
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
    ],
)
def test_what_can_be_ordered(fields: dict[str, Any], subject: str) -> None:
    """With what it is about."""
    assert order(**fields).subject == subject


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"do": "call"}, "'call' needs 'service'"),
        ({"do": "publish", "msg": {}}, "'publish' needs 'topic'"),
        ({"do": "set", "name": "/a:b"}, "'set' needs 'value'"),
        ({"do": "set", "value": 1}, "'set' needs 'name'"),
        ({"do": "stop", "service": "/start"}, "'service' does not go with 'stop'"),
        ({"do": "call", "service": "/start", "msg": {"a": 1}}, "'msg' does not go with 'call'"),
        ({"do": "publish", "topic": "/a", "value": 0}, "'value' does not go with 'publish'"),
        ({"do": "resume", "why": "x" * 501}, "'why' must be a string of 500 characters at most"),
        ({"do": "call", "service": "/start", "why": None}, "'why' must be a string"),
        ({"do": "publish", "topic": "/a", "why": "x"}, "'why' does not go with 'publish'"),
    ],
)
def test_what_makes_no_sense_is_told(fields: dict[str, Any], words: str) -> None:
    """Rather than passed over."""
    with pytest.raises(Invalid, match=words):
        order(**fields)


@pytest.mark.parametrize(
    ("why", "kept"), [("fire", "fire"), (None, ""), (7, ""), ({"a": [1]}, ""), ("x" * 501, "x" * 500)]
)
def test_no_stop_is_refused_for_its_reason(why: Any, kept: str) -> None:
    """What can't be used of it is left out."""
    assert order(do="stop", why=why).why == kept


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"do": "dance"},
        {"do": "stop", "robots": []},
        {"do": "stop", "robots": [""]},
        {"do": "stop", "robots": "*"},
        {"do": "stop", "robots": ["a"] * 65},
        {"do": "stop", "robots": ["a" * 256]},
        {"do": "stop", "timeout": 0},
        {"do": "stop", "timeout": 301},
        {"do": "stop", "wy": "typo"},
    ],
)
def test_what_is_no_order_is_malformed(fields: dict[str, Any]) -> None:
    """Unknown fields too: they could be a typing error in something that matters."""
    with pytest.raises(MalformedMessage):
        order(**fields)
