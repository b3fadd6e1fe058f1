"""Latched samples on the robot's link: which ones new subscribers get, and in what order."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_server.channels.latched import LATCHED_BYTES, MAX_SAMPLES, REPLAY_SECONDS
from tests.relay_server.channels.test_subscriptions import heard
from tests.relay_server.recordings.test_recorder import RecorderWorld
from tests.worlds.relay import Person, World, text
from tests.worlds.robot_channel_link import RobotLink

TOPIC = "/chatter"
HERE = {"latched": True, "publishers": 3, "replays": "memory-1"}


class Scene:
    """A robot that stores latched samples, and a client that has got three of them."""

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
        """Adds a client that subscribes."""
        person = self.world.person()
        person.says("subscribe", topic=TOPIC, **fields)
        return person

    def asked(self) -> list[list[int]]:
        """For each request to the robot, the stamps of samples that the relay has already."""
        self.world.clock.advance(0)
        requests = self.robot.asked("subscribe", topic=TOPIC)
        return [each["known_stamps"] for each in requests if each.get("known_stamps") is not None]

    def repeats(self, *stamps: int, end: bool = True) -> None:
        """The robot answers with the latched samples of its publishers."""
        self.robot.subscribed(TOPIC, **HERE)
        for stamp in stamps:
            self.robot.sample(self.number, b"", stamp)
        if end:
            self.robot.sample(self.number, b"", 0)


@pytest.fixture
def scene(world: World) -> Scene:
    return Scene(world)


def test_late_joiners_get_the_samples_that_publishers_keep(scene: Scene) -> None:
    """Samples are read from the relay's store, in the robot's order; no other client gets them."""
    late = scene.joins()
    assert heard(late) == []
    assert scene.asked() == [[1, 2, 3]]
    scene.repeats(1, 3)
    assert heard(late) == ["a", "c"]
    assert heard(scene.first) == []


def test_samples_that_come_in_another_order_than_at_first_all_arrive(world: World) -> None:
    """A robot knows the stamps of an earlier subscription, and its middleware delivers several publishers in any
    order. Each sample arrives once.
    """
    robot = RobotLink(world)
    person = world.person()
    robot.joins()
    person.says("subscribe", topic=TOPIC)
    number = robot.subscribed(TOPIC, **HERE)
    for stamp in (6, 2, 7, 1, 2, 6):
        robot.sample(number, text(str(stamp)), stamp)
    assert heard(person) == ["6", "2", "7", "1"]
    late = world.person()
    late.says("subscribe", topic=TOPIC)
    robot.sample(number, text("4"), 4)
    robot.subscribed(TOPIC, **HERE)
    for stamp in (1, 2, 4, 6, 7):
        robot.sample(number, b"", stamp)
    robot.sample(number, b"", 0)
    assert sorted(heard(late)) == ["1", "2", "4", "6", "7"]
    assert heard(person) == ["4"]


def test_second_subscription_of_a_connection_gets_them_too(scene: Scene) -> None:
    """Its id is another one; live samples go on, each once."""
    scene.first.says("subscribe", topic=TOPIC, id="second")
    scene.robot.sample(scene.number, text("d"), 4)
    assert heard(scene.first) == ["d"]
    scene.repeats(1, 2, 3, 4)
    assert heard(scene.first) == ["a", "b", "c"]
    scene.first.says("unsubscribe", topic=TOPIC, id="second")
    assert len(scene.asked()) == 1


def test_older_samples_come_before_live_ones(scene: Scene) -> None:
    """Samples published during the request wait for older ones, up to a time limit."""
    late = scene.joins()
    scene.robot.sample(scene.number, text("d"), 4)
    assert (heard(scene.first), heard(late)) == (["d"], [])
    scene.repeats(3, 4, end=False)
    assert heard(late) == ["c", "d"]
    scene.robot.sample(scene.number, text("e"), 5)
    assert heard(late) == []
    scene.world.clock.advance(REPLAY_SECONDS)
    assert heard(late) == ["e"]
    scene.robot.sample(scene.number, b"", 5)
    scene.robot.sample(scene.number, b"", 2)
    assert heard(late) == ["b"]
    scene.robot.sample(scene.number, text("f"), 6)
    assert heard(late) == heard(scene.first)[1:] == ["f"]


def test_robot_that_never_answers_holds_up_nothing(scene: Scene) -> None:
    late = scene.joins()
    scene.robot.sample(scene.number, text("d"), 4)
    scene.world.clock.advance(REPLAY_SECONDS)
    assert heard(late) == ["d"]
    scene.robot.sample(scene.number, text("e"), 5)
    assert heard(late) == ["e"]


def test_unclaimed_entry_is_forgotten(scene: Scene) -> None:
    """The next request names the remaining entries; missing ones arrive with their body."""
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


def test_requests_are_done_before_the_session_ends(scene: Scene) -> None:
    """Clients that connect one after another all get their samples."""
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
    """Each request costs the robot a subscription, so they are shared."""
    late = [scene.joins() for _ in range(20)]
    assert len(scene.asked()) == 1
    scene.robot.subscribed(TOPIC, **HERE)
    scene.world.clock.advance(0.2)
    assert len(scene.asked()) == 2
    scene.repeats(1, 2, 3)
    assert [heard(each) for each in late] == [["a", "b", "c"]] * 20


def test_same_memory_after_a_broken_link_repeats_nothing(scene: Scene) -> None:
    """A client that stayed gets only new samples; a client that joined meanwhile gets all."""
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
    """Stamps mean other samples then, even if they are small."""
    scene.robot.leaves()
    scene.world.clock.advance(1)
    scene.robot.joins()
    number = scene.robot.subscribed(TOPIC, **{**HERE, "replays": "memory-2"})
    scene.robot.sample(number, text("c"), 1)
    assert heard(scene.first) == ["c"]


def test_topic_that_turns_out_to_be_latched(world: World) -> None:
    """The first sample may pass before the robot knows this. Each later subscriber gets it, and none gets it
    twice.
    """
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
    assert robot.asked("subscribe", topic=TOPIC)[-1]["known_stamps"] == []
    robot.sample(number, text("a"), 7)
    robot.sample(number, text("b"), 8)
    robot.sample(number, b"", 0)
    assert [heard(each) for each in (first, late, again)] == [[], ["a"], ["a"]]


def test_a_throttle_loses_no_latched_message(world: World) -> None:
    """This includes the first client, whose throttle the robot applies."""
    robot = RobotLink(world)
    person = world.person()
    robot.joins()
    person.says("subscribe", topic=TOPIC, throttle_rate=5000)
    number = robot.subscribed(TOPIC, **HERE)
    world.clock.advance(0)
    assert robot.asked("subscribe", topic=TOPIC)[-1]["known_stamps"] == []
    robot.sample(number, text("c"), 3)
    robot.subscribed(TOPIC, **HERE)
    for stamp, word in ((1, "a"), (2, "b")):
        robot.sample(number, text(word), stamp)
    robot.sample(number, b"", 3)
    assert heard(person) == ["a", "b", "c"]


def test_recordings_have_what_was_published_before(scene: Scene) -> None:
    """For every publisher."""
    recording_world = RecorderWorld(scene.world)
    recording_world.starts()
    scene.repeats(1, 2, 3)
    assert recording_world.memory_writer.bodies == [text("a"), text("b"), text("c")]
    assert {each.track.latched for each in recording_world.memory_writer.written} == {True}


def test_inhibited_topics_are_asked_for_when_that_is_over(scene: Scene) -> None:
    """Clients that subscribed meanwhile get the latched samples at that time."""
    scene.world.robot.motion_state = link.MotionState(
        inhibited=[link.Inhibited(resource=TOPIC, ms=900, by="olga")]
    )
    late = scene.joins()
    assert scene.asked() == []
    scene.world.robot.motion_state = link.MotionState()
    scene.world.clock.advance(1)
    assert scene.asked() == [[1, 2, 3]]
    scene.repeats(1, 2)
    assert heard(late) == ["a", "b"]


def test_memory_is_bounded_for_any_messages_of_a_robot(scene: Scene) -> None:
    """Count and bytes are limited, repeated samples included."""
    late = scene.joins()
    kept = scene.world.channel.subscriptions.by_number[scene.number].latched_samples
    for stamp in range(10, MAX_SAMPLES + 100):
        scene.robot.sample(scene.number, text("x"), stamp)
    assert len(kept.stamps) == MAX_SAMPLES
    for stamp in range(10, MAX_SAMPLES + 100, 7):
        scene.robot.sample(scene.number, text("y" * 100_000), stamp)
    scene.robot.sample(scene.number, text("z" * (LATCHED_BYTES // 2)), MAX_SAMPLES + 200)
    scene.robot.sample(scene.number, text("z" * (LATCHED_BYTES // 2)), MAX_SAMPLES + 201)
    assert kept.size <= LATCHED_BYTES
    assert late.client.closed is None


def test_robot_without_memory_is_served_as_before(world: World) -> None:
    """For robots in other languages the relay stores one last sample per publisher."""
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
    assert [each.get("known_stamps") for each in robot.asked("subscribe", topic=TOPIC)] == [None]
