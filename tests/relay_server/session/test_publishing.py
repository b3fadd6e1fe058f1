"""A route is found once; it never outlives what it was founded on."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.sessions import publishing as module
from tests.relay_server.memory import MOTION, STRING, TWIST, Person, World

GO = {"linear": {"x": 0.5}}


def driving(world: World) -> Person:
    """Somebody whose command has just reached the robot."""
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
    """A fresh command."""
    person.session._pinging.ping()
    person.answers_pings()
    person.says("publish", topic="/cmd_vel", msg=GO, **more)


def found(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The topics whose route is looked for from now on."""
    looked: list[str] = []
    real = module.PublishHandler._find
    monkeypatch.setattr(
        module.PublishHandler, "_find", lambda self, ask: (looked.append(ask.topic), real(self, ask))[1]
    )
    return looked


def test_a_route_is_found_once(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """As long as nothing changes, names are not resolved nor rights looked up again."""
    person = driving(world)
    looked = found(monkeypatch)
    for _ in range(3):
        drive(person)
    person.says("publish", topic="cmd_vel", msg=GO)
    person.says("publish", topic="cmd_vel", msg=GO)
    assert looked == ["cmd_vel"]
    assert len(world.link.samples) == 5


def test_a_right_that_is_gone_counts_for_the_very_next_message(world: World) -> None:
    """Even before anybody is told of the change; and so does one that is given back."""
    person = driving(world)
    former = person.session.permit.rules
    person.session.permit.rules = Rules([Grant(Level.OPERATOR, deny=("publish:/cmd_vel",))])
    drive(person)
    assert not world.link.samples
    assert "is denied to you" in person.told()[0]
    assert person.session.refusals == 1
    person.session.permit.rules = former
    drive(person)
    assert len(world.link.samples) == 1


def test_a_robot_that_goes_ends_it(world: World) -> None:
    """What comes meanwhile is dropped and told; back again, it is advertised and sent anew."""
    person = driving(world)
    world.robot_goes()
    drive(person)
    assert person.told() == [
        "you have lost control of rover: the robot's link was lost",
        "robot rover is offline; the message was dropped",
    ]
    world.robot_comes(encodings=["json"])
    world.robot_joins()
    assert len(world.link.all(link.Advertise)) == 1
    world.clock.advance(0.6)
    drive(person)
    assert len(world.link.samples) == 1


def test_what_the_robot_says_of_motion_counts_for_the_very_next_message(world: World) -> None:
    """A topic that becomes motion is judged by age at once, and by the deadline that holds now."""
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
    """However often the route was used before."""
    person = driving(world)
    deadline = MOTION.motion.deadline_ms / 1000
    world.clock.pump([deadline])
    person.says("publish", topic="/cmd_vel", msg=GO)
    assert len(world.link.samples) == 1
    world.clock.pump([0.01])
    person.says("publish", topic="/cmd_vel", msg=GO, id="late")
    assert len(world.link.samples) == 1
    assert person.session.stale_commands == 1
    (status,) = person.hears("status")
    assert status["id"] == "late"
    assert "/cmd_vel was dropped: it may be 510 ms old" in status["msg"]


def test_taking_the_advertisement_back_ends_it(world: World) -> None:
    """The next message advertises again, or is told that it can't."""
    person, other = driving(world), world.person()
    other.says("advertise", topic="/cmd_vel", type=TWIST)
    person.says("unadvertise", topic="/cmd_vel")
    assert person.session not in world.channel.publications._topics["/cmd_vel"].holders
    drive(person)
    assert person.session in world.channel.publications._topics["/cmd_vel"].holders
    for each in (person, other):
        each.says("unadvertise", topic="/cmd_vel")
    drive(person)
    assert len(world.link.all(link.Advertise)) == 2
    number = world.link.all(link.Advertise)[-1].number
    assert [sample[0] for sample in world.link.samples][-1] == number


def test_a_robot_that_can_not_advertise_any_more_ends_it(world: World) -> None:
    """The phase is looked at for each message."""
    person = driving(world)
    number = world.link.all(link.Advertise)[0].number
    world.channel.message(link.Failed(what="advertise", ref=str(number), reason="not any more"))
    person.client.take()
    drive(person)
    assert not world.link.samples
    assert person.told() == ["the robot could not advertise /cmd_vel; the message was dropped"]


def test_a_type_that_comes_along_is_looked_at_each_time_it_differs(world: World) -> None:
    """A name that is none is refused, also on a topic whose route is known."""
    person = driving(world)
    drive(person, type="nonsense")
    assert not world.link.samples
    assert "is no type name" in person.told()[0]
    drive(person, type="geometry_msgs/Twist")
    assert len(world.link.samples) == 1


def test_routes_are_bounded(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that publishes to ever new topics takes no more memory."""
    monkeypatch.setattr(module, "ROUTES", 3)
    person = driving(world)
    for number in range(10):
        person.says("publish", topic=f"/t{number}", type=STRING, msg={})
        person.says("unadvertise", topic=f"/t{number}")
        assert len(person.session.publishing._routes) <= 3
    drive(person)
    assert len(world.link.samples) == 11
