"""Problems that users have reported of Foxglove's bridges and of Lichtblick, tried on the relay.

Sources: issues and pull requests of ``foxglove/ros-foxglove-bridge`` (by number), ``foxglove-sdk`` and ``lichtblick``.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import msgspec
import pytest

from relay_protocol import link
from relay_protocol.rights import Level
from relay_server.common.send_queue import DATA_PER_TOPIC
from tests.worlds.foxglove_client import Foxglove, FoxgloveWorld, twist
from tests.worlds.relay import MOTION, STRING, TEXTS, TRIGGER, TWIST, text
from tests.worlds.relay_node_calls import answers, parameter_services
from tests.worlds.robot_channel_link import RobotLink

TRIGGER_REQUEST = b"\x00\x01\x00\x00\x00"


def subscribed(world: FoxgloveWorld, client: Foxglove, topic: str = "/chatter", **more: Any) -> int:
    """Subscribes with id 1; returns the robot's subscription number."""
    channel = client.channels()[topic]
    client.sends("subscribe", subscriptions=[{"id": 1, "channelId": channel["id"]}])
    number = world.link.take(link.Subscribe)[-1].number
    world.subscribed(number, channel["schemaName"], **more)
    return number


def advertised(world: FoxgloveWorld, client: Foxglove, number: int, topic: str, type_name: str) -> None:
    """Advertise a channel, which the robot confirms."""
    entry = {"id": number, "topic": topic, "encoding": "cdr", "schemaName": type_name}
    client.sends("advertise", channels=[entry])
    for asked in world.link.take(link.Advertise):
        confirmed = link.Advertised(
            number=asked.number,
            topic=asked.topic,
            type=asked.type,
            encoding="cdr",
            motion=asked.type == TWIST,
        )
        world.channel.message(confirmed)


# --- subscriptions ------------------------------------------------------------------------------------------


def test_a_client_gets_messages_after_another_was_lost_without_a_word(world: FoxgloveWorld) -> None:
    """84, 92, foxglove-sdk 823."""
    first = world.client(Level.VIEWER)
    world.settle(first)
    subscribed(world, first)
    first.transport.abortConnection()
    assert len(world.link.take(link.Unsubscribe)) == 1
    second = world.client(Level.VIEWER, "bob")
    number = subscribed(world, second)
    world.channel.sample(number, text("hi"), 1)
    assert [each.body for each in second.samples()] == [text("hi")]


def test_a_client_that_subscribes_again_at_once_gets_the_latched_message_again(world: FoxgloveWorld) -> None:
    """287: switching from one 3D panel to another."""
    client = world.client(Level.VIEWER)
    world.settle(client)
    channel = client.channels()["/chatter"]["id"]
    for id in (1, 2, 3):
        client.sends("subscribe", subscriptions=[{"id": id, "channelId": channel}])
        number = world.link.take(link.Subscribe)[-1].number
        world.subscribed(number, latched=True)
        world.channel.sample(number, text("map"), 1)
        assert [(each.subscription, each.body) for each in client.samples()] == [(id, text("map"))]
        client.sends("unsubscribe", subscriptionIds=[id])


def test_of_two_types_on_a_topic_one_is_advertised_while_it_is_there(world: FoxgloveWorld) -> None:
    """Lichtblick: "Multiple channels advertise the same topic"."""
    client = world.client(Level.VIEWER)
    world.settle(client)
    first = client.channels()["/chatter"]
    for types in ([STRING, TWIST], [TWIST, STRING]):
        topic = link.Topic(types=types, publishers=["/talker"])
        world.registry.graph(world.robot, link.Graph(topics={"/chatter": topic}))
        assert not client.took("unadvertise")
    topic = link.Topic(types=[TWIST], publishers=["/talker"])
    world.registry.graph(world.robot, link.Graph(topics={"/chatter": topic}))
    messages: list[Any] = [each for each in client.take() if each["op"] in ("advertise", "unadvertise")]
    assert messages[0] == {"op": "unadvertise", "channelIds": [first["id"]]}
    assert [each["schemaName"] for each in messages[1]["channels"]] == [TWIST]


def test_an_app_that_unsubscribes_a_withdrawn_channel_sees_no_problem(world: FoxgloveWorld) -> None:
    """Lichtblick does so, and shows each status until it connects again."""
    client = world.client(Level.VIEWER)
    world.settle(client)
    subscribed(world, client)
    world.registry.graph(world.robot, link.Graph(topics={"/chatter": None}))
    assert client.took("unadvertise")
    client.sends("unsubscribe", subscriptionIds=[1])
    assert not client.statuses()
    client.sends("unsubscribe", subscriptionIds=[1])
    assert client.statuses() == ["there is no subscription 1"]


def test_a_type_without_fields_has_a_definition_that_apps_take(
    world: FoxgloveWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lichtblick: "Schema for my_msgs/msg/Nothing is empty"."""
    monkeypatch.setitem(TEXTS, "my_msgs/msg/Nothing", "")
    topic = link.Topic(types=["my_msgs/msg/Nothing"], publishers=["/n"])
    world.registry.graph(world.robot, link.Graph(topics={"/nothing": topic}))
    client = world.client(Level.VIEWER)
    world.settle(client)
    assert client.channels()["/nothing"]["schema"]


def test_large_messages_do_not_keep_small_ones_from_a_slow_client(world: FoxgloveWorld) -> None:
    """174, 196."""
    image = link.Topic(types=[STRING], publishers=["/camera"])
    world.registry.graph(world.robot, link.Graph(topics={"/image": image}))
    client = world.client(Level.VIEWER)
    world.settle(client)
    channels = client.channels()
    numbers = {}
    for id, topic in enumerate(("/image", "/chatter")):
        client.sends("subscribe", subscriptions=[{"id": id, "channelId": channels[topic]["id"]}])
        numbers[topic] = world.link.take(link.Subscribe)[-1].number
        world.subscribed(numbers[topic])
    world.people[0].port.send_queue.pause()
    for stamp in range(20):
        world.channel.sample(numbers["/image"], text("x" * 1_000_000), stamp + 1)
        world.channel.sample(numbers["/chatter"], text(f"scan {stamp}"), stamp + 1)
    assert world.people[0].port.waiting_bytes < 3_000_000
    world.people[0].port.send_queue.resume()
    found = client.samples()
    assert [each.time_ns for each in found if each.subscription == 0] == [20]
    assert [each.body for each in found if each.subscription == 1][-1] == text("scan 19")
    world.clock.advance(1)
    assert any(each.startswith("messages are dropped") for each in client.statuses())


def seconds_pass(world: FoxgloveWorld, seconds: int, *clients: Foxglove) -> None:
    """Time passes, while the clients answer pings."""
    for _ in range(seconds):
        world.clock.advance(1)
        for each in clients:
            each.run()


def test_messages_that_the_robots_link_does_not_carry_are_shown_to_those_who_subscribed_before(
    world: FoxgloveWorld,
) -> None:
    early, late = world.client(Level.VIEWER), world.client(Level.VIEWER, "bob")
    world.settle(early, late)
    number = subscribed(world, early)
    seconds_pass(world, 1, early, late)
    world.channel.message(link.SamplesDropped(number=number, count=1, reason="too_large"))
    seconds_pass(world, 1, early, late)
    assert "uplink-drops" not in [each["id"] for each in early.took("status")]
    world.channel.message(link.SamplesDropped(number=number, count=1, reason="slow_link"))
    late.sends("subscribe", subscriptions=[{"id": 1, "channelId": late.channels()["/chatter"]["id"]}])
    seconds_pass(world, 1, early, late)
    (status,) = early.took("status")
    assert status["id"] == "uplink-drops"
    assert "the robot's link is too thin" in status["message"]
    assert not late.took("status")


def test_messages_that_do_not_reach_the_robot_are_shown_to_their_publisher(world: FoxgloveWorld) -> None:
    client, other = world.client(), world.client(name="bob")
    robot = RobotLink(world).joins()
    for each in (client, other):
        each.run()
        each.sends(
            "advertise", channels=[{"id": 1, "topic": "/out", "encoding": "cdr", "schemaName": STRING}]
        )
    robot.advertised("/out")
    robot.stalls()
    seconds_pass(world, 1, client, other)
    client.take()
    other.take()
    for _ in range(DATA_PER_TOPIC + 1):
        client.publishes(1, text("x"))
    seconds_pass(world, 1, client, other)
    (status,) = client.took("status")
    assert status["id"] == "publish-drops"
    assert "the robot's link is too slow" in status["message"]
    assert not other.took("status")


def test_a_status_about_drops_stays_from_one_drop_to_the_next(world: FoxgloveWorld) -> None:
    client = world.client(Level.VIEWER)
    world.settle(client)
    client.take()
    for _ in range(5):
        world.people[0].port.send_queue.dropped += 1
        seconds_pass(world, 2, client)
    ids = [each["id"] for each in client.took("status")]
    seconds_pass(world, 6, client)
    assert (ids, client.took("removeStatus")) == (["drops"], [])
    seconds_pass(world, 5, client)
    assert [each["statusIds"] for each in client.took("removeStatus")] == [["drops"]]


@pytest.mark.parametrize("size", [0, 1, 5_000_000])
def test_messages_of_any_size_arrive_whole(world: FoxgloveWorld, size: int) -> None:
    client = world.client(Level.VIEWER)
    world.settle(client)
    number = subscribed(world, client)
    world.channel.sample(number, text("x" * size), 1)
    assert [each.body for each in client.samples()] == [text("x" * size)]


# --- parameters ---------------------------------------------------------------------------------------------


def test_a_node_that_does_not_answer_is_left_out_for_a_while() -> None:
    """337, 345: Lichtblick requests all parameters every 15 s."""
    world = FoxgloveWorld()
    services = parameter_services("/silent") | parameter_services("/base")
    world.robot_comes(["json"], link.Graph(full=True, services=services))
    client = world.client()
    world.robot_joins()
    called: list[bool] = []
    for number in range(8):
        client.sends("getParameters", parameterNames=[], id="get-all-params")
        if not number:
            answers(world, "/base/list_parameters", {"result": {"names": ["x"], "prefixes": []}})
            answers(world, "/base/get_parameters", {"values": [{"type": 2, "integer_value": 7}]})
        called.append(any(each.service.startswith("/silent/") for each in world.link.take(link.CallService)))
        for _ in range(7):
            world.clock.advance(1)
            client.run()
        (answer,) = client.took("parameterValues")
        assert answer["parameters"] == [{"name": "/base.x", "value": 7}]
    assert called == [True, True, False, True, False, False, False, True]
    client.sends("getParameters", parameterNames=["/silent.y"], id="one")
    answers(world, "/silent/get_parameters", {"values": [{"type": 2, "integer_value": 8}]})
    assert client.took("parameterValues")[0]["parameters"] == [{"name": "/silent.y", "value": 8}]
    client.sends("getParameters", parameterNames=[], id="get-all-params")
    assert any(each.service == "/silent/list_parameters" for each in world.link.take(link.CallService))


# --- services -----------------------------------------------------------------------------------------------


def called(world: FoxgloveWorld, client: Foxglove, call: int) -> link.CallService:
    """Call ``/reset``; the robot's request."""
    service = next(
        each["id"]
        for message in client.took("advertiseServices")
        for each in message["services"]
        if each["name"] == "/reset"
    )
    client.sends_binary(struct.pack("<BIII", 2, service, call, 3) + b"cdr" + TRIGGER_REQUEST)
    return world.link.take(link.CallService)[-1]


def test_a_service_that_does_not_answer_fails_the_call_once(world: FoxgloveWorld) -> None:
    """298: a client waited forever."""
    client = world.client()
    world.settle(client)
    call = called(world, client, 9)
    client.take()
    for _ in range(31):
        world.clock.advance(1)
        client.run()
    (failure,) = client.took("serviceCallFailure")
    assert failure["callId"] == 9
    values = world.cdr(f"{TRIGGER}_Response", success=True, message="late")
    world.channel.message(link.ServiceResponse(id=call.id, result=True, cdr=values))
    assert not [each for each in client.take() if isinstance(each, bytes)]


def test_a_robot_that_is_lost_fails_the_call(world: FoxgloveWorld) -> None:
    client = world.client()
    world.settle(client)
    called(world, client, 9)
    client.take()
    world.robot_goes()
    world.clock.advance(0)
    (failure,) = client.took("serviceCallFailure")
    assert failure["callId"] == 9


# --- publishing ---------------------------------------------------------------------------------------------


def test_a_panel_that_advertises_again_and_again_keeps_driving(world: FoxgloveWorld) -> None:
    """338: each change of the panel's settings makes a new channel."""
    client = world.client()
    world.settle(client)
    for number in range(1, 30):
        advertised(world, client, number, "/cmd_vel", "geometry_msgs/Twist")
        client.publishes(number, twist(0.1))
        world.clock.advance(0)
        assert world.link.commands[-1][3] == twist(0.1)
        world.link.commands.clear()
        client.sends("unadvertise", channelIds=[number])
    held = world.people[0].controller.snapshot.lease
    assert held.held_by(world.people[0])
    assert not [each for each in client.statuses() if "unadvertise" in each]


def test_a_topic_that_only_the_client_has_takes_any_installed_type(world: FoxgloveWorld) -> None:
    """273: no schema of such a type has been advertised."""
    client = world.client()
    world.settle(client)
    advertised(world, client, 1, "/clicked", "geometry_msgs/Twist")
    client.publishes(1, twist(0.5))
    world.answer(client)
    assert world.link.samples[-1][2] == twist(0.5)


@pytest.mark.parametrize("encoding", ["cdr", "json"])
@pytest.mark.parametrize("joined", [False, True])
def test_a_message_between_advertise_and_unadvertise_is_published(
    world: FoxgloveWorld, encoding: str, joined: bool
) -> None:
    """All three come at once, before the definition is known, or even before the robot's link is open."""
    client = world.client()
    if joined:
        world.settle(client)
    channel = {"id": 1, "topic": "/clicked", "encoding": encoding, "schemaName": "geometry_msgs/Twist"}
    client.sends("advertise", channels=[channel])
    client.publishes(1, twist(0.5) if encoding == "cdr" else b'{"linear":{"x":0.5}}')
    client.sends("unadvertise", channelIds=[1])
    world.answer(client) if joined else world.settle(client)
    assert [each[2] for each in world.link.samples] == [twist(0.5)]
    (asked,), (ended,) = world.link.all(link.Advertise), world.link.all(link.Unadvertise)
    assert asked.number == ended.number
    assert not [each for each in client.statuses() if "/clicked" in each]


def test_a_command_that_waits_for_control_is_sent_though_its_topic_was_unadvertised(
    world: FoxgloveWorld,
) -> None:
    """The topic does not stay advertised for it."""
    client = world.client()
    world.settle(client)
    grants = world.control.obeys
    world.control.obeys = None
    assert grants is not None
    channel = {"id": 1, "topic": "/cmd_vel", "encoding": "cdr", "schemaName": "geometry_msgs/Twist"}
    client.sends("advertise", channels=[channel])
    client.publishes(1, twist(0.5))
    client.sends("unadvertise", channelIds=[1])
    for order in world.control.all(link.ControlGrant):
        grants(order)
    assert [each[3] for each in world.link.commands] == [twist(0.5)]
    begun, ended = world.link.all(link.Advertise), world.link.all(link.Unadvertise)
    assert [each.number for each in begun] == [each.number for each in ended]
    assert world.link.said[-1] == ended[-1]


def test_a_type_that_is_not_installed_is_refused_with_a_reason(world: FoxgloveWorld) -> None:
    """164, 168."""
    client = world.client()
    world.settle(client)
    client.take()
    entries = [
        {"id": 1, "topic": "/x", "encoding": "cdr", "schemaName": "nowhere_msgs/Odd"},
        {"id": 2, "topic": "/chatter", "encoding": "cdr", "schemaName": "std_msgs/String"},
    ]
    client.sends("advertise", channels=entries)
    for asked in world.link.take(link.Advertise):
        if asked.topic == "/x":
            refused = link.Failed(request="advertise", reference=str(asked.number), reason="not installed")
            world.channel.message(refused)
        else:
            confirmed = link.Advertised(
                number=asked.number, topic=asked.topic, type=asked.type, encoding="cdr"
            )
            world.channel.message(confirmed)
    client.publishes(1, b"\x00\x01\x00\x00\x00")
    for asked_type in world.link.take(link.GetType):
        world.channel.message(
            link.Failed(request="get_type", reference=asked_type.type, reason="not installed")
        )
    world.clock.advance(0)
    assert any("not installed" in each for each in client.statuses())
    client.publishes(2, text("hi"))
    assert [each[2] for each in world.link.samples] == [text("hi")]


def test_a_lost_connection_ends_what_the_client_published(world: FoxgloveWorld) -> None:
    """109, 132."""
    client = world.client()
    world.settle(client)
    advertised(world, client, 1, "/cmd_vel", "geometry_msgs/Twist")
    client.publishes(1, twist(0.1))
    world.clock.advance(0)
    client.transport.abortConnection()
    assert world.link.take(link.Unadvertise)
    assert not world.people


# --- graph and time -----------------------------------------------------------------------------------------


def test_the_graph_does_not_end_a_client_that_reads_nothing(world: FoxgloveWorld) -> None:
    """226, and a graph that changes all the time with a client that does not read."""
    client = world.client(Level.VIEWER)
    client.sends("subscribeConnectionGraph")
    client.end.pause()
    for number in range(2000):
        name = f"/t{number}/{'x' * 200}"
        topic = link.Topic(types=[STRING], publishers=[f"/node{number}"])
        old = {f"/t{number - 1}/{'x' * 200}": None} if number else {}
        world.registry.graph(world.robot, link.Graph(topics={name: topic, **old}))
    assert world.people[0].port.waiting_bytes < 300_000
    client.end.resume()
    client.run()
    world.clock.advance(1)
    known: set[str] = set()
    for message in client.took("connectionGraphUpdate"):
        known |= {each["name"] for each in message["publishedTopics"] if each["publisherIds"]}
        known -= set(message["removedTopics"])
    assert client.closed is None
    assert [each for each in known if each.startswith("/t")] == [f"/t1999/{'x' * 200}"]


def test_a_clock_that_begins_again_many_times_is_followed(world: FoxgloveWorld) -> None:
    """39: a bag played in a loop."""
    client = world.client(Level.VIEWER)
    world.settle(client)
    world.registry.described(world.robot, msgspec.structs.replace(MOTION, sim_time=True))
    client.take()
    number = next(each.number for each in world.link.take(link.Subscribe) if each.topic == "/clock")
    world.subscribed(number, "rosgraph_msgs/msg/Clock")
    for _ in range(3):
        for second in (5, 6, 7):
            world.channel.sample(number, b"\x00\x01\x00\x00" + struct.pack("<iI", second, 0), 1)
            world.clock.advance(0.1)
    messages = client.take()
    times = [each for each in messages if isinstance(each, bytes)]
    assert times == [struct.pack("<BQ", 2, second * 10**9) for second in (5, 6, 7)] * 3
    assert len([each for each in messages if isinstance(each, dict) and each["op"] == "serverInfo"]) == 1


@pytest.mark.parametrize("literal", ["NaN", "-Infinity"])
def test_nan_in_json_is_published_as_a_number(world: FoxgloveWorld, literal: str) -> None:
    """Python writes it. It is legal where it moves nothing."""
    world.registry.described(world.robot, link.Describe())
    client = world.client()
    world.settle(client)
    channel = {"id": 1, "topic": "/cmd_vel", "encoding": "json", "schemaName": "geometry_msgs/Twist"}
    client.sends("advertise", channels=[channel])
    (asked,) = world.link.take(link.Advertise)
    world.channel.message(link.Advertised(number=asked.number, topic=asked.topic, type=TWIST, encoding="cdr"))
    client.publishes(1, f'{{"linear":{{"x":{literal}}}}}'.encode())
    world.clock.advance(0)
    assert world.link.samples[-1][2] == twist(float(literal))


@pytest.mark.parametrize("encoding", ["cdr", "json"])
@pytest.mark.parametrize("literal", ["NaN", "-Infinity"])
def test_nan_in_a_command_is_refused_in_words(world: FoxgloveWorld, encoding: str, literal: str) -> None:
    """CDR can hold it as well."""
    client = world.client()
    world.settle(client)
    channel = {"id": 1, "topic": "/cmd_vel", "encoding": encoding, "schemaName": "geometry_msgs/Twist"}
    client.sends("advertise", channels=[channel])
    (asked,) = world.link.take(link.Advertise)
    world.channel.message(
        link.Advertised(number=asked.number, topic=asked.topic, type=TWIST, encoding="cdr", motion=True)
    )
    payload = twist(float(literal)) if encoding == "cdr" else f'{{"linear":{{"x":{literal}}}}}'.encode()
    client.publishes(1, payload)
    world.clock.advance(0)
    assert not world.link.commands
    assert any(
        "publish /cmd_vel: linear.x must be finite in a command that moves the robot" in each["message"]
        for each in client.took("status")
    )


def test_json_of_the_publish_panel_may_leave_fields_out(world: FoxgloveWorld) -> None:
    """307."""
    client = world.client()
    world.settle(client)
    channel = {"id": 1, "topic": "/cmd_vel", "encoding": "json", "schemaName": "geometry_msgs/Twist"}
    client.sends("advertise", channels=[channel])
    (asked,) = world.link.take(link.Advertise)
    world.channel.message(
        link.Advertised(number=asked.number, topic=asked.topic, type=TWIST, encoding="cdr", motion=True)
    )
    client.publishes(1, json.dumps({"linear": {"x": 0.2}}).encode())
    world.clock.advance(0)
    assert world.link.commands[-1][3] == twist(0.2)
