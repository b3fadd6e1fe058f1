"""Latched samples by the robot's link: which ones new subscribers get, and in what order."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_server.channels.latched import HOLD_SECONDS, KEPT_BYTES, MOST
from tests.relay_server.channel.robot_link import RobotLink
from tests.relay_server.channel.test_subscriptions import heard
from tests.relay_server.memory import Person, World, text
from tests.relay_server.recording.test_recorder import Desk

TOPIC = "/chatter"
HERE = {"latched": True, "publishers": 3, "replays": "memory-1"}


class Scene:
    """A robot that repeats what publishers keep, with a client that has got three samples."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.robot = RobotLink(world)
        self.first = world.person()
        self.robot.joins()
        self.first.says("subscribe", topic=TOPIC)
        self.number = self.robot.subscribed(TOPIC, **HERE)
        for stamp, word in ((1, "a"), (2, "b"), (3, "c")):
            self.robot.sample(self.number, text(word), stamp)
        assert heard(self.first) == ["a", "b", "c"]

    def joins(self, **fields: Any) -> Person:
        """A further client that subscribes."""
        person = self.world.person()
        person.says("subscribe", topic=TOPIC, **fields)
        return person

    def asked(self) -> list[list[int]]:
        """For which samples the relay has asked the robot, each time with those it has."""
        self.world.clock.advance(0)
        requests = self.robot.asked("subscribe", topic=TOPIC)
        return [each["kept"] for each in requests if each.get("kept") is not None]

    def repeats(self, *stamps: int, end: bool = True) -> None:
        """The robot says that publishers keep these."""
        self.robot.subscribed(TOPIC, **HERE)
        for stamp in stamps:
            self.robot.sample(self.number, b"", stamp)
        if end:
            self.robot.sample(self.number, b"", 0)


@pytest.fixture
def scene(world: World) -> Scene:
    return Scene(world)


def test_late_joiners_get_what_the_robot_says_is_kept(scene: Scene) -> None:
    """From the relay's memory, in the robot's order; nobody else gets any of it."""
    late = scene.joins()
    assert heard(late) == []
    assert scene.asked() == [[1, 2, 3]]
    scene.repeats(1, 3)
    assert heard(late) == ["a", "c"]
    assert heard(scene.first) == []


def test_second_subscription_of_a_connection_gets_them_too(scene: Scene) -> None:
    """With another id; live samples go on meanwhile, each once."""
    scene.first.says("subscribe", topic=TOPIC, id="second")
    scene.robot.sample(scene.number, text("d"), 4)
    assert heard(scene.first) == ["d"]
    scene.repeats(1, 2, 3, 4)
    assert heard(scene.first) == ["a", "b", "c"]
    scene.first.says("unsubscribe", topic=TOPIC, id="second")
    assert len(scene.asked()) == 1


def test_older_samples_come_before_live_ones(scene: Scene) -> None:
    """What is published while the robot is asked waits for what is older, but not for long."""
    late = scene.joins()
    scene.robot.sample(scene.number, text("d"), 4)
    assert (heard(scene.first), heard(late)) == (["d"], [])
    scene.repeats(3, 4, end=False)
    assert heard(late) == ["c", "d"]
    scene.robot.sample(scene.number, text("e"), 5)
    assert heard(late) == []
    scene.world.clock.advance(HOLD_SECONDS)
    assert heard(late) == ["e"]
    scene.robot.sample(scene.number, b"", 5)
    scene.robot.sample(scene.number, b"", 2)
    assert heard(late) == ["b"]
    scene.robot.sample(scene.number, text("f"), 6)
    assert heard(late) == heard(scene.first)[1:] == ["f"]


def test_robot_that_never_answers_holds_up_nothing(scene: Scene) -> None:
    """Live samples come in any case."""
    late = scene.joins()
    scene.robot.sample(scene.number, text("d"), 4)
    scene.world.clock.advance(HOLD_SECONDS)
    assert heard(late) == ["d"]
    scene.robot.sample(scene.number, text("e"), 5)
    assert heard(late) == ["e"]


def test_what_nobody_keeps_is_forgotten(scene: Scene) -> None:
    """The next request names only what is left; what the relay lacks comes with its body."""
    scene.joins()
    scene.asked()
    scene.repeats(3)
    scene.world.clock.advance(1)
    late = scene.joins()
    assert scene.asked()[-1] == [3]
    scene.robot.subscribed(TOPIC, **HERE)
    scene.robot.sample(scene.number, text("b"), 2)
    scene.robot.sample(scene.number, b"", 1)
    scene.robot.sample(scene.number, b"", 3)
    assert heard(late) == ["b", "c"]
    assert heard(scene.first) == []


def test_each_request_is_done_before_anything_is_forgotten(scene: Scene) -> None:
    """Clients that come one after the other are all served."""
    early = scene.joins()
    scene.asked()
    scene.repeats(1, end=False)
    scene.world.clock.advance(0.2)
    late = scene.joins()
    assert len(scene.asked()) == 2
    scene.robot.sample(scene.number, b"", 0)
    scene.repeats(1, 2)
    assert heard(early) == ["a", "b"]
    assert heard(late) == ["a", "b"]


def test_many_clients_at_once_ask_once_in_a_while(scene: Scene) -> None:
    """Each request costs the robot a subscription."""
    late = [scene.joins() for _ in range(20)]
    assert len(scene.asked()) == 1
    scene.robot.subscribed(TOPIC, **HERE)
    scene.world.clock.advance(0.2)
    assert len(scene.asked()) == 2
    scene.repeats(1, 2, 3)
    assert [heard(each) for each in late] == [["a", "b", "c"]] * 20


def test_same_memory_after_a_broken_link_repeats_nothing(scene: Scene) -> None:
    """A client that stayed gets what is new alone; one that came meanwhile gets all that is kept."""
    scene.robot.leaves()
    late = scene.joins()
    scene.world.clock.advance(1)
    scene.robot.joins()
    scene.number = scene.robot.subscribed(TOPIC, **HERE)
    for stamp, word in ((2, "b"), (3, "c"), (4, "meanwhile")):
        scene.robot.sample(scene.number, text(word), stamp)
    assert heard(scene.first) == ["meanwhile"]
    assert heard(late) == ["b", "c"]
    scene.repeats(2, 3, 4)
    assert heard(late) == ["meanwhile"]


def test_another_memory_after_a_restart_repeats_everything(scene: Scene) -> None:
    """A stamp means another sample then, however small it is."""
    scene.robot.leaves()
    scene.world.clock.advance(1)
    scene.robot.joins()
    number = scene.robot.subscribed(TOPIC, **{**HERE, "replays": "memory-2"})
    scene.robot.sample(number, text("c"), 1)
    assert heard(scene.first) == ["c"]


def test_topic_that_turns_out_to_be_latched(world: World) -> None:
    """The robot passes a sample on before it knows: a client that subscribes then gets it, and nobody gets it twice."""
    robot = RobotLink(world)
    first, late, again = world.person(), world.person(), world.person()
    robot.joins()
    for each in (first, again):
        each.says("subscribe", topic=TOPIC)
    number = robot.subscribed(TOPIC, publishers=1, replays="memory-1")
    robot.sample(number, text("a"), 7)
    late.says("subscribe", topic=TOPIC)
    again.says("subscribe", topic=TOPIC, id="second")
    robot.sample(number, text("b"), 8)
    assert [heard(each) for each in (first, late, again)] == [["a", "b"], ["b"], ["a", "b"]]
    robot.subscribed(TOPIC, **HERE)
    world.clock.advance(0)
    assert robot.asked("subscribe", topic=TOPIC)[-1]["kept"] == []
    robot.sample(number, text("a"), 7)
    robot.sample(number, text("b"), 8)
    robot.sample(number, b"", 0)
    assert [heard(each) for each in (first, late, again)] == [[], ["a"], ["a"]]


def test_a_throttle_loses_none_of_what_is_kept(world: World) -> None:
    """Also to the first client, whose throttle the robot keeps."""
    robot = RobotLink(world)
    person = world.person()
    robot.joins()
    person.says("subscribe", topic=TOPIC, throttle_rate=5000)
    number = robot.subscribed(TOPIC, **HERE)
    world.clock.advance(0)
    assert robot.asked("subscribe", topic=TOPIC)[-1]["kept"] == []
    robot.sample(number, text("c"), 3)
    robot.subscribed(TOPIC, **HERE)
    for stamp, word in ((1, "a"), (2, "b")):
        robot.sample(number, text(word), stamp)
    robot.sample(number, b"", 3)
    assert heard(person) == ["a", "b", "c"]


def test_recordings_have_what_was_published_before(scene: Scene) -> None:
    """Of every publisher."""
    desk = Desk(scene.world)
    desk.starts()
    scene.repeats(1, 2, 3)
    assert desk.paper.bodies == [text("a"), text("b"), text("c")]
    assert {each.track.latched for each in desk.paper.written} == {True}


def test_inhibited_topics_are_asked_for_when_that_is_over(scene: Scene) -> None:
    """A client that subscribed meanwhile gets what is kept then."""
    scene.world.robot.safety = link.Safety(inhibited=[link.Inhibited(resource=TOPIC, ms=900, by="olga")])
    late = scene.joins()
    assert scene.asked() == []
    scene.world.robot.safety = link.Safety()
    scene.world.clock.advance(1)
    assert scene.asked() == [[1, 2, 3]]
    scene.repeats(1, 2)
    assert heard(late) == ["a", "b"]


def test_memory_is_bounded_whatever_a_robot_says(scene: Scene) -> None:
    """In count and in bytes, repeated ones included."""
    late = scene.joins()
    kept = scene.world.channel.subscriptions._numbers[scene.number].kept
    for stamp in range(10, MOST + 100):
        scene.robot.sample(scene.number, text("x"), stamp)
    assert len(kept.stamps) == MOST
    for stamp in range(10, MOST + 100, 7):
        scene.robot.sample(scene.number, text("y" * 100_000), stamp)
    scene.robot.sample(scene.number, text("z" * (KEPT_BYTES // 2)), MOST + 200)
    scene.robot.sample(scene.number, text("z" * (KEPT_BYTES // 2)), MOST + 201)
    assert kept.size <= KEPT_BYTES
    assert late.client.closed is None


def test_robot_without_memory_is_served_as_before(world: World) -> None:
    """Of robots in other languages the relay keeps as many of the last samples as the topic has publishers."""
    robot = RobotLink(world)
    first = world.person()
    robot.joins()
    first.says("subscribe", topic=TOPIC)
    number = robot.subscribed(TOPIC, latched=True, publishers=2)
    for word in ("a", "b", "c"):
        robot.sample(number, text(word), 0)
    late = world.person()
    late.says("subscribe", topic=TOPIC)
    late.says("subscribe", topic=TOPIC, id="again")
    assert heard(first) == ["a", "b", "c"]
    assert heard(late) == ["b", "c", "b", "c"]
    assert [each.get("kept") for each in robot.asked("subscribe", topic=TOPIC)] == [None]
