"""Nodes that a subscription or a publisher does not reach for its quality of service, as the robot's link tells it."""

from __future__ import annotations

from typing import Any

from relay_protocol import link
from tests.relay_server.channel.robot_link import RobotLink
from tests.relay_server.memory import STRING, Person, World

TOPIC = "/chatter"
ODD = ["/logger: Volatile publisher and transient local subscription"]


def working(world: World) -> tuple[RobotLink, Person]:
    """A robot that has joined, and a client that wants to be told."""
    robot = RobotLink(world)
    person = world.person()
    robot.joins()
    person.says("set_level", level="warning")
    return robot, person


def told(person: Person) -> list[tuple[str, Any]]:
    """The warnings that came, with their ids."""
    return [(each["msg"].rpartition(": ")[2], each.get("id")) for each in person.hears("status")]


def status(world: World, person: Person) -> list[dict[str, Any]]:
    """What the status says of it."""
    person.says("subscribe", topic="/relay/status")
    world.clock.advance(1)
    found = [each["msg"]["unmatched"] for each in person.hears("publish") if each["topic"] == "/relay/status"]
    person.says("unsubscribe", topic="/relay/status")
    return list(found[-1])


def test_publishers_are_told_whom_they_do_not_reach(world: World) -> None:
    """Each advertisement once for each change, also those that come later; nobody else."""
    robot, person = working(world)
    person.says("advertise", topic=TOPIC, type=STRING, id="one")
    number = robot.asked("advertise", topic=TOPIC)[-1]["number"]
    stands = link.Advertised(number=number, topic=TOPIC, type=STRING, encoding="cdr")
    odd = link.Advertised(number=number, topic=TOPIC, type=STRING, encoding="cdr", unmatched=ODD)
    robot.says(stands)
    assert told(person) == []
    robot.says(odd)
    robot.says(odd)
    person.says("advertise", topic=TOPIC, type=STRING, id="two")
    reason = ODD[0].rpartition(": ")[2]
    assert told(person) == [(reason, "one"), (reason, "two")]
    other = world.person()
    assert status(world, person) == [{"topic": TOPIC, "nodes": ODD}]
    assert status(world, other) == []
    robot.says(stands)
    assert status(world, person) == []
    assert told(person) == []


def test_subscribers_are_told_whom_they_do_not_hear(world: World) -> None:
    """The same, by the ids of their subscriptions; after the loss of the link it is news again."""
    robot, person = working(world)
    qos = {"reliability": "reliable"}
    person.says("subscribe", topic=TOPIC, type=STRING, id="one", qos=qos)
    robot.subscribed(TOPIC, unmatched=["/camera: Best effort publisher and reliable subscription"])
    robot.subscribed(TOPIC, unmatched=["/camera: Best effort publisher and reliable subscription"])
    reason = "Best effort publisher and reliable subscription"
    assert told(person) == [(reason, "one")]
    late = world.person()
    late.says("set_level", level="warning")
    late.says("subscribe", topic=TOPIC, id="late")
    assert told(late) == [(reason, "late")]
    (entry,) = status(world, late)
    assert entry["topic"] == TOPIC
    robot.leaves()
    assert status(world, late) == []
    world.clock.advance(1)
    robot.joins()
    robot.subscribed(TOPIC, unmatched=["/camera: Best effort publisher and reliable subscription"])
    assert told(person) == [(reason, "one")]


def test_a_robot_that_tells_too_much_is_refused(world: World) -> None:
    """Sixty-four nodes at most, by the limits of the link."""
    robot, person = working(world)
    person.says("subscribe", topic=TOPIC, type=STRING)
    robot.subscribed(TOPIC, unmatched=["/n: x"] * 64)
    robot.subscribed(TOPIC, unmatched=["/n: x"] * 65)
    assert world.channel.wire.link is None
