"""Corner cases that clients of Foxglove's ROS bridge rely on, beside those of the other files here."""

from __future__ import annotations

from typing import Any

from relay_protocol import link
from relay_protocol.rights import Level
from tests.worlds.foxglove_client import Foxglove, FoxgloveWorld
from tests.worlds.relay import STRING, TWIST, text

UNKNOWN = "nowhere_msgs/msg/Unknown"


def subscribes(client: Foxglove, channel: dict[str, Any], id: int = 1) -> None:
    """Subscribe to a channel."""
    client.sends("subscribe", subscriptions=[{"id": id, "channelId": channel["id"]}])


def test_clients_share_one_subscription_of_the_robot(world: FoxgloveWorld) -> None:
    clients = [world.client(Level.VIEWER, f"user{n}") for n in range(5)]
    world.settle(*clients)
    for id, client in enumerate(clients):
        subscribes(client, client.channels()["/chatter"], id)
    (asked,) = [each for each in world.link.all(link.Subscribe) if each.topic == "/chatter"]
    world.subscribed(asked.number)
    world.channel.sample(asked.number, text("all"), 1)
    assert [client.samples()[0].subscription for client in clients] == [0, 1, 2, 3, 4]
    for client in clients[:4]:
        client.sends("unsubscribe", subscriptionIds=list(range(5)))
    assert not world.link.all(link.Unsubscribe)
    clients[4].sends("unsubscribe", subscriptionIds=[4])
    assert world.link.all(link.Unsubscribe)


def test_a_late_client_gets_the_sample_of_each_latched_publisher(world: FoxgloveWorld) -> None:
    first = world.client(Level.VIEWER)
    world.settle(first)
    subscribes(first, first.channels()["/chatter"])
    (asked,) = [each for each in world.link.all(link.Subscribe) if each.topic == "/chatter"]
    world.subscribed(asked.number, latched=True, publishers=2)
    for words in ("base", "laser"):
        world.channel.sample(asked.number, text(words), 1)
    assert [each.body for each in first.samples()] == [text("base"), text("laser")]
    late = world.client(Level.VIEWER, "bob")
    subscribes(late, late.channels()["/chatter"])
    assert [each.body for each in late.samples()] == [text("base"), text("laser")]


def test_a_type_without_a_definition_stops_no_later_channel(world: FoxgloveWorld) -> None:
    world.registry.graph(
        world.robot,
        link.Graph(topics={"/aaa": link.Topic(types=[UNKNOWN], publishers=["/a"])}),
    )
    client = world.client()
    world.robot_joins()
    for asked in [each for each in world.link.all(link.GetType) if each.type == UNKNOWN]:
        world.link.said.remove(asked)
        reason = "package 'nowhere_msgs' is not installed"
        world.channel.message(link.Failed(request="get_type", reference=UNKNOWN, reason=reason))
    world.answer(client)
    messages: list[Any] = client.take()
    topics = {
        each["topic"] for message in messages if message["op"] == "advertise" for each in message["channels"]
    }
    assert {"/chatter", "/cmd_vel"} <= topics
    assert "/aaa" not in topics
    (status,) = [each for each in messages if each["op"] == "status"]
    assert status["id"] == "topic-types"
    assert UNKNOWN in status["message"]


def _cannot_define(world: FoxgloveWorld, type_name: str) -> None:
    """The robot refuses to send the definition of a type, as often as it is requested."""
    for asked in [each for each in world.link.all(link.GetType) if each.type == type_name]:
        world.link.said.remove(asked)
        reason = f"package of '{type_name}' is not installed"
        world.channel.message(link.Failed(request="get_type", reference=type_name, reason=reason))
    world.clock.advance(0)


def test_of_two_types_the_one_that_has_a_definition_is_advertised(world: FoxgloveWorld) -> None:
    topics = {
        "/both": link.Topic(types=[UNKNOWN, TWIST], publishers=["/a", "/b"]),
        "/neither": link.Topic(types=[UNKNOWN, f"{UNKNOWN}Too"], publishers=["/a", "/b"]),
    }
    world.registry.graph(world.robot, link.Graph(full=True, topics=topics))
    client = world.client()
    world.robot_joins()
    assert TWIST not in {each.type for each in world.link.all(link.GetType)}
    for type_name in (UNKNOWN, f"{UNKNOWN}Too"):
        _cannot_define(world, type_name)
    world.answer(client)
    messages: list[Any] = client.take()
    channels = {
        each["topic"]: each["schemaName"]
        for message in messages
        if message["op"] == "advertise"
        for each in message["channels"]
    }
    assert channels["/both"] == TWIST
    assert "/neither" not in channels
    (status,) = [each for each in messages if each["op"] == "status"]
    assert status["id"] == "topic-types"
    assert status["message"].count("is not installed") == 2


def test_a_type_in_place_of_which_another_is_advertised_is_not_named(world: FoxgloveWorld) -> None:
    topics = {"/both": link.Topic(types=[UNKNOWN, TWIST], publishers=["/a", "/b"])}
    world.registry.graph(world.robot, link.Graph(full=True, topics=topics))
    client = world.client()
    world.robot_joins()
    _cannot_define(world, UNKNOWN)
    world.answer(client)
    assert not client.statuses()


def test_a_client_publishes_where_the_robot_does(world: FoxgloveWorld) -> None:
    client = world.client()
    world.settle(client)
    channel = {"id": 3, "topic": "/chatter", "encoding": "json", "schemaName": "std_msgs/msg/String"}
    client.sends("advertise", channels=[channel])
    (asked,) = world.link.take(link.Advertise)
    world.channel.message(link.Advertised(number=asked.number, topic="/chatter", type=STRING, encoding="cdr"))
    client.publishes(3, b' {"data":"me too"} ')
    assert world.link.samples[-1][2] == text("me too")
    client.sends("unadvertise", channelIds=[3])
    assert world.link.take(link.Unadvertise)
    client.publishes(3, b'{"data":"late"}')
    assert len(world.link.samples) == 1


def test_a_first_message_waits_for_the_definition_of_its_type(world: FoxgloveWorld) -> None:
    world.registry.graph(world.robot, link.Graph(topics={"/chatter": None, "/secret": None}))
    client = world.client()
    world.settle(client)
    channel = {"id": 1, "topic": "/new", "encoding": "cdr", "schemaName": "std_msgs/String"}
    client.sends("advertise", channels=[channel])
    (asked,) = world.link.take(link.Advertise)
    world.channel.message(link.Advertised(number=asked.number, topic="/new", type=STRING, encoding="cdr"))
    client.publishes(1, text("first"))
    client.publishes(1, text("second"))
    assert not world.link.samples
    world.answer(client)
    assert [body for _, _, body in world.link.samples] == [text("first"), text("second")]


def test_a_channel_is_withdrawn_when_its_waiting_message_was_published(world: FoxgloveWorld) -> None:
    world.registry.graph(world.robot, link.Graph(topics={"/chatter": None, "/secret": None}))
    client = world.client()
    world.settle(client)
    channel = {"id": 1, "topic": "/new", "encoding": "cdr", "schemaName": "std_msgs/String"}
    client.sends("advertise", channels=[channel])
    client.publishes(1, text("first"))
    client.sends("unadvertise", channelIds=[1])
    # The next channel with this number is another one.
    client.sends("advertise", channels=[{**channel, "topic": "/newer"}])
    assert not world.link.samples
    world.answer(client)
    assert [body for _, _, body in world.link.samples] == [text("first")]
    assert world.channel.publications.advertisers("/new") == []
    assert world.channel.publications.advertisers("/newer") != []
    client.sends("unadvertise", channelIds=[1])
    assert world.channel.publications.advertisers("/newer") == []


def test_hidden_topics_are_not_advertised(world: FoxgloveWorld) -> None:
    hidden = {
        "/_hidden": link.Topic(types=[STRING], publishers=["/a"]),
        "/a/_action/status": link.Topic(types=[STRING]),
    }
    world.registry.graph(world.robot, link.Graph(topics=hidden))
    client = world.client()
    world.settle(client)
    assert not hidden.keys() & client.channels().keys()


def test_a_robot_that_speaks_json_has_channels_of_json() -> None:
    world = FoxgloveWorld()
    world.robot_comes(["json"])
    client = world.client()
    world.settle(client)
    (info,) = [each for each in client.take() if isinstance(each, dict) and each["op"] == "serverInfo"]
    assert info["supportedEncodings"] == ["json"]
    again = world.client(name="bob")
    channel = again.channels()["/chatter"]
    assert (channel["encoding"], channel["schemaEncoding"], channel["schema"]) == (
        "json",
        "jsonschema",
        '{"type":"object","properties":{}}',
    )
    subscribes(again, channel)
    number = next(each.number for each in world.link.take(link.Subscribe) if each.topic == "/chatter")
    world.subscribed(number, encoding="json")
    world.channel.sample(number, b'{"data":"hi"}', 1)
    assert again.samples()[0].body == b'{"data":"hi"}'


def test_the_state_of_control_is_a_channel_of_json(world: FoxgloveWorld) -> None:
    client = world.client()
    subscribes(client, client.channels()["/relay/control"])
    (sample,) = client.samples()
    assert sample.body.startswith(b'{"robot":"rover"')
    assert sample.time_ns > 0


def test_reconnecting_clients_leave_no_state(world: FoxgloveWorld) -> None:
    keeper = world.client(name="keeper")
    world.settle(keeper)
    before = len(world.robot.observers), len(world.channel.members), len(world.people)
    world.gate.person("ann", Level.VIEWER)
    for _ in range(100):
        client = Foxglove(world.gate)
        channel = client.channels()["/chatter"]
        subscribes(client, channel)
        client.sends("getParameters", parameterNames=[], id="x")
        client.sends("subscribeConnectionGraph")
        client.core.send_close(1000)
        client.run()
        world.clock.advance(3)
        keeper.run()
    assert (len(world.robot.observers), len(world.channel.members), len(world.people)) == before
    assert keeper.closed is None
