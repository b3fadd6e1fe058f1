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
    Probe,
    ShutDown,
    TopicReady,
    ZeroTemplate,
    cancelling,
    decoder,
    encode,
)
from robot_client.motion.guard_supervisor import (
    DOUBTFUL_AFTER,
    FROZEN_AFTER,
    PROBE_EVERY,
    PROBE_MOVING,
    GuardSupervisor,
)
from robot_client.motion.typed_topic import TypedTopic
from tests.worlds.memory_processes import Process, Reactor

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


def test_topics_are_sent_once_and_commands_each_time(scene: Scene) -> None:
    scene.keeper.add_topic(CMD)
    scene.keeper.add_topic(CMD)
    scene.keeper.note_command(CMD, True, 5)
    assert scene.process.lines == [GuardedTopic(*CMD), GuardedCommand(*CMD, True, 5), Probe()]


def test_ended_guard_is_restarted_with_topics_and_last_commands(scene: Scene) -> None:
    """After a second; an alert is raised."""
    scene.keeper.add_topic(CMD)
    scene.keeper.note_command(CMD, True, 5)
    scene.process.end()
    assert scene.alerts == ["module guard error"]
    scene.reactor.advance(1.0)
    assert len(scene.reactor.processes) == 2
    assert scene.process.lines == [GuardedTopic(*CMD), GuardedCommand(*CMD, True, 5)]


def test_renewed_guard_is_another_process_without_an_alert(scene: Scene) -> None:
    """At once, with topics and last commands, and with another node."""
    scene.keeper.add_topic(CMD)
    scene.keeper.renew()
    former, _ = scene.reactor.processes
    assert former.signals == ["KILL"]
    assert scene.process.lines == [GuardedTopic(*CMD)]
    assert scene.alerts == []
    scene.process.end()
    assert scene.alerts == ["module guard error"]


def test_zero_templates_and_times_are_sent(scene: Scene) -> None:
    """Also to a restarted guard, until the topic is forgotten."""
    keeper = GuardSupervisor(scene.reactor, "guard", 500, topics={"/cmd_vel": 200})
    keeper.start()
    keeper.add_topic(CMD)
    keeper.set_zero_template(CMD, b"one")
    keeper.set_zero_template(CMD, b"two")
    assert scene.process.lines == [
        GuardedTopic(*CMD, 200),
        ZeroTemplate(*CMD, b"one"),
        ZeroTemplate(*CMD, b"two"),
    ]
    scene.process.end()
    scene.reactor.advance(1.0)
    assert scene.process.lines == [GuardedTopic(*CMD, 200), ZeroTemplate(*CMD, b"two")]
    keeper.forget(CMD)
    scene.process.end()
    scene.reactor.advance(2.0)
    assert scene.process.lines == []


def test_pause_before_a_restart_doubles_up_to_30_s(scene: Scene) -> None:
    for _ in range(300):
        if scene.keeper.pid is not None:
            scene.process.end()
        scene.reactor.advance(1.0)
    assert 10 <= len(scene.reactor.processes) <= 16


def test_guard_that_answers_is_not_restarted(scene: Scene) -> None:
    for _ in range(20):
        scene.reactor.advance(PROBE_EVERY)
        assert scene.process.lines[-1] == Probe()
        scene.process.protocol.outReceived(encode(GuardAlive()))
    assert scene.process.signals == []


def test_frozen_guard_is_killed_and_restarted(scene: Scene) -> None:
    for _ in range(int(FROZEN_AFTER / PROBE_EVERY) + 1):
        scene.reactor.advance(PROBE_EVERY)
    assert scene.process.signals == ["KILL"]
    scene.reactor.advance(1.0)
    assert len(scene.reactor.processes) == 2


def test_shutdown_ends_the_guard_without_an_alert(scene: Scene) -> None:
    left: list[Any] = []
    scene.keeper.stop().addCallback(left.append)
    assert scene.process.lines == [ShutDown()]
    assert scene.process.closed
    scene.process.end()
    assert left == [None]
    assert scene.alerts == []
    assert scene.reactor.getDelayedCalls() == []


def test_guard_that_does_not_exit_in_two_seconds_is_killed(scene: Scene) -> None:
    scene.keeper.stop()
    scene.reactor.advance(2.0)
    assert scene.process.signals == ["KILL"]


def answer(scene: Scene, *answers: GuardAlive | TopicReady) -> None:
    scene.process.protocol.outReceived(b"".join(map(encode, answers)))


def test_topic_is_ready_while_the_guard_that_reported_it_runs(scene: Scene) -> None:
    """Its lines may arrive in pieces."""
    scene.keeper.add_topic(CMD)
    said = encode(GuardAlive()) + encode(TopicReady(*CMD))
    scene.process.protocol.outReceived(said[:12])
    assert not scene.keeper.ready(CMD)
    scene.process.protocol.outReceived(said[12:])
    assert scene.keeper.ready(CMD)
    assert not scene.keeper.ready(TypedTopic("/other", "T"))
    scene.process.end()
    assert not scene.keeper.ready(CMD)


def test_types_of_a_topic_are_ready_separately(scene: Scene) -> None:
    stamped = TypedTopic("/cmd_vel", "Stamped")
    scene.keeper.add_topic(stamped)
    answer(scene, TopicReady(*stamped))
    scene.keeper.add_topic(CMD)
    assert scene.process.lines == [GuardedTopic(*stamped), GuardedTopic(*CMD)]
    assert not scene.keeper.ready(CMD)


def test_forgotten_topic_is_not_ready(scene: Scene) -> None:
    """Also when the guard's answer arrives late."""
    scene.keeper.add_topic(CMD)
    scene.keeper.note_command(CMD, False, 5)
    answer(scene, TopicReady(*CMD))
    scene.keeper.forget(CMD)
    answer(scene, TopicReady(*CMD))
    assert scene.process.lines[-1] == Forget(*CMD)
    scene.keeper.add_topic(CMD)
    assert not scene.keeper.ready(CMD)
    scene.keeper.forget(CMD)
    scene.process.end()
    scene.reactor.advance(1.0)
    assert scene.process.lines == []


@pytest.mark.parametrize(
    "noise", [b"[INFO] [1700000000.0] [guard]: hello\n", b"\xff\xfe\n", b"[]\n\n", b"{" * 99999]
)
def test_other_lines_in_the_guards_output_are_ignored(scene: Scene, noise: bytes) -> None:
    scene.keeper.add_topic(CMD)
    scene.process.protocol.outReceived(noise)
    scene.process.protocol.outReceived(b"\n" + encode(TopicReady(*CMD)))
    assert scene.keeper.ready(CMD)
    assert scene.process.signals == []


def test_topic_is_not_ready_after_two_seconds_without_an_answer(scene: Scene) -> None:
    """While a topic moves, the guard is probed every second."""
    scene.keeper.add_topic(CMD)
    answer(scene, TopicReady(*CMD))
    for _ in range(5):
        scene.keeper.note_command(CMD, True, 5)
        answer(scene, GuardAlive())
        scene.reactor.advance(PROBE_MOVING)
        assert scene.process.lines[-1] == Probe()
        assert scene.keeper.ready(CMD)
    scene.reactor.advance(DOUBTFUL_AFTER)
    assert scene.keeper.ready(CMD)
    scene.reactor.advance(0.1)
    assert not scene.keeper.ready(CMD)
    answer(scene, GuardAlive())
    assert scene.keeper.ready(CMD)


def test_alert_ends_once_when_the_guard_answers_again(scene: Scene) -> None:
    scene.process.end()
    scene.reactor.advance(1.0)
    scene.keeper.add_topic(CMD)
    for _ in range(2):
        answer(scene, GuardAlive())
    assert scene.alerts == ["module guard error", "module guard over"]


def test_goals_are_sent_with_their_own_time_to_stop(scene: Scene) -> None:
    topic = cancelling("/cmd_vel")
    keeper = GuardSupervisor(scene.reactor, "guard", 500, topics={"/cmd_vel": 200, topic.name: 200})
    keeper.start()
    keeper.add_topic(topic)
    keeper.note_command(topic, True, 5)
    lines = [GuardedTopic(*topic, GOALS_WITHIN_MS), GuardedCommand(*topic, True, 5)]
    assert scene.process.lines[:2] == lines
    scene.process.end()
    scene.reactor.advance(1.0)
    assert scene.process.lines == lines
