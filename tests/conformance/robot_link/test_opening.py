"""Enrolment, opening, pings, and the robot's description on its control link."""

from __future__ import annotations

import base64
import hashlib
import json
import time

from conformance_suite import case, not_offered
from link_relay import PATIENCE, Link, LinkRelay, message
from robot_tasks import subscribe

STRANGE = {"later": True, "fields": [1, {"more": None}]}


@case("enroll", "SPEC 2.2 enroll")
def test_enroll(relay: LinkRelay) -> None:
    """enroll has version 1, the robot's name, the code, and a public key of 32 bytes."""
    asked = relay.enrolment
    assert asked["version"] == 1
    assert (asked["robot"], len(base64.b64decode(asked["public_key"], validate=True))) == (relay.robot, 32)
    assert "private" not in json.dumps(asked)


@case("hello", "SPEC 2.2 hello")
def test_hello(relay: LinkRelay) -> None:
    """hello has version 1, the robot's name, the key's fingerprint and encodings, cdr or json."""
    hello = relay.control and relay.hello
    assert (hello["version"], hello["robot"]) == (1, relay.robot)
    assert hello["key"] == hashlib.sha256(relay.public_key).hexdigest()[:16]
    assert set(hello["encodings"]) & {"cdr", "json"}


@case("prove", "SPEC 2.2 prove; RFC 8032")
def test_prove(relay: LinkRelay) -> None:
    """The signature fits context, relay, robot and nonce; otherwise no case would have come so far."""
    assert not relay.control.ended


@case("ping", "SPEC 2.3 ping")
def test_ping(relay: LinkRelay) -> None:
    """A ping on the control link is answered with its t and the robot's clock, which goes on."""
    times = []
    for t in (1, 2**62):
        relay.control.say("ping", t=t)
        times.append(relay.control.expect("pong", t=t)["at"])
    assert times[1] > times[0]


@case("ping", "SPEC 2.3 ping")
def test_ping_on_channel(channel: Link) -> None:
    """A ping on the channel link is answered."""
    channel.say("ping", t=5)
    assert isinstance(channel.expect("pong", t=5)["at"], int)


@case("ping", "SPEC 2.3, each end pings")
def test_robot_pings(relay: LinkRelay, channel: Link) -> None:
    """The robot pings on both links."""
    until = time.monotonic() + PATIENCE
    while not (relay.control.pings and channel.pings):
        assert time.monotonic() < until, f"{relay.control.pings} and {channel.pings} pings in {PATIENCE:g} s"
        time.sleep(0.01)


@case("frames", "SPEC 2.1 Frames")
def test_frames_in_pieces(relay: LinkRelay) -> None:
    """A frame that comes byte by byte is understood, and so are two in one piece."""
    for byte in message("ping", t=11):
        relay.control.raw(bytes([byte]))
    relay.control.raw(message("ping", t=12) + message("ping", t=13))
    for t in (11, 12, 13):
        relay.control.expect("pong", t=t)


@case("frames", "SPEC 2.2, unknown fields")
def test_unknown_fields(relay: LinkRelay, channel: Link) -> None:
    """Unknown fields are ignored, on both links."""
    relay.control.say("ping", t=21, **STRANGE)
    relay.control.expect("pong", t=21)
    assert subscribe(channel, relay, **STRANGE)


@case("describe", "SPEC 2.4 describe")
def test_describe(relay: LinkRelay) -> None:
    """describe comes after welcome, its fields of the types SPEC says."""
    assert relay.control
    facts = relay.facts()
    texts = [facts.get(name, "") for name in ("host", "platform", "distro", "os", "agent")]
    assert all(isinstance(each, str) and len(each) <= 255 for each in texts)
    motion = facts.get("motion", {})
    assert all(isinstance(each, str) for each in motion.get("types", []) + motion.get("topics", []))
    assert all(0 < motion.get(name, 500) <= 60_000 for name in ("deadline_ms", "stop_within_ms"))


@case("graph", "SPEC 2.4 graph")
def test_graph(relay: LinkRelay) -> None:
    """graph comes after welcome, the first one full; names begin with a slash, types are full."""
    assert relay.control
    relay.facts()
    assert relay.first_graph is not None
    assert relay.first_graph.get("full") is True
    for kind in ("topics", "services", "actions"):
        for name, each in relay.graph[kind].items():
            assert name.startswith("/"), name
            assert all(len(type_name.split("/")) == 3 for type_name in each["types"]), each


@case("open_channel", "SPEC 2.2 join, 2.4 open_channel")
def test_two_channels(relay: LinkRelay) -> None:
    """Two channels at once are joined by two tickets, and serve side by side."""
    with relay.channel() as one, relay.channel() as two:
        assert subscribe(two, relay)
        two.expect_sample(7)
        if one.ended:
            not_offered("more than one channel at a time")
        assert subscribe(one, relay)
        one.expect_sample(7)
        two.expect_sample(7)


@case("open_channel", "SPEC 2.4 open_channel")
def test_next_channel(relay: LinkRelay) -> None:
    """A channel that is opened before the last one is closed is served, for any end of the last one."""
    control = relay.control
    with relay.channel() as last:
        assert subscribe(last, relay)
        with relay.channel() as following:
            assert subscribe(following, relay)
            following.expect_sample(7)
    assert relay.control is control
