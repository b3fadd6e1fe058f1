"""Quality of service in clients' messages."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest

from relay_protocol import link, rosbridge
from relay_protocol.errors import MalformedMessage

INFINITE = {"sec": 9223372036, "nanosec": 854775807}


def asked(**qos: Any) -> dict[str, Any]:
    """The QoS sent to the robot for a client's."""
    text = json.dumps({"op": "subscribe", "topic": "/a", "qos": qos})
    message = rosbridge.decode(text.encode())
    assert isinstance(message, rosbridge.Subscribe)
    sent = msgspec.json.encode(message.qos)
    msgspec.json.decode(sent, type=link.QoS)
    return dict(json.loads(sent))


@pytest.mark.parametrize(
    ("qos", "wanted"),
    [
        ({"reliability": "RELIABLE", "durability": "Transient_Local", "history": "KEEP_LAST"},
         {"reliability": "reliable", "durability": "transient_local", "history": "keep_last"}),
        ({"reliability": "BEST_AVAILABLE", "durability": "system_default", "history": "SYSTEM_DEFAULT"},
         {"reliability": "best_available"}),
        ({"depth": 5}, {"depth": 5}),
        ({"depth": 5.0}, {"depth": 5}),
        ({"depth": 0, "history": None}, {}),
        ({"deadline": 1, "lifespan": 0.5}, {"deadline": 1, "lifespan": 0.5}),
        ({"deadline": 0, "lifespan": 0.0}, {}),
        ({"deadline": {"secs": 1, "nsecs": 500000000}, "lifespan": {"sec": 2, "nanosec": 0}},
         {"deadline": 1.5, "lifespan": 2}),
        ({"deadline": {"sec": 3}, "lifespan": {"nsecs": 250000000}}, {"deadline": 3, "lifespan": 0.25}),
        ({"deadline": "infinite", "lifespan": "Infinite"}, {}),
        ({"deadline": INFINITE, "lifespan": 1e12}, {}),
        ({"deadline": "best_available"}, {}),
        ({}, {}),
    ],
)  # fmt: skip
def test_all_that_clients_write_becomes_one_form(qos: dict[str, Any], wanted: dict[str, Any]) -> None:
    """Equivalent values become equal, and default values are left out."""
    assert asked(**qos) == wanted


@pytest.mark.parametrize(
    ("qos", "reason"),
    [
        ({"reliability": "sometimes"},
         "reliability must be reliable, best_effort, best_available or system_default, not 'sometimes'"),
        ({"durability": 1}, "durability must be volatile, transient_local, best_available or system_default, not 1"),
        ({"history": ["keep_last"]}, "history must be keep_last, keep_all or system_default, not a value of type list"),
        ({"depth": 2.5}, "depth must be a whole number of messages, 0 for the default, not 2.5"),
        ({"depth": -1}, "not -1"),
        ({"depth": True}, "not a value of type bool"),
        ({"depth": "5"}, "not '5'"),
        ({"depth": 10**30}, "depth must be a whole number"),
        ({"deadline": -1}, "deadline must be a time in seconds, an object with sec and nanosec, or 'infinite' or"),
        ({"lifespan": "best_available"}, "or 'infinite', not 'best_available'"),
        ({"lifespan": {}}, "lifespan must be a time"),
        ({"lifespan": {"sec": "1"}}, "lifespan must be a time"),
        ({"lifespan": {"sec": 1, "nanosec": -1}}, "lifespan must be a time"),
        ({"lifespan": [1, 2]}, "not a value of type list"),
        ({"lifespan": 10**400}, "lifespan must be a time"),
        ({"deadline": False}, "deadline must be a time"),
    ],
)  # fmt: skip
def test_unknown_name_is_reported_with_the_known_ones(qos: dict[str, Any], reason: str) -> None:
    """The error has the policy, its valid values, and the given one."""
    with pytest.raises(MalformedMessage, match=reason):
        asked(**qos)
