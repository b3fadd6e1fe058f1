"""A decision is cached for each topic, and dropped when its inputs change."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.sessions import publishing as module
from tests.worlds.relay import MOTION, STRING, TWIST, Person, World

GO = {"linear": {"x": 0.5}}


def driving(world: World) -> Person:
    """A client whose command has just reached the robot."""
    world.robot_comes(encodings=["json"])
    person = world.person()
    person.says("set_level", level="info")
    world.robot_joins()
    person.says("advertise", topic="/cmd_vel", type=TWIST)
    drive(person)
    assert len(world.link.samples) == 1
    world.link.samples.clear()
    person.client.take()
    return person


def drive(person: Person, **more: Any) -> None:
    """Sends a fresh command."""
    person.rosbridge.ping()
    person.answers_pings()
    person.says("publish", topic="/cmd_vel", msg=GO, **more)


def found(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Topics on which a new decision is made from now on."""
    looked: list[str] = []
    real = module.PublishHandler._decide
    monkeypatch.setattr(
        module.PublishHandler, "_decide", lambda self, ask: (looked.append(ask.topic), real(self, ask))[1]
    )
    return looked


def test_a_decision_is_made_once(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without changes neither names nor rights are looked up again."""
    person = driving(world)
    looked = found(monkeypatch)
    for _ in range(3):
        drive(person)
    person.says("publish", topic="cmd_vel", msg=GO)
    person.says("publish", topic="cmd_vel", msg=GO)
    assert looked == ["cmd_vel"]
    assert len(world.link.samples) == 5


def test_a_right_that_is_gone_counts_for_the_very_next_message(world: World) -> None:
    """Even before notifications of the change; a returned right counts at once too."""
    person = driving(world)
    former = person.context.permit.rules
    person.context.permit.rules = Rules([Grant(Level.OPERATOR, deny=("publish:/cmd_vel",))])
    drive(person)
    assert not world.link.samples
    assert "is denied to you" in person.reported()[0]
    assert person.context.refusals == 1
    person.context.permit.rules = former
    drive(person)
    assert len(world.link.samples) == 1


def test_a_robot_that_goes_ends_it(world: World) -> None:
    """Messages meanwhile are dropped with an error; when it is back, the topic is advertised again."""
    person = driving(world)
    world.robot_goes()
    drive(person)
    assert person.reported() == [
        "you have lost control of rover: the robot's link was lost",
        "robot rover is offline; the message was dropped",
    ]
    world.robot_comes(encodings=["json"])
    world.robot_joins()
    assert len(world.link.all(link.Advertise)) == 1
    world.clock.advance(0.6)
    drive(person)
    assert len(world.link.samples) == 1


def test_motion_topics_count_from_the_next_message(world: World) -> None:
    """A topic that becomes motion has the age limit at once, with the present deadline."""
    person = driving(world)
    world.robot.description = link.Describe()
    world.clock.advance(3)
    person.says("publish", topic="/cmd_vel", msg=GO)
    assert len(world.link.samples) == 1, "what is no motion is not judged by age"
    world.robot.description = MOTION
    person.says("publish", topic="/cmd_vel", msg=GO)
    assert len(world.link.samples) == 1
    world.robot.description = link.Describe(motion=link.MotionPolicy(types=[TWIST], deadline_ms=70_000))
    person.says("publish", topic="/cmd_vel", msg=GO)
    assert len(world.link.samples) == 2


def test_age_is_judged_for_each_message(world: World) -> None:
    """For any number of earlier uses."""
    person = driving(world)
    deadline = MOTION.motion.deadline_ms / 1000
    world.clock.pump([deadline])
    person.says("publish", topic="/cmd_vel", msg=GO)
    assert len(world.link.samples) == 1
    world.clock.pump([0.01])
    person.says("publish", topic="/cmd_vel", msg=GO, id="late")
    assert len(world.link.samples) == 1
    assert person.context.stale_commands == 1
    (status,) = person.received("status")
    assert status["id"] == "late"
    assert "/cmd_vel was dropped: it may be 510 ms old" in status["msg"]


def test_taking_the_advertisement_back_ends_it(world: World) -> None:
    """The next message advertises again, or gets an error."""
    person, other = driving(world), world.person()
    other.says("advertise", topic="/cmd_vel", type=TWIST)
    person.says("unadvertise", topic="/cmd_vel")
    assert person.context not in world.channel.publications.advertisers("/cmd_vel")
    drive(person)
    assert person.context in world.channel.publications.advertisers("/cmd_vel")
    for each in (person, other):
        each.says("unadvertise", topic="/cmd_vel")
    drive(person)
    assert len(world.link.all(link.Advertise)) == 2
    number = world.link.all(link.Advertise)[-1].number
    assert [sample[0] for sample in world.link.samples][-1] == number


def test_a_robot_that_can_not_advertise_any_more_ends_it(world: World) -> None:
    """The state is checked for each message."""
    person = driving(world)
    number = world.link.all(link.Advertise)[0].number
    world.channel.message(link.Failed(request="advertise", reference=str(number), reason="not any more"))
    person.client.take()
    drive(person)
    assert not world.link.samples
    assert person.reported() == ["the robot could not advertise /cmd_vel; the message was dropped"]


def test_a_type_that_comes_along_is_looked_at_each_time_it_differs(world: World) -> None:
    """An invalid name is refused, even on a topic that the client published to before."""
    person = driving(world)
    drive(person, type="nonsense")
    assert not world.link.samples
    assert "is not a type name" in person.reported()[0]
    drive(person, type="geometry_msgs/Twist")
    assert len(world.link.samples) == 1


def test_decisions_are_bounded(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Publishing to many topics takes no more memory."""
    monkeypatch.setattr(module, "DECISIONS", 3)
    person = driving(world)
    for number in range(10):
        person.says("publish", topic=f"/t{number}", type=STRING, msg={})
        person.says("unadvertise", topic=f"/t{number}")
        assert len(person.session.publish_handler._decisions) <= 3
    drive(person)
    assert len(world.link.samples) == 11
