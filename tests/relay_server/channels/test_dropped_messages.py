"""Messages that are dropped: their publishers and subscribers are notified, and the messages are counted."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_server.common.send_queue import DATA_PER_TOPIC
from tests.worlds.relay import STRING, TWIST, Person, World, text
from tests.worlds.robot_channel_link import RobotLink

EXCESS = 3
"""Messages beyond those that may wait for a robot."""


def publishers(world: World, *topics: tuple[str, str]) -> tuple[RobotLink, list[Person]]:
    """A robot that stalls, and a client that advertises each topic, of this type."""
    robot = RobotLink(world)
    clients = []
    for topic, type_name in topics:
        client = world.person()
        clients.append(client)
        client.says("set_level", level="warning")
        client.says("advertise", topic=topic, type=type_name, id=f"advertise {topic}")
        if len(clients) == 1:
            robot.joins()
    for topic, type_name in dict.fromkeys(topics):
        robot.advertised(topic, type_name, motion=type_name == TWIST)
    return robot, clients


def publish(client: Person, topic: str, count: int = DATA_PER_TOPIC + EXCESS, **message: Any) -> None:
    """Publishes so many messages."""
    for number in range(count):
        client.says("publish", topic=topic, msg=message or {"data": str(number)})


def test_a_publisher_is_warned_once_in_ten_seconds_while_the_robots_link_is_too_slow(world: World) -> None:
    robot, (client,) = publishers(world, ("/out", STRING))
    robot.stalls()
    publish(client, "/out", DATA_PER_TOPIC)
    assert client.received("status") == []
    publish(client, "/out", EXCESS)
    (status,) = client.received("status")
    assert (status["level"], status["id"]) == ("warning", "advertise /out")
    assert status["msg"].startswith("publish /out: messages are dropped, as the robot's link is too slow")
    assert "Publish less often, or smaller messages" in status["msg"]
    for _ in range(9):
        world.wait(1, client)
        robot.says(link.Ping(t=1))
    publish(client, "/out", 1)
    assert client.received("status") == []
    world.wait(1, client)
    publish(client, "/out", 1)
    assert len(client.received("status")) == 1


def test_only_the_client_whose_messages_are_dropped_is_warned(world: World) -> None:
    robot, (client, other) = publishers(world, ("/out", STRING), ("/out", STRING))
    robot.stalls()
    publish(client, "/out")
    publish(other, "/out", 1)
    assert other.received("status") == []
    assert len(client.received("status")) == 1


def test_a_driver_is_told_that_commands_are_dropped_and_that_this_is_intended(world: World) -> None:
    robot, (driver,) = publishers(world, ("/cmd_vel", TWIST))
    robot.stalls()
    publish(driver, "/cmd_vel", linear={"x": 1.0})
    (status,) = driver.received("status")
    assert "commands are dropped" in status["msg"]
    assert "an old one must not move the robot" in status["msg"]
    assert "Send commands less often" in status["msg"]


def test_status_counts_a_clients_dropped_messages_until_it_unadvertises(world: World) -> None:
    robot, (client, other) = publishers(world, ("/out", STRING), ("/out", STRING))
    client.says("subscribe", topic="/relay/status")
    other.says("subscribe", topic="/relay/status")
    robot.stalls()
    publish(client, "/out")
    for each, drops in ((client, [{"topic": "/out", "drops": EXCESS}]), (other, [])):
        each.client.take()
        world.clock.advance(1)
        assert each.received("publish")[-1]["msg"]["publish_drops"] == drops
    client.says("unadvertise", topic="/out")
    client.says("advertise", topic="/out", type=STRING)
    client.client.take()
    world.clock.advance(1)
    assert client.received("publish")[-1]["msg"]["publish_drops"] == []


@pytest.mark.parametrize("lose", ["channel", "robot"])
def test_a_client_is_notified_of_messages_that_waited_when_the_link_was_lost(world: World, lose: str) -> None:
    robot = RobotLink(world)
    client = world.person()
    client.says("set_level", level="warning")
    client.says("advertise", topic="/out", type=STRING)
    robot.joins()
    client.says("publish", topic="/out", msg={"data": "a"}, id="first")
    assert client.received("status") == []
    if lose == "channel":
        robot.leaves()
    else:
        world.robot_goes()
    (status,) = client.received("status")
    assert (status["level"], status["id"]) == ("error", "first")
    assert status["msg"] == "publish /out: the robot's link was lost before it was sent; dropped"


@pytest.mark.parametrize(
    ("reason", "words", "remedy"),
    [
        ("slow_link", "the robot's link is too slow", "throttle_rate"),
        ("slow_robot", "the robot's computer is too busy", "fewer topics"),
    ],
)
def test_a_subscriber_is_warned_once_in_ten_seconds_of_what_the_robot_drops(
    world: World, reason: str, words: str, remedy: str
) -> None:
    robot = RobotLink(world)
    client, other = world.person(), world.person()
    for each in (client, other):
        each.says("set_level", level="warning")
        each.says("subscribe", topic="/secret" if each is other else "/chatter", type=STRING, id="a")
    robot.joins()
    number = robot.subscribed("/chatter")
    for _ in range(2):
        robot.says(link.SamplesDropped(number=number, reason=reason, count=5))
    (status,) = client.received("status")
    assert (status["level"], status["id"]) == ("warning", "a")
    assert status["msg"].startswith(f"/chatter: samples are dropped, as {words}")
    assert remedy in status["msg"]
    assert not other.received("status")
    world.wait(5, client)
    robot.says(link.Ping(t=1))
    world.wait(5, client)
    robot.says(link.SamplesDropped(number=number, reason=reason, count=1))
    assert len(client.received("status")) == 1


def test_messages_that_wait_in_the_queue_of_a_lost_link_are_counted(world: World) -> None:
    robot, (client,) = publishers(world, ("/out", STRING))
    client.says("subscribe", topic="/relay/status")
    robot.stalls()
    publish(client, "/out", 2)
    robot.leaves()
    assert len(client.received("status")) == 1
    world.clock.advance(1)
    assert client.received("publish")[-1]["msg"]["publish_drops"] == [{"topic": "/out", "drops": 2}]


@pytest.mark.parametrize("topic", ["/chatter", "/throttled"])
def test_a_subscriber_that_reads_nothing_is_warned_but_not_of_what_its_throttle_drops(
    world: World, topic: str
) -> None:
    robot = RobotLink(world)
    client = world.person()
    client.says("set_level", level="warning")
    throttle = {"throttle_rate": 1000, "queue_length": 2} if topic == "/throttled" else {"queue_length": 1}
    client.says("subscribe", topic=topic, type=STRING, id="a", **throttle)
    robot.joins()
    number = robot.subscribed(topic)
    if topic == "/chatter":
        client.rosbridge.pause()
    for words in "abcde":
        robot.sample(number, text(words))
    if topic == "/chatter":
        client.rosbridge.resume()
    found = client.reported()
    assert len(found) == (topic == "/chatter")
    assert all("your client does not read fast enough" in each for each in found)
    assert client.context.port.drops_by_topic[topic] > 0
