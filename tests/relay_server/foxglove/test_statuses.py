"""Control and statuses of Foxglove clients, by websocket bytes."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from relay_protocol import link
from relay_protocol.rights import Level
from tests.worlds.foxglove_client import Foxglove, FoxgloveWorld, twist
from tests.worlds.relay import STRING, TEXTS, TWIST


def _drives(world: FoxgloveWorld, client: Foxglove) -> Callable[[float], None]:
    client.sends(
        "advertise",
        channels=[{"id": 1, "topic": "/cmd_vel", "encoding": "cdr", "schemaName": "geometry_msgs/Twist"}],
    )
    for asked in world.link.take(link.Advertise):
        world.channel.message(
            link.Advertised(number=asked.number, topic=asked.topic, type=TWIST, encoding="cdr", motion=True)
        )
    return lambda speed: client.publishes(1, twist(speed))


def test_only_the_holder_drives_and_others_read_its_name(world: FoxgloveWorld) -> None:
    ann, bob = world.client(), world.client(name="bob")
    world.settle(ann, bob)
    _drives(world, ann)(0.5)
    world.clock.advance(0)
    assert world.link.commands
    world.link.commands.clear()
    bob_drives = _drives(world, bob)
    bob.take()
    for _ in range(50):
        bob_drives(0.5)
    assert not world.link.commands
    refusals = [each for each in bob.statuses() if "ann" in each]
    assert len(refusals) == 1
    world.clock.advance(1)
    assert "the robot is controlled by ann" in bob.statuses()


def test_events_are_taken_back_after_a_while_and_states_stay(world: FoxgloveWorld) -> None:
    ann = world.client(deny=("publish:/secret",))
    world.settle(ann)
    ann.take()
    world.people[0].notify("warning", "you have lost control of rover: test")
    world.people[0].notify("error", "publish /x: no", "publish:/x")
    world.people[0].notify("warning", "subscribe /x: its publishers do not match", "subscribe:/x")
    ann.sends("unsubscribe", subscriptionIds=[9])
    ann.sends("unadvertise", channelIds=[9])
    ann.sends("advertise", channels=[{"id": 1, "topic": "/secret", "encoding": "cdr", "schemaName": STRING}])
    ann.sends("nonsense")
    ids = ["news", "publish:/x", "subscribe:/x", "subscribe", "advertise", "channel:1", "message"]
    assert [each["id"] for each in ann.took("status")] == ids
    for _ in range(11):
        world.clock.advance(1)
        ann.run()
    removed = {id for each in ann.took("removeStatus") for id in each["statusIds"]}
    assert removed == set(ids) - {"subscribe:/x"}


def test_a_refusal_stays_while_it_is_repeated_and_is_sent_once(world: FoxgloveWorld) -> None:
    ann = world.client()
    world.settle(ann)
    ann.take()
    for _ in range(15):
        world.people[0].notify("error", "publish /x: no", "publish:/x")
        world.clock.advance(1)
        ann.run()
    taken = [each["op"] for each in ann.take() if isinstance(each, dict)]
    assert (taken.count("status"), taken.count("removeStatus")) == (1, 0)


def test_a_stale_command_is_dropped_with_a_status(world: FoxgloveWorld) -> None:
    client = world.client()
    world.settle(client)
    drive = _drives(world, client)
    client.take()
    for _ in range(3):
        world.clock.rightNow += 2.0
        drive(0.5)
    assert not world.link.commands
    stale = [each for each in client.statuses() if "too old" in each]
    assert len(stale) == 1
    assert "was dropped: it may be too old, by the last ping answered" in stale[0]


CLOUD = "sensor_msgs/msg/PointCloud2"


def test_a_client_whose_clouds_are_not_thinned_is_told_for_as_long_as_that_lasts(
    world: FoxgloveWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot sends what the most demanding client needs."""
    monkeypatch.setitem(TEXTS, CLOUD, "uint8[] data")
    topic = link.Topic(types=[CLOUD], publishers=["/lidar"])
    world.registry.graph(world.robot, link.Graph(topics={"/points": topic}))
    world.gate.person("ann", Level.VIEWER)
    world.gate.person("bob", Level.VIEWER)
    ann = Foxglove(world.gate, "ann", path="/robots/rover?stride=4")
    bob = Foxglove(world.gate, "bob")
    world.settle(ann, bob)
    for client in (ann, bob):
        channel = client.channels()["/points"]["id"]
        client.sends("subscribe", subscriptions=[{"id": 1, "channelId": channel}])
        for asked in world.link.take(link.Subscribe):
            world.subscribed(asked.number, CLOUD)
        world.clock.advance(1)
        assert client is bob or not any("thinned" in each for each in ann.statuses())
    (status,) = (each for each in ann.took("status") if each["id"] == "thinning")
    assert status["message"] == "/points: not thinned as asked, since other clients need more points"
    assert not any("thinned" in each for each in bob.statuses())
    bob.sends("unsubscribe", subscriptionIds=[1])
    world.clock.advance(1)
    assert any("thinning" in each["statusIds"] for each in ann.took("removeStatus"))
