"""Handshake, channels, subscriptions and messages of clients that speak Foxglove, by websocket bytes."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_protocol.scopes import Scope
from relay_server.access import may_subscribe
from relay_server.common import close_codes
from relay_server.foxglove import topics
from tests.worlds.foxglove_client import LEGACY, SDK, Foxglove, FoxgloveWorld, twist
from tests.worlds.relay import GRAPH, STRING, TEXTS, TWIST, text


@pytest.mark.parametrize(
    ("offered", "selected"),
    [(SDK, SDK), (LEGACY, LEGACY), (f"{LEGACY}, {SDK}", SDK), (f"bearer.token-ann, {LEGACY}", LEGACY)],
)
def test_the_subprotocol_decides_the_dialect(world: FoxgloveWorld, offered: str, selected: str) -> None:
    world.gate.person("ann", Level.VIEWER)
    client = Foxglove(world.gate, "" if "bearer" in offered else "ann", offered)
    assert client.status == 101
    assert client.core.subprotocol == selected
    assert client.took("serverInfo")


@pytest.mark.parametrize(("name", "words"), [("eve", "access token is unknown"), ("", "no credentials came")])
def test_a_browser_is_refused_with_a_reason_and_a_code(world: FoxgloveWorld, name: str, words: str) -> None:
    assert Foxglove(world.gate, name).status == 401
    browser = Foxglove(world.gate, name, Origin="https://app.foxglove.dev")
    (status,) = browser.took("status")
    assert status["level"] == 2
    assert words in status["message"]
    assert browser.closed == close_codes.UNAUTHENTICATED


def test_server_info_comes_first_and_a_viewer_cannot_publish(world: FoxgloveWorld) -> None:
    viewer = world.client(Level.VIEWER)
    first = viewer.take()[0]
    assert isinstance(first, dict)
    assert first["op"] == "serverInfo"
    assert "clientPublish" not in first["capabilities"]
    assert first["supportedEncodings"] == ["cdr", "json"]
    assert first["metadata"]["ROS_DISTRO"] == "jazzy"
    assert "clientPublish" in world.client(Level.OPERATOR, "bob").took("serverInfo")[0]["capabilities"]


@pytest.mark.parametrize(
    ("grant", "scope", "may"),
    [
        (Grant(Level.VIEWER, ("view:/front",)), None, False),
        (Grant(Level.VIEWER, ("call:/reset",)), None, False),
        (Grant(Level.VIEWER, ("publish:/goal",)), None, True),
        (Grant(Level.VIEWER, ("*:/arm/*",)), None, True),
        (Grant(Level.OWNER), "subscribe:/scan", False),
        (Grant(Level.OWNER), "viewer", False),
        (Grant(Level.OPERATOR), "viewer publish:/goal", True),
        (Grant(Level.OPERATOR), "owner", True),
        (Grant(Level.VIEWER), "operator", False),
    ],
)
def test_publishing_is_offered_to_who_may_publish_anything(
    world: FoxgloveWorld, grant: Grant, scope: str | None, may: bool
) -> None:
    permit = world.gate.person("ann", Level.VIEWER)
    permit.rules = Rules([grant], None if scope is None else Scope(scope).on("rover"))
    (info,) = Foxglove(world.gate).took("serverInfo")
    assert ("clientPublish" in info["capabilities"]) is may


def test_channels_carry_the_full_definition(world: FoxgloveWorld) -> None:
    client = world.client()
    world.settle(client)
    channels = client.channels()
    assert {"/chatter", "/cmd_vel", "/relay/control"} <= channels.keys()
    chatter, drive = channels["/chatter"], channels["/cmd_vel"]
    assert (chatter["encoding"], chatter["schemaEncoding"], chatter["schemaName"]) == (
        "cdr",
        "ros2msg",
        STRING,
    )
    assert chatter["schema"] == "string data\n"
    assert (
        drive["schema"].split("=" * 80 + "\nMSG: geometry_msgs/Vector3\n")[0]
        == "Vector3 linear\nVector3 angular\n"
    )
    assert channels["/relay/control"]["encoding"] == "json"


def subscribed(world: FoxgloveWorld, client: Foxglove, topic: str = "/chatter", id: int = 7) -> int:
    """Subscribes to a topic; returns the robot's subscription number."""
    channel = client.channels()[topic]
    client.sends("subscribe", subscriptions=[{"id": id, "channelId": channel["id"]}])
    number = world.link.take(link.Subscribe)[-1].number
    world.subscribed(number, channel["schemaName"])
    return number


def test_a_sample_goes_out_as_the_robot_sent_it(world: FoxgloveWorld) -> None:
    client = world.client()
    world.settle(client)
    number = subscribed(world, client)
    world.channel.sample(number, text("hi"), 1_700_000_000_000_000_000)
    (message,) = [each for each in client.take() if isinstance(each, bytes)]
    assert message.hex() == "0107000000" + "00002a36fe9c9717" + "00010000" + "03000000" + "686900"
    client.sends("unsubscribe", subscriptionIds=[7])
    assert world.link.take(link.Unsubscribe)
    world.channel.sample(number, text("late"), 1)
    assert not client.samples()


def test_a_client_publishes_cdr_and_json_with_the_ros_1_spelling(world: FoxgloveWorld) -> None:
    client = world.client()
    world.settle(client)
    client.sends(
        "advertise",
        channels=[
            {"id": 1, "topic": "/cmd_vel", "encoding": "cdr", "schemaName": "geometry_msgs/Twist"},
            {"id": 2, "topic": "/chatter", "encoding": "json", "schemaName": "std_msgs/String"},
        ],
    )
    for asked in world.link.take(link.Advertise):
        world.channel.message(
            link.Advertised(
                number=asked.number,
                topic=asked.topic,
                type=asked.type,
                encoding="cdr",
                motion=asked.type == TWIST,
            )
        )
    client.publishes(1, twist(0.2))
    world.clock.advance(0)
    client.publishes(1, twist(0.2))
    client.publishes(2, b'{"data":"hi"}')
    assert world.link.commands[-1][3] == twist(0.2)
    assert world.link.samples[-1][2] == text("hi")
    assert not [each for each in client.statuses() if "controlled" in each]


def test_a_viewer_is_refused_with_a_reason(world: FoxgloveWorld) -> None:
    viewer = world.client(Level.VIEWER)
    world.settle(viewer)
    viewer.take()
    channel = {"id": 1, "topic": "/cmd_vel", "encoding": "cdr", "schemaName": "geometry_msgs/Twist"}
    viewer.sends("advertise", channels=[channel])
    assert any("publish" in each for each in viewer.statuses())
    viewer.publishes(1, twist(1.0))
    assert not world.link.samples
    (reason,) = viewer.statuses()
    assert reason.startswith("publish /cmd_vel: your channel 1 was refused: ")
    assert "needs the level operator" in reason


def test_a_revoked_right_withdraws_the_channel(world: FoxgloveWorld) -> None:
    client = world.client(Level.VIEWER)
    world.settle(client)
    number = subscribed(world, client)
    permit = world.gate.permits["ann"]
    permit.rules = world.permit(Level.VIEWER, deny=("subscribe:/chatter",)).rules
    permit.on_change()
    (gone,) = client.took("unadvertise")
    assert len(gone["channelIds"]) == 1
    assert world.link.take(link.Unsubscribe)
    world.channel.sample(number, text("secret"), 1)
    assert not client.samples()


def test_a_topic_that_changes_its_type_is_withdrawn_before_it_is_advertised_again(
    world: FoxgloveWorld,
) -> None:
    client = world.client()
    world.settle(client)
    old = client.channels()["/chatter"]["id"]
    world.registry.graph(
        world.robot, link.Graph(topics={"/chatter": link.Topic(types=[TWIST], publishers=["/t"])})
    )
    messages: list[Any] = [each for each in client.take() if each["op"] in ("advertise", "unadvertise")]
    assert messages[0] == {"op": "unadvertise", "channelIds": [old]}
    (channel,) = messages[1]["channels"]
    assert (channel["topic"], channel["schemaName"]) == ("/chatter", TWIST)
    assert channel["id"] != old


def test_channels_outlast_a_lost_robot(world: FoxgloveWorld) -> None:
    client = world.client()
    world.settle(client)
    number = subscribed(world, client)
    world.robot_goes()
    assert not client.took("unadvertise")
    world.robot_comes(graph=GRAPH)
    world.settle(client)
    again = world.link.take(link.Subscribe)[-1].number
    world.subscribed(again)
    world.channel.sample(again, text("back"), 1)
    assert client.samples()[-1].body == text("back")
    assert again == number


def test_topics_without_a_definition_are_not_compared_again_each_second(
    world: FoxgloveWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    strange = {f"/t{n}": link.Topic(types=[f"odd_msgs/msg/T{n}"], publishers=["/t"]) for n in range(3)}
    world.registry.graph(world.robot, link.Graph(topics=strange))
    client = world.client()
    world.robot_joins()
    for asked in world.link.take(link.GetType):
        world.channel.message(link.Failed(request="get_type", reference=asked.type, reason="no such package"))
    world.clock.advance(0)
    assert any("no definition" in each for each in client.statuses())
    judged: list[str] = []

    def judge(decide: Any, robot: Any, topic: str, types: list[str]) -> Any:
        judged.append(topic)
        return may_subscribe(decide, robot, topic, types)

    monkeypatch.setattr(topics, "may_subscribe", judge)
    for _ in range(3):
        world.clock.advance(1)
    assert not judged


def test_definitions_that_arrive_together_cause_one_comparison(
    world: FoxgloveWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = world.client()
    world.robot_joins()
    judged: list[str] = []

    def judge(decide: Any, robot: Any, topic: str, types: list[str]) -> Any:
        judged.append(topic)
        return may_subscribe(decide, robot, topic, types)

    monkeypatch.setattr(topics, "may_subscribe", judge)
    world.define()
    world.clock.advance(0)
    assert {"/chatter", "/cmd_vel"} <= client.channels().keys()
    assert judged.count("/chatter") == 1


def test_a_definition_that_has_changed_withdraws_the_channel_when_the_robot_is_back(
    world: FoxgloveWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = world.client()
    world.settle(client)
    old = client.channels()["/chatter"]["id"]
    world.robot_goes()
    monkeypatch.setitem(TEXTS, STRING, "string data\nint32 count\n")
    world.robot_comes(graph=GRAPH)
    world.settle(client)
    messages: list[Any] = client.take()
    assert old in [id for message in messages for id in message.get("channelIds", ())]
    schemas = [each["schema"] for message in messages for each in message.get("channels", ())]
    assert TEXTS[STRING] in schemas


@pytest.mark.parametrize(
    ("publishers", "between", "arrive"),
    [(3, 0.3, ["one", "two", "three"]), (1, 0.0, ["one", "two", "three"]), (1, 0.6, ["three"])],
)
def test_latched_samples_that_are_kept_all_arrive_late(
    world: FoxgloveWorld, publishers: int, between: float, arrive: list[str]
) -> None:
    """Those of several publishers, and those of one that come when the robot has just subscribed."""
    client = world.client()
    world.settle(client)
    channel = client.channels()["/chatter"]
    client.sends("subscribe", subscriptions=[{"id": 7, "channelId": channel["id"]}])
    number = world.link.take(link.Subscribe)[-1].number
    world.subscribed(number, STRING, latched=True, publishers=publishers)
    queue = world.people[0].port.send_queue
    queue.pause()
    for stamp, each in enumerate(("one", "two", "three"), 1):
        world.channel.sample(number, text(each), stamp)
        world.clock.advance(between)
    world.clock.advance(3 - 3 * between)
    queue.resume()
    assert [each.body for each in client.samples()] == [text(each) for each in arrive]


def throttled(world: FoxgloveWorld) -> Foxglove:
    """A client with a throttle, which has subscribed to a topic of one publisher."""
    world.gate.person("ann", Level.VIEWER)
    client = Foxglove(world.gate, path="/robots/rover?throttle=200")
    world.settle(client)
    channel = client.channels()["/chatter"]
    client.sends("subscribe", subscriptions=[{"id": 7, "channelId": channel["id"]}])
    asked = world.link.all(link.Subscribe)[-1]
    assert asked.throttle_ms == 200
    world.subscribed(asked.number)
    return client


def test_a_throttle_is_lifted_when_a_second_node_publishes_the_topic(world: FoxgloveWorld) -> None:
    client = throttled(world)
    (asked,) = world.link.take(link.Subscribe)
    both = link.Topic(types=[STRING], publishers=["/talker", "/other"])
    world.registry.graph(world.robot, link.Graph(topics={"/chatter": both}))
    world.clock.advance(0)
    (again,) = world.link.take(link.Subscribe)
    assert (again.number, again.throttle_ms) == (asked.number, 0)
    for each in ("left", "right"):
        world.channel.sample(asked.number, text(each), 1)
    assert [each.body for each in client.samples()] == [text("left"), text("right")]


def test_a_throttle_that_can_not_be_lifted_at_once_is_lifted_later(world: FoxgloveWorld) -> None:
    """The user's quota was used up when the second publisher came."""
    client = throttled(world)
    world.link.take(link.Subscribe)
    requests = world.people[0].quota.user.requests
    requests.spend(requests.left)
    both = link.Topic(types=[STRING], publishers=["/talker", "/other"])
    world.registry.graph(world.robot, link.Graph(topics={"/chatter": both}))
    assert not world.link.take(link.Subscribe)
    for _ in range(30):
        world.clock.advance(1)
    client.run()
    assert [each.throttle_ms for each in world.link.take(link.Subscribe)] == [0]


VIDEO = "foxglove_msgs/msg/CompressedVideo"


@pytest.mark.parametrize(("type_name", "arrive"), [(VIDEO, [0, 1, 2]), (STRING, [2])])
def test_large_video_frames_wait_in_order_and_of_others_the_newest(
    world: FoxgloveWorld, monkeypatch: pytest.MonkeyPatch, type_name: str, arrive: list[int]
) -> None:
    monkeypatch.setitem(TEXTS, VIDEO, "uint8[] data\n")
    graph = link.Graph(topics={"/camera": link.Topic(types=[type_name], publishers=["/camera"])})
    world.registry.graph(world.robot, graph)
    client = world.client()
    world.settle(client)
    number = subscribed(world, client, "/camera")
    queue = world.people[0].port.send_queue
    queue.pause()
    frames = [bytes([n]) * 100_000 for n in range(3)]
    for stamp, each in enumerate(frames, 1):
        world.channel.sample(number, each, stamp)
    queue.resume()
    assert [each.body for each in client.samples()] == [frames[n] for n in arrive]
