"""The daemon's side of its guard, with processes in memory."""

from __future__ import annotations

from typing import Any

import pytest

from robot_client.motion.guard_protocol import (
    GOALS_WITHIN_MS,
    Forget,
    GuardAlive,
    GuardedCommand,
    GuardedTopic,
    Leave,
    Probe,
    TopicReady,
    ZeroShape,
    cancelling,
    decoder,
    encode,
)
from robot_client.motion.guard_supervisor import DOUBTFUL, PROBE_EVERY, PROBE_MOVING, SILENT, GuardSupervisor
from robot_client.motion.typed_topic import TypedTopic
from tests.robot_client.processes import Process, Reactor

CMD = TypedTopic("/cmd_vel", "T")


class Scene:
    def __init__(self) -> None:
        self.reactor = Reactor(decoder.decode)
        self.alerts: list[str] = []
        self.keeper = GuardSupervisor(self.reactor, "guard", 500)
        self.keeper.on_alert = self._told
        self.keeper.start()

    def _told(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        self.alerts.append(f"{kind} {about} {'over' if over else level}")

    @property
    def process(self) -> Process:
        return self.reactor.processes[-1]


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_guard_is_told_of_topics_and_commands(scene: Scene) -> None:
    """Each topic is told once, each command as it goes."""
    scene.keeper.topic(CMD)
    scene.keeper.topic(CMD)
    scene.keeper.command(CMD, True, 5)
    assert scene.process.lines == [GuardedTopic(*CMD), GuardedCommand(*CMD, True, 5), Probe()]


def test_dead_guard_is_replaced_and_brought_up_to_date(scene: Scene) -> None:
    """A second later there is another guard that knows the topics and who moves; a person is told."""
    scene.keeper.topic(CMD)
    scene.keeper.command(CMD, True, 5)
    scene.process.end()
    assert scene.alerts == ["module guard error"]
    scene.reactor.advance(1.0)
    assert len(scene.reactor.processes) == 2
    assert scene.process.lines == [GuardedTopic(*CMD), GuardedCommand(*CMD, True, 5)]


def test_guard_is_told_what_a_zero_looks_like_and_how_long_a_topic_has(scene: Scene) -> None:
    """The next guard as well, until the topic is forgotten."""
    keeper = GuardSupervisor(scene.reactor, "guard", 500, topics={"/cmd_vel": 200})
    keeper.start()
    keeper.topic(CMD)
    keeper.shape(CMD, b"one")
    keeper.shape(CMD, b"two")
    assert scene.process.lines == [GuardedTopic(*CMD, 200), ZeroShape(*CMD, b"one"), ZeroShape(*CMD, b"two")]
    scene.process.end()
    scene.reactor.advance(1.0)
    assert scene.process.lines == [GuardedTopic(*CMD, 200), ZeroShape(*CMD, b"two")]
    keeper.forget(CMD)
    scene.process.end()
    scene.reactor.advance(2.0)
    assert scene.process.lines == []


def test_guard_that_can_not_live_is_not_started_all_the_time(scene: Scene) -> None:
    """A guard that dies at once each time is started ever more seldom, but at least every 30 s."""
    for _ in range(300):
        if scene.keeper.pid is not None:
            scene.process.end()
        scene.reactor.advance(1.0)
    assert 10 <= len(scene.reactor.processes) <= 16


def test_guard_that_answers_is_left_alone(scene: Scene) -> None:
    """A guard that answers its probes is not touched."""
    for _ in range(20):
        scene.reactor.advance(PROBE_EVERY)
        assert scene.process.lines[-1] == Probe()
        scene.process.protocol.outReceived(encode(GuardAlive()))
    assert scene.process.signals == []


def test_frozen_guard_is_ended_and_replaced(scene: Scene) -> None:
    """A guard that does not answer is killed, and another one started."""
    for _ in range(int(SILENT / PROBE_EVERY) + 1):
        scene.reactor.advance(PROBE_EVERY)
    assert scene.process.signals == ["KILL"]
    scene.reactor.advance(1.0)
    assert len(scene.reactor.processes) == 2


def test_daemon_that_leaves_lets_its_guard_go(scene: Scene) -> None:
    """On leaving, the guard is told to, its pipe ends, and nobody is alarmed."""
    left: list[Any] = []
    scene.keeper.stop().addCallback(left.append)
    assert scene.process.lines == [Leave()]
    assert scene.process.closed
    scene.process.end()
    assert left == [None]
    assert scene.alerts == []
    assert scene.reactor.getDelayedCalls() == []


def test_guard_that_stays_is_ended(scene: Scene) -> None:
    """A guard that does not leave within two seconds is killed."""
    scene.keeper.stop()
    scene.reactor.advance(2.0)
    assert scene.process.signals == ["KILL"]


def answer(scene: Scene, *answers: GuardAlive | TopicReady) -> None:
    scene.process.protocol.outReceived(b"".join(map(encode, answers)))


def test_a_topic_is_ready_when_the_guard_says_so_and_not_after_its_end(scene: Scene) -> None:
    """Only a guard that lives counts; its words may come in pieces."""
    scene.keeper.topic(CMD)
    said = encode(GuardAlive()) + encode(TopicReady(*CMD))
    scene.process.protocol.outReceived(said[:12])
    assert not scene.keeper.ready(CMD)
    scene.process.protocol.outReceived(said[12:])
    assert scene.keeper.ready(CMD)
    assert not scene.keeper.ready(TypedTopic("/other", "T"))
    scene.process.end()
    assert not scene.keeper.ready(CMD)


def test_each_type_of_a_topic_is_ready_for_itself(scene: Scene) -> None:
    """A guard that could stop a topic by one type is told of another, and can't stop it by that one yet."""
    stamped = TypedTopic("/cmd_vel", "Stamped")
    scene.keeper.topic(stamped)
    answer(scene, TopicReady(*stamped))
    scene.keeper.topic(CMD)
    assert scene.process.lines == [GuardedTopic(*stamped), GuardedTopic(*CMD)]
    assert not scene.keeper.ready(CMD)


def test_forgotten_topic_is_told_and_not_ready(scene: Scene) -> None:
    """A topic given up is no longer ready, also when the guard's word of it comes late; a new guard hears nothing."""
    scene.keeper.topic(CMD)
    scene.keeper.command(CMD, False, 5)
    answer(scene, TopicReady(*CMD))
    scene.keeper.forget(CMD)
    answer(scene, TopicReady(*CMD))
    assert scene.process.lines[-1] == Forget(*CMD)
    scene.keeper.topic(CMD)
    assert not scene.keeper.ready(CMD)
    scene.keeper.forget(CMD)
    scene.process.end()
    scene.reactor.advance(1.0)
    assert scene.process.lines == []


@pytest.mark.parametrize(
    "noise", [b"[INFO] [1700000000.0] [guard]: hello\n", b"\xff\xfe\n", b"[]\n\n", b"{" * 99999]
)
def test_noise_in_front_of_an_answer_is_passed_over(scene: Scene, noise: bytes) -> None:
    """What is no answer on the guard's output neither raises nor hides the answers behind it."""
    scene.keeper.topic(CMD)
    scene.process.protocol.outReceived(noise)
    scene.process.protocol.outReceived(b"\n" + encode(TopicReady(*CMD)))
    assert scene.keeper.ready(CMD)
    assert scene.process.signals == []


def test_frozen_guard_is_not_relied_on_while_anything_moves(scene: Scene) -> None:
    """While something moves the guard is asked every second, and two seconds without an answer take its word back."""
    scene.keeper.topic(CMD)
    answer(scene, TopicReady(*CMD))
    for _ in range(5):
        scene.keeper.command(CMD, True, 5)
        answer(scene, GuardAlive())
        scene.reactor.advance(PROBE_MOVING)
        assert scene.process.lines[-1] == Probe()
        assert scene.keeper.ready(CMD)
    scene.reactor.advance(DOUBTFUL)
    assert scene.keeper.ready(CMD)
    scene.reactor.advance(0.1)
    assert not scene.keeper.ready(CMD)
    answer(scene, GuardAlive())
    assert scene.keeper.ready(CMD)


def test_a_guard_that_answers_again_is_told(scene: Scene) -> None:
    """Once."""
    scene.process.end()
    scene.reactor.advance(1.0)
    scene.keeper.topic(CMD)
    for _ in range(2):
        answer(scene, GuardAlive())
    assert scene.alerts == ["module guard error", "module guard over"]


def test_guard_is_told_of_goals_with_a_time_of_their_own(scene: Scene) -> None:
    """Whatever the topics of the robot have; the next guard as well."""
    on = cancelling("/cmd_vel")
    keeper = GuardSupervisor(scene.reactor, "guard", 500, topics={"/cmd_vel": 200, on.topic: 200})
    keeper.start()
    keeper.topic(on)
    keeper.command(on, True, 5)
    told = [GuardedTopic(*on, GOALS_WITHIN_MS), GuardedCommand(*on, True, 5)]
    assert scene.process.lines[:2] == told
    scene.process.end()
    scene.reactor.advance(1.0)
    assert scene.process.lines == told
