"""Nodes with incompatible quality of service, as the robot's link reports them."""

from __future__ import annotations

from typing import Any

from relay_protocol import link
from tests.worlds.relay import STRING, Person, World
from tests.worlds.robot_channel_link import RobotLink

TOPIC = "/chatter"
ODD = ["/logger: Volatile publisher and transient local subscription"]


def working(world: World) -> tuple[RobotLink, Person]:
    """A robot that has joined, and a client that receives warnings."""
    robot = RobotLink(world)
    person = world.person()
    robot.joins()
    person.says("set_level", level="warning")
    return robot, person


def reported(person: Person) -> list[tuple[str, Any]]:
    """Received warnings with their ids."""
    return [(each["msg"].rpartition(": ")[2], each.get("id")) for each in person.received("status")]


def status(world: World, person: Person) -> list[dict[str, Any]]:
    """The entry in ``/relay/status``."""
    person.says("subscribe", topic="/relay/status")
    world.clock.advance(1)
    found = [
        each["msg"]["unmatched"] for each in person.received("publish") if each["topic"] == "/relay/status"
    ]
    person.says("unsubscribe", topic="/relay/status")
    return list(found[-1])


def test_publishers_are_notified_of_incompatible_subscribers(world: World) -> None:
    """Each advertisement gets each change once, including later advertisements; no other client does."""
    robot, person = working(world)
    person.says("advertise", topic=TOPIC, type=STRING, id="one")
    number = robot.asked("advertise", topic=TOPIC)[-1]["number"]
    stands = link.Advertised(number=number, topic=TOPIC, type=STRING, encoding="cdr")
    odd = link.Advertised(number=number, topic=TOPIC, type=STRING, encoding="cdr", unmatched=ODD)
    robot.says(stands)
    assert reported(person) == []
    robot.says(odd)
    robot.says(odd)
    person.says("advertise", topic=TOPIC, type=STRING, id="two")
    reason = ODD[0].rpartition(": ")[2]
    assert reported(person) == [(reason, "one"), (reason, "two")]
    other = world.person()
    assert status(world, person) == [{"topic": TOPIC, "nodes": ODD}]
    assert status(world, other) == []
    robot.says(stands)
    assert status(world, person) == []
    assert reported(person) == []


def test_subscribers_are_notified_of_incompatible_publishers(world: World) -> None:
    """The warning has the ids of subscriptions; after a lost link it is sent again."""
    robot, person = working(world)
    qos = {"reliability": "reliable"}
    person.says("subscribe", topic=TOPIC, type=STRING, id="one", qos=qos)
    robot.subscribed(TOPIC, unmatched=["/camera: Best effort publisher and reliable subscription"])
    robot.subscribed(TOPIC, unmatched=["/camera: Best effort publisher and reliable subscription"])
    reason = "Best effort publisher and reliable subscription"
    assert reported(person) == [(reason, "one")]
    late = world.person()
    late.says("set_level", level="warning")
    late.says("subscribe", topic=TOPIC, id="late")
    assert reported(late) == [(reason, "late")]
    (entry,) = status(world, late)
    assert entry["topic"] == TOPIC
    robot.leaves()
    assert status(world, late) == []
    world.clock.advance(1)
    robot.joins()
    robot.subscribed(TOPIC, unmatched=["/camera: Best effort publisher and reliable subscription"])
    assert reported(person) == [(reason, "one")]


def test_a_robot_that_reports_too_many_is_refused(world: World) -> None:
    """The link's limit is 64 nodes."""
    robot, person = working(world)
    person.says("subscribe", topic=TOPIC, type=STRING)
    robot.subscribed(TOPIC, unmatched=["/n: x"] * 64)
    robot.subscribed(TOPIC, unmatched=["/n: x"] * 65)
    assert world.channel.link_state.link is None
