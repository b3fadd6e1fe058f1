"""Corner cases of the protocol's specification: mistakes of clients, limits, options of the URL."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.rights import Level
from relay_server.control.types import ControlRules
from tests.worlds.foxglove_client import LEGACY, SDK, Foxglove, FoxgloveWorld, twist
from tests.worlds.relay import STRING, TWIST, text
from tests.worlds.relay_node_calls import parameter_services

INFO, WARNING, ERROR = 0, 1, 2


def test_subprotocols_may_come_in_several_headers(world: FoxgloveWorld) -> None:
    world.gate.person("ann", Level.VIEWER)
    client = Foxglove(world.gate, protocol=LEGACY, **{"Sec-WebSocket-Protocol": SDK})
    # The server selects the preferred one, which the client's library did not offer itself.
    assert str(client.core.handshake_exc) == f"unsupported subprotocol: {SDK}"


@pytest.mark.parametrize(
    ("op", "fields", "level", "words"),
    [
        ("subscribe", {"subscriptions": [{"id": 9, "channelId": 999}]}, ERROR, "there is no channel 999"),
        ("subscribe", {"subscriptions": [{"id": 1, "channelId": "other"}]}, ERROR, "id 1 is in use"),
        ("subscribe", {"subscriptions": [{"id": 2, "channelId": "same"}]}, WARNING, "subscribed already"),
        ("unsubscribe", {"subscriptionIds": [9]}, WARNING, "there is no subscription 9"),
        ("unadvertise", {"channelIds": [9]}, WARNING, "you have no channel 9"),
        (
            "advertise",
            {"channels": [{"id": 1, "topic": "/b", "encoding": "json", "schemaName": "std_msgs/String"}]},
            WARNING,
            "your channel 1 is advertised already",
        ),
        ("setParameters", {"parameters": [{"name": "nothing", "value": 1}]}, ERROR, "is no parameter"),
        ("playback", {}, ERROR, "a message was not carried out"),
    ],
)
def test_a_mistake_is_shown_and_changes_nothing(
    world: FoxgloveWorld, op: str, fields: dict[str, Any], level: int, words: str
) -> None:
    client = world.client()
    world.settle(client)
    channels = client.channels()
    numbers = {"same": channels["/chatter"]["id"], "other": channels["/cmd_vel"]["id"]}
    client.sends("subscribe", subscriptions=[{"id": 1, "channelId": numbers["same"]}])
    channel = {"id": 1, "topic": "/a", "encoding": "json", "schemaName": "std_msgs/String"}
    client.sends("advertise", channels=[channel])
    client.take()
    world.link.said.clear()
    for each in fields.get("subscriptions", ()):
        fields = {"subscriptions": [each | {"channelId": numbers.get(each["channelId"], each["channelId"])}]}
    client.sends(op, **fields)
    (status,) = client.took("status")
    assert status["level"] == level
    assert words in status["message"]
    assert status["id"]
    assert not world.link.said


def test_no_message_announces_more_than_a_hundred_channels(world: FoxgloveWorld) -> None:
    topics = {f"/t{number}": link.Topic(types=[STRING], publishers=["/n"]) for number in range(250)}
    world.registry.graph(world.robot, link.Graph(topics=topics))
    client = world.client(Level.VIEWER)
    world.settle(client)
    sizes = [len(each["channels"]) for each in client.took("advertise")]
    assert sum(sizes) >= 250
    assert max(sizes) == 100


def test_assets_under_way_are_limited(world: FoxgloveWorld) -> None:
    client = world.client()
    world.settle(client)
    client.take()
    for number in range(1025):
        client.sends("fetchAsset", uri=f"package://rover/{number}.stl", requestId=number)
    (refusal,) = client.take()
    assert isinstance(refusal, bytes)
    assert refusal[:6] == struct.pack("<BIB", 4, 1024, 1)
    assert b"1024 assets" in refusal
    # The robot is asked for a few at a time.
    assert len(world.link.take(link.GetAsset)) == 4


def test_requests_for_parameters_under_way_are_limited() -> None:
    world = FoxgloveWorld()
    world.robot_comes(["json"], link.Graph(full=True, services=parameter_services("/silent")))
    client = world.client()
    world.robot_joins()
    client.take()
    for number in range(33):
        client.sends("getParameters", parameterNames=["/silent.x"], id=str(number))
    (status,) = client.took("status")
    assert (status["level"], status["id"]) == (ERROR, "parameters")
    assert "32 requests" in status["message"]
    for _ in range(6):
        world.clock.advance(1)
        client.run()
    assert len(client.took("parameterValues")) == 32


def test_the_throttle_of_the_url_holds_for_each_topic(world: FoxgloveWorld) -> None:
    world.gate.person("ann", Level.VIEWER)
    client = Foxglove(world.gate, path="/robots/rover?throttle=200")
    world.settle(client)
    channel = client.channels()["/chatter"]["id"]
    client.sends("subscribe", subscriptions=[{"id": 1, "channelId": channel}])
    number = world.link.take(link.Subscribe)[-1].number
    world.subscribed(number)
    for stamp in range(10):
        world.channel.sample(number, text(str(stamp)), stamp + 1)
    assert [each.body for each in client.samples()] == [text("0")]
    world.clock.advance(0.2)
    assert [each.body for each in client.samples()] == [text("9")]


def test_a_wrong_option_of_the_url_refuses_the_connection_with_a_reason(world: FoxgloveWorld) -> None:
    world.gate.person("ann", Level.VIEWER)
    client = Foxglove(world.gate, path="/robots/rover?stride=2&voxel=1")
    assert client.status == 400


def test_with_explicit_control_a_service_call_comes_before_commands() -> None:
    world = FoxgloveWorld()
    world.controllers._rules = ControlRules(explicit=True)
    world.robot_comes()
    client = world.client()
    world.settle(client)
    services = {
        each["name"]: each["id"] for op in client.took("advertiseServices") for each in op["services"]
    }
    channel = {"id": 1, "topic": "/cmd_vel", "encoding": "cdr", "schemaName": "geometry_msgs/Twist"}
    client.sends("advertise", channels=[channel])
    (asked,) = world.link.take(link.Advertise)
    world.channel.message(
        link.Advertised(number=asked.number, topic="/cmd_vel", type=TWIST, encoding="cdr", motion=True)
    )
    client.publishes(1, twist(0.2))
    world.clock.advance(0)
    assert not world.link.commands
    assert any("take_control" in each for each in client.statuses())
    call = struct.pack("<BIII", 2, services["/relay/take_control"], 1, 4) + b"json{}"
    client.sends_binary(call)
    world.clock.advance(0)
    client.publishes(1, twist(0.2))
    assert [each[3] for each in world.link.commands] == [twist(0.2)]
