"""Topics from the robot and to it."""

from __future__ import annotations

import contextlib
import json
import struct
import time

from conformance_suite import case, not_offered
from link_relay import ABSENCE, PATIENCE, Link, LinkRelay
from robot_tasks import CDR, sensor, subscribe


@case("subscribe", "SPEC 2.5 subscribe, subscribed")
def test_subscribe(relay: LinkRelay, channel: Link) -> None:
    """subscribed has number, topic, full type and encoding; samples carry the number and the wall clock."""
    topic, type_name = sensor(relay)
    reported = subscribe(channel, relay, number=4_000_000_000)
    assert (reported["topic"], reported["type"]) == (topic, type_name)
    assert reported["encoding"] in relay.hello["encodings"]
    sample = channel.expect_sample(4_000_000_000)
    assert abs(sample.stamp / 1e9 - time.time()) < 86_400
    if reported["encoding"] == "json":
        assert isinstance(json.loads(sample.body), dict)
    else:
        assert sample.body[:2] in (b"\0\0", b"\0\1")


@case("subscribe", "SPEC 2.5 subscribe, type")
def test_subscribe_without_type(relay: LinkRelay, channel: Link) -> None:
    """Without a type the topic's own is used."""
    topic, type_name = sensor(relay)
    channel.say("subscribe", number=1, topic=topic)
    assert channel.expect("subscribed", number=1)["type"] == type_name


@case("subscribe", "SPEC 2.5 failed")
def test_subscribe_unknown(relay: LinkRelay, channel: Link) -> None:
    """A topic that does not exist, without a type, is answered by failed: what, ref, and a reason."""
    channel.say("subscribe", number=3, topic="/no/such/topic_of_any_robot")
    failed = channel.expect("failed")
    assert (failed["request"], failed["reference"]) == ("subscribe", "3")
    assert failed["reason"]
    assert subscribe(channel, relay)


@case("subscribe", "SPEC 2.5 subscribe, throttle_ms")
def test_throttle(relay: LinkRelay, channel: Link) -> None:
    """With throttle_ms samples come no closer than that on average."""
    subscribe(channel, relay, number=1)
    fast = [channel.expect_sample(1).stamp for _ in range(4)]
    if (fast[-1] - fast[0]) / 3 > 150e6:
        not_offered("a topic that comes more often than every 150 ms")
    subscribe(channel, relay, number=2, throttle_ms=300)
    slow = [channel.expect_sample(2).stamp for _ in range(4)]
    # The first may be a latched one.
    assert (slow[-1] - slow[1]) / 2 > 250e6


@case("subscribe", "SPEC 2.5 subscribe, again with a known number")
def test_throttle_changes(relay: LinkRelay, channel: Link) -> None:
    """subscribe again with a known number changes the throttle, here from once an hour to all."""
    subscribe(channel, relay, throttle_ms=3_600_000)
    # The latest one, and the first since.
    time.sleep(ABSENCE)
    early = 0
    with contextlib.suppress(AssertionError):
        while True:
            channel.expect_sample(7, 0.0)
            early += 1
    assert early <= 2
    subscribe(channel, relay, throttle_ms=0)
    for _ in range(3):
        channel.expect_sample(7)


@case("unsubscribe", "SPEC 2.5 unsubscribe")
def test_unsubscribe(relay: LinkRelay, channel: Link) -> None:
    """After unsubscribe no sample of this number comes, and the other number goes on."""
    for number in (1, 2):
        subscribe(channel, relay, number=number)
        channel.expect_sample(number)
    channel.say("unsubscribe", number=1)
    channel.no_sample(1)
    channel.expect_sample(2)


@case("unsubscribe", "SPEC 2.5 unsubscribe")
def test_unsubscribe_unknown(channel: Link) -> None:
    """unsubscribe and unadvertise of unknown numbers have no effect."""
    channel.say("unsubscribe", number=999)
    channel.say("unadvertise", number=999)
    channel.say("ping", t=1)
    channel.expect("pong", t=1)


@case("subscribe", "SPEC 2.1, samples in parts")
def test_large_sample(relay: LinkRelay, channel: Link) -> None:
    """A sample of 1 MB, whole or in parts, comes byte by byte, and pings are answered meanwhile."""
    topics = relay.graph["topics"]
    large = next((name for name in topics if name.endswith("/large")), None)
    if large is None:
        not_offered("no topic …/large with samples of 1 MB")
    channel.say("subscribe", number=1, topic=large, type=topics[large]["types"][0])
    assert channel.expect("subscribed", number=1)["latched"] is True
    channel.say("ping", t=1)
    sample = channel.expect_sample(1)
    assert sample.body[-1_000_000:] == bytes(number % 251 for number in range(1_000_000))
    channel.expect("pong", t=1)


@case("subscribe", "SPEC 2.5, what publishers keep")
def test_kept_samples(relay: LinkRelay, channel: Link) -> None:
    """subscribe with known_stamps repeats latched samples by stamp, without bodies that are listed; then the end."""
    topics = relay.graph["topics"]
    large = next((name for name in topics if name.endswith("/large")), None)
    if large is None:
        not_offered("no topic …/large with samples of 1 MB, kept for late joiners")
    asked = {"number": 1, "topic": large, "type": topics[large]["types"][0]}
    channel.say("subscribe", **asked)
    if not channel.expect("subscribed", number=1).get("replays"):
        not_offered("it does not ask again for what publishers keep (replays)")
    first = channel.expect_sample(1)
    for kept, body in (([first.stamp], b""), ([], first.body)):
        channel.say("subscribe", **asked, known_stamps=kept)
        assert channel.expect_sample(1) == first._replace(body=body)
        assert channel.expect_sample(1) == first._replace(stamp=0, body=b"")


@case("advertise", "SPEC 2.5 failed")
def test_advertise_nonsense(channel: Link) -> None:
    """A type that does not exist is answered by failed: what, ref, and a reason."""
    channel.say("advertise", number=9, topic="/no/such_topic", type="no_such_package/msg/Thing")
    failed = channel.expect("failed")
    assert (failed["request"], failed["reference"]) == ("advertise", "9")
    assert failed["reason"]


@case("advertise", "SPEC 2.5, samples of numbers nobody knows")
def test_sample_unknown(channel: Link) -> None:
    """A sample of a number that was never advertised is ignored."""
    channel.sample(12345, CDR)
    channel.say("ping", t=1)
    channel.expect("pong", t=1)


@case("advertise", "SPEC 2.5 advertise")
def test_publish(relay: LinkRelay, channel: Link) -> None:
    """A message published on …/in of type String is published on …/out, if the robot has such a pair."""
    topics = relay.graph["topics"]
    echo = next((name for name in topics if name.endswith("/in") and f"{name[:-2]}out" in topics), None)
    if echo is None:
        not_offered("no topic …/in with a topic …/out that echoes it")
    channel.say("subscribe", number=1, topic=f"{echo[:-2]}out", type="std_msgs/msg/String")
    channel.expect("subscribed", number=1)
    channel.say("advertise", number=2, topic=echo, type="std_msgs/msg/String")
    reported = channel.expect("advertised", number=2)
    assert not reported.get("motion")
    body = b'{"data": "echo"}' if reported["encoding"] == "json" else CDR + struct.pack("<I", 5) + b"echo\0"
    until = time.monotonic() + PATIENCE
    heard = b""
    while b"echo" not in heard:
        assert time.monotonic() < until, "no echo came"
        # Of any age: only motion has an age limit.
        channel.sample(2, body, age=3600)
        with contextlib.suppress(AssertionError):
            heard = channel.expect_sample(1, 0.2).body
