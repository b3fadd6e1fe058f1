"""Hostile messages of Foxglove clients are refused with a reason, or close the client; memory stays bounded."""

from __future__ import annotations

import json
import random
import struct
from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.rights import Level
from relay_server.common import close_codes
from relay_server.common.cpu_quota import DEBT
from tests.worlds.foxglove_client import Foxglove, FoxgloveWorld
from tests.worlds.relay import TEXTS, text, words

MANY = 100_000


@pytest.fixture
def client(world: FoxgloveWorld) -> Foxglove:
    """A client that has read all messages."""
    made = world.client()
    world.settle(made)
    made.take()
    return made


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "empty"),
        (b"\x01", "opcode and channel take 5"),
        (b"\x01\x00\x00", "opcode and channel take 5"),
        (b"\x02\x01\x00\x00\x00", "its head takes 13"),
        (struct.pack("<BIII", 2, 1, 1, 2**32 - 1) + b"cdr", "ends within its encoding"),
        (b"\x03" + bytes(20), "opcode 3 are not taken"),
        (b"\xff", "opcode 255 are not taken"),
    ],
)
def test_a_binary_message_that_can_not_be_read(client: Foxglove, payload: bytes, reason: str) -> None:
    client.sends_binary(payload)
    (status,) = client.statuses()
    assert reason in status
    assert client.closed is None


@pytest.mark.parametrize(
    "message",
    [
        "junk",
        "[]",
        "{}",
        '{"op":"selfDestruct"}',
        '{"op":"subscribe"}',
        '{"op":"subscribe","subscriptions":[{"id":-1,"channelId":1}]}',
        '{"op":"subscribe","subscriptions":[{"id":4294967296,"channelId":1}]}',
        '{"op":"subscribe","subscriptions":[{"id":1,"channelId":"1"}]}',
        '{"op":"subscribe","op":"unsubscribe","subscriptions":[]}',
        '{"op":"advertise","channels":[{"id":1,"topic":1,"encoding":"cdr","schemaName":""}]}',
        json.dumps({"op": "fetchAsset", "uri": "x" * 5000, "requestId": 1}),
        '{"op":"getParameters","parameterNames":' + "[" * 200 + "]" * 200 + "}",
    ],
)
def test_a_text_message_that_can_not_be_read(client: Foxglove, message: str) -> None:
    client.says(message)
    (status,) = client.statuses()
    assert status.startswith("a message was not carried out: ")
    assert client.closed is None


def test_a_client_that_goes_on_is_closed_with_a_reason(client: Foxglove) -> None:
    for _ in range(100):
        client.sends_binary(b"\xff")
    assert client.closed == close_codes.TOO_MANY_ERRORS
    assert any("100 messages in a row could not be read" in each for each in client.statuses())


def test_a_message_that_can_be_read_ends_the_row(client: Foxglove) -> None:
    for _ in range(3):
        for _ in range(99):
            client.sends_binary(b"\xff")
        client.sends("unsubscribe", subscriptionIds=[])
    assert client.closed is None


@pytest.mark.parametrize(
    ("op", "fields"),
    [
        ("subscribe", {"subscriptions": [{"id": n, "channelId": n} for n in range(MANY)]}),
        ("unsubscribe", {"subscriptionIds": list(range(MANY))}),
        ("unadvertise", {"channelIds": list(range(MANY))}),
        ("subscribeParameterUpdates", {"parameterNames": [f"/n.{n}" for n in range(MANY)]}),
        (
            "advertise",
            {
                "channels": [
                    {"id": n, "topic": f"/t{n}", "encoding": "cdr", "schemaName": "std_msgs/String"}
                    for n in range(MANY)
                ]
            },
        ),
    ],
)
def test_lists_of_a_hundred_thousand_have_a_bounded_answer(
    world: FoxgloveWorld, client: Foxglove, op: str, fields: dict[str, Any]
) -> None:
    client.sends(op, **fields)
    answers = client.take()
    assert len(answers) <= 120
    assert len(world.link.all(link.Subscribe)) <= 1024
    client.sends("unsubscribe", subscriptionIds=[1])
    assert client.closed is None


@pytest.mark.parametrize(
    ("op", "field", "entry"),
    [
        ("subscribe", "subscriptions", {"id": 1, "channelId": 0}),
        ("unsubscribe", "subscriptionIds", 1),
        (
            "advertise",
            "channels",
            {"id": 1, "topic": "/t", "encoding": "cdr", "schemaName": "std_msgs/String"},
        ),
        ("unadvertise", "channelIds", 1),
    ],
)
def test_of_a_long_list_the_rest_is_refused_with_a_reason(
    client: Foxglove, op: str, field: str, entry: Any
) -> None:
    client.sends(op, **{field: [entry] * 1025})
    assert (
        f"{op}: of 1025 entries only the first 1024 are carried out; send fewer at a time"
        in client.statuses()
    )


@pytest.mark.parametrize("encoding", ["protobuf", "ros1", "", "x" * 4000])
def test_an_unknown_encoding_is_refused_with_a_reason(client: Foxglove, encoding: str) -> None:
    channel = {"id": 1, "topic": "/chatter", "encoding": encoding, "schemaName": "std_msgs/String"}
    client.sends("advertise", channels=[channel])
    (status,) = client.statuses()
    assert "is none of cdr, json" in status
    assert len(status) < 300


@pytest.mark.parametrize("topic", ["/bad name", "", "/x/", "//", "/1", "/" + "x" * 3000])
def test_a_bad_name_is_refused_with_a_reason(client: Foxglove, topic: str) -> None:
    channel = {"id": 1, "topic": topic, "encoding": "cdr", "schemaName": "std_msgs/String"}
    client.sends("advertise", channels=[channel])
    assert "is no ROS name" in client.statuses()[0]


def test_a_huge_schema_of_a_client_is_not_read(world: FoxgloveWorld, client: Foxglove) -> None:
    channel = {
        "id": 1,
        "topic": "/chatter",
        "encoding": "json",
        "schemaName": "std_msgs/String",
        "schema": "float64 x\n" * 50_000,
    }
    client.sends("advertise", channels=[channel])
    (asked,) = world.link.take(link.Advertise)
    world.channel.message(
        link.Advertised(number=asked.number, topic=asked.topic, type=asked.type, encoding="cdr")
    )
    client.publishes(1, b'{"data":"hi"}')
    assert world.link.samples[-1][2] == text("hi")


@pytest.mark.parametrize(
    ("encoding", "payload"),
    [
        ("cdr", b""),
        ("cdr", b"\x00\x01\x00\x00"),
        ("cdr", b"\x00\x01\x00\x00\xff\xff\xff\xff"),
        ("cdr", b"\x00\x07\x00\x00" + bytes(8)),
        ("json", b""),
        ("json", b"junk"),
        ("json", b"[1]"),
        ("json", b'{"data":"a"},"topic":"/cmd_vel"'),
        ("json", b'{"data":"a","data":"b"}'),
        ("json", b'{"data":' + b"[" * 300 + b"]" * 300 + b"}"),
        ("json", b'{"data":7}'),
        ("json", b'{"other":"a"}'),
    ],
)
def test_a_payload_that_is_no_message_of_the_type_reaches_no_node(
    world: FoxgloveWorld, client: Foxglove, encoding: str, payload: bytes
) -> None:
    channel = {"id": 1, "topic": "/chatter", "encoding": encoding, "schemaName": "std_msgs/String"}
    client.sends("advertise", channels=[channel])
    (asked,) = world.link.take(link.Advertise)
    world.channel.message(
        link.Advertised(number=asked.number, topic=asked.topic, type=asked.type, encoding="cdr")
    )
    client.publishes(1, payload)
    assert not world.link.samples
    assert len(client.statuses()) == 1
    assert client.closed is None


def test_messages_that_wait_for_a_definition_are_bounded(world: FoxgloveWorld, client: Foxglove) -> None:
    channels = [
        {"id": n, "topic": f"/t{n}", "encoding": "cdr", "schemaName": f"odd_msgs/T{n}"} for n in range(20)
    ]
    client.sends("advertise", channels=channels)
    client.take()
    client.publishes(0, bytes(64 * 1024 + 1))
    assert "messages of more than 65536 bytes can't wait" in client.statuses()[0]
    for n in range(20):
        client.publishes(n, bytes(60 * 1024))
    refused = [each for each in client.statuses() if "too many messages wait already" in each]
    assert len(refused) == 12


CHATTER = {"id": 1, "topic": "/chatter", "encoding": "cdr", "schemaName": "std_msgs/String"}


@pytest.mark.parametrize(
    ("allowed", "refused"),
    [
        ([], {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 10**6}]}),
        ([], {"op": "unsubscribe", "subscriptionIds": [7]}),
        ([], {"op": "unadvertise", "channelIds": [7]}),
        ([], {"op": "advertise", "channels": [{**CHATTER, "encoding": "ros1"}]}),
        ([{"op": "advertise", "channels": [CHATTER]}], {"op": "advertise", "channels": [CHATTER]}),
        ([], {"op": "setParameters", "parameters": [{"name": "nothing", "value": 1}]}),
        ([], {"op": "subscribeParameterUpdates", "parameterNames": [f"/n.{n}" for n in range(5000)]}),
        ([], {"op": "fetchAsset", "uri": "file:///etc/passwd", "requestId": 1}),
        ([], {"op": "selfDestruct"}),
        ([], struct.pack("<BI", 1, 1) + bytes(8)),
        ([], struct.pack("<BIII", 2, 10**6, 1, 3) + b"cdr"),
    ],
)
def test_every_refusal_is_counted(
    world: FoxgloveWorld, client: Foxglove, allowed: list[Any], refused: dict[str, Any] | bytes
) -> None:
    session = world.people[0]
    for each in allowed:
        client.says(json.dumps(each))
    client.take()
    assert session.refusals == 0
    left = session.quota.user.requests.left
    if isinstance(refused, bytes):
        client.sends_binary(refused)
    else:
        client.says(json.dumps(refused))
    assert client.take()
    assert session.refusals == 1
    assert session.quota.user.requests.left < left


@pytest.mark.parametrize("known", [False, True])
def test_messages_on_a_channel_that_was_not_advertised_are_refused_while_busy_and_close_the_client(
    world: FoxgloveWorld, client: Foxglove, known: bool
) -> None:
    if known:
        client.sends("advertise", channels=[{**CHATTER, "encoding": "ros1"}])
    requests = world.people[0].quota.user.requests
    requests.spend(requests.left)
    client.take()
    client.publishes(1, b"")
    (status,) = client.statuses()
    assert status.startswith("too much at once: ")
    requests.spend(DEBT)
    client.publishes(1, b"")
    assert client.closed == close_codes.TOO_MANY_ERRORS


def test_messages_on_a_refused_channel_repeat_the_reason(world: FoxgloveWorld) -> None:
    viewer = world.client(Level.VIEWER)
    world.settle(viewer)
    viewer.take()
    viewer.sends("advertise", channels=[CHATTER])
    (reason,) = viewer.statuses()
    viewer.publishes(1, text("hi"))
    assert viewer.statuses() == [f"publish /chatter: your channel 1 was refused: {reason}"]
    viewer.sends("unadvertise", channelIds=[1])
    assert not viewer.statuses()
    viewer.publishes(1, text("hi"))
    assert viewer.statuses() == ["you have no channel 1; advertise it first"]


def test_a_refused_channel_may_be_advertised_again(world: FoxgloveWorld, client: Foxglove) -> None:
    client.sends("advertise", channels=[{**CHATTER, "encoding": "ros1"}])
    client.publishes(1, text("hi"))
    assert len(client.statuses()) == 2
    client.sends("advertise", channels=[CHATTER])
    (asked,) = world.link.take(link.Advertise)
    world.channel.message(
        link.Advertised(number=asked.number, topic=asked.topic, type=asked.type, encoding="cdr")
    )
    client.publishes(1, text("hi"))
    assert world.link.samples[-1][2] == text("hi")
    assert not client.statuses()


def test_the_refused_channels_that_are_remembered_are_bounded(client: Foxglove) -> None:
    for first in range(0, 3000, 1000):
        entries = [{**CHATTER, "id": n, "encoding": "ros1"} for n in range(first, first + 1000)]
        client.sends("advertise", channels=entries)
    client.take()
    client.publishes(2999, b"")
    assert "your channel 2999 was refused: the encoding 'ros1'" in client.statuses()[0]
    client.publishes(0, b"")
    assert client.statuses() == ["you have no channel 0; advertise it first"]


def test_drops_are_shown_alike_on_every_connection(world: FoxgloveWorld, client: Foxglove) -> None:
    queue = world.people[0].port.send_queue
    found = []
    for rate in (40_000.0, 55_000.0):
        queue.set_limits(None, rate)
        queue.count_drop("/chatter")
        world.clock.advance(1)
        found += [each for each in client.statuses() if each.startswith("messages are dropped")]
    assert found == [
        "messages are dropped: this connection is too slow; subscribe to fewer or smaller topics"
    ]


def test_text_that_is_not_utf_8_reaches_nodes_as_utf_8(world: FoxgloveWorld, client: Foxglove) -> None:
    """A node of rclpy would fail on it."""
    channel = {"id": 1, "topic": "/chatter", "encoding": "cdr", "schemaName": "std_msgs/String"}
    client.sends("advertise", channels=[channel])
    (asked,) = world.link.take(link.Advertise)
    world.channel.message(
        link.Advertised(number=asked.number, topic=asked.topic, type=asked.type, encoding="cdr")
    )
    client.publishes(1, b"\x00\x01\x00\x00\x03\x00\x00\x00\xff\xfe\x00")
    assert words(world.link.samples[-1][2]) == "\ufffd\ufffd"


def test_text_from_a_rosbridge_client_is_no_foxglove_and_the_reverse(world: FoxgloveWorld) -> None:
    client = world.client()
    client.take()
    client.sends("call_service", service="/relay/stop")
    assert "was not carried out" in client.statuses()[0]
    assert world.link.take(link.Stop) == []
    rosbridge = Foxglove(world.gate, protocol="rosbridge_v2")
    rosbridge.sends_binary(b"\x01\x00\x00\x00\x00")
    assert rosbridge.closed == close_codes.FORBIDDEN


def test_random_messages_end_in_a_status_or_a_close_code(world: FoxgloveWorld, client: Foxglove) -> None:
    """Valid messages with some bytes changed."""
    chance = random.Random(22)
    texts = [
        b'{"op":"subscribe","subscriptions":[{"id":1,"channelId":1}]}',
        b'{"op":"advertise","channels":[{"id":1,"topic":"/t","encoding":"json","schemaName":"std_msgs/String"}]}',
        b'{"op":"setParameters","parameters":[{"name":"/base.x","value":[1,2.5],"type":"float64_array"}],"id":"s"}',
        b'{"op":"getParameters","parameterNames":["/base.x"],"id":"g"}',
        b'{"op":"fetchAsset","uri":"package://a/b.stl","requestId":3}',
        b'{"op":"subscribeConnectionGraph"}',
    ]
    binaries = [
        struct.pack("<BI", 1, 1) + b'{"data":"hi"}',
        struct.pack("<BIII", 2, 1, 1, 3) + b"cdr" + bytes(5),
    ]
    for number in range(2000):
        binary = number % 2 == 0
        message = bytearray(chance.choice(binaries if binary else texts))
        for _ in range(chance.randrange(4)):
            message[chance.randrange(len(message))] = chance.randrange(256 if binary else 128)
        if client.closed is None:
            client.sends_binary(bytes(message)) if binary else client.says(message.decode())
        else:
            assert client.closed == close_codes.TOO_MANY_ERRORS
            client = Foxglove(world.gate)
    world.clock.advance(0)


def test_a_client_that_reads_nothing_makes_announcements_wait(world: FoxgloveWorld) -> None:
    name = "big_msgs/msg/Big"
    TEXTS[name] = "# " + "x" * 60_000 + "\nstring data\n"
    try:
        topics = {f"/big{n}": link.Topic(types=[name], publishers=["/b"]) for n in range(200)}
        world.registry.graph(world.robot, link.Graph(topics=topics))
        client = world.client(Level.VIEWER)
        client.end.pause()
        world.settle(client)
        session = next(iter(world.people)).port
        for _ in range(20):
            world.clock.advance(0.1)
        assert session.waiting_bytes < 1_000_000
        client.end.resume()
        found: dict[str, Any] = {}
        for _ in range(200):
            world.clock.advance(0.1)
            found |= client.channels()
        assert topics.keys() <= found.keys()
        assert client.closed is None
    finally:
        del TEXTS[name]
