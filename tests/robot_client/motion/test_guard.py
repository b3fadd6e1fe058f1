"""The decisions of the guard."""

from __future__ import annotations

import subprocess
import sys

import pytest

from robot_client.motion.guard import Guard
from robot_client.motion.guard_protocol import (
    GOALS_WITHIN_MS,
    Forget,
    GuardAlive,
    GuardedCommand,
    GuardedTopic,
    Probe,
    ShutDown,
    ZeroTemplate,
    cancelling,
    decoder,
    encode,
)
from robot_client.motion.typed_topic import TypedTopic

MS = 1_000_000
TWIST = "geometry_msgs/msg/Twist"
CMD = TypedTopic("/cmd_vel", TWIST)
STAMPED = TypedTopic("/cmd_vel", "geometry_msgs/msg/TwistStamped")


class RecordingOutputs:
    def __init__(self) -> None:
        self.open_now: set[TypedTopic] = set()
        self.zeros: list[tuple[int, TypedTopic]] = []
        self.zero_templates: list[bytes] = []
        self.has_subscriber = True
        self.scene: Scene

    def open(self, topic: TypedTopic) -> None:
        self.open_now.add(topic)

    def close(self, topic: TypedTopic) -> None:
        self.open_now.discard(topic)

    def zero(self, topic: TypedTopic, zero_template: bytes) -> bool:
        self.zeros.append((self.scene.now // MS, topic))
        self.zero_templates.append(zero_template)
        return self.has_subscriber

    def is_matched(self, topic: TypedTopic) -> bool:
        return self.has_subscriber


class Scene:
    def __init__(self) -> None:
        self.now = 1000 * MS
        self.outputs = RecordingOutputs()
        self.outputs.scene = self
        self.guard = Guard(500, self.outputs, lambda: self.now)
        self.guard.handle(GuardedTopic(*CMD))
        self.guard.act()
        assert self.guard.take_ready() == [CMD]

    def move(self, moving: bool = True) -> None:
        self.guard.handle(GuardedCommand(*CMD, moving, self.now))

    def run(self, ms: int) -> None:
        """Let time pass as the process does: wait as long as the guard says, then act."""
        end = self.now + ms * MS
        while (wait := self.guard.wait()) is not None and self.now + int(wait * 1e9) <= end:
            self.now += max(1, int(wait * 1e9))
            self.guard.act()
        self.now = end


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_zero_is_published_at_once_when_the_daemon_has_ended(scene: Scene) -> None:
    """Five times within 200 ms."""
    scene.move()
    scene.guard.daemon_lost()
    scene.run(1000)
    assert [at for at, _ in scene.outputs.zeros] == [1000, 1040, 1080, 1120, 1160]
    assert scene.guard.done


def test_guard_of_a_still_robot_exits_without_zero(scene: Scene) -> None:
    scene.move()
    scene.move(False)
    scene.guard.daemon_lost()
    assert scene.guard.done
    assert scene.outputs.zeros == []


def test_zero_is_published_450_ms_after_the_last_command(scene: Scene) -> None:
    scene.move()
    scene.run(449)
    assert scene.outputs.zeros == []
    scene.run(2)
    assert scene.outputs.zeros
    assert not scene.guard.done


def test_command_ends_a_stop_in_progress(scene: Scene) -> None:
    scene.move()
    scene.run(460)
    count = len(scene.outputs.zeros)
    scene.move()
    scene.run(300)
    assert len(scene.outputs.zeros) == count


def test_idle_guard_sleeps(scene: Scene) -> None:
    assert scene.guard.wait() is None


def test_unmatched_stop_ends_after_ten_seconds(scene: Scene) -> None:
    scene.outputs.has_subscriber = False
    scene.move()
    scene.guard.daemon_lost()
    scene.run(9900)
    assert not scene.guard.done
    scene.run(300)
    assert scene.guard.done


def test_a_stop_that_is_matched_late_has_all_its_zeros(scene: Scene) -> None:
    """The other side may miss the first one."""
    scene.outputs.has_subscriber = False
    scene.move()
    scene.guard.daemon_lost()
    scene.run(1500)
    unmatched = len(scene.outputs.zeros)
    scene.outputs.has_subscriber = True
    scene.run(1000)
    assert len(scene.outputs.zeros) - unmatched == 5
    assert scene.guard.done


def test_orderly_shutdown_publishes_nothing(scene: Scene) -> None:
    """The daemon has stopped the robot itself."""
    scene.move()
    scene.move(False)
    scene.guard.handle(ShutDown())
    assert scene.guard.done
    assert scene.outputs.zeros == []


def test_topic_that_still_moves_at_the_shutdown_is_stopped(scene: Scene) -> None:
    scene.move()
    scene.guard.handle(ShutDown())
    scene.run(1000)
    assert len(scene.outputs.zeros) == 5
    assert scene.guard.done


@pytest.mark.parametrize(
    "line",
    [GuardedTopic("/a", "b"), Forget("/a", "b"), GuardedCommand("/a", "b", True, 5), Probe(), ShutDown()],
)
def test_lines_survive_encoding(
    line: GuardedTopic | Forget | GuardedCommand | Probe | ShutDown,
) -> None:
    assert decoder.decode(encode(line)) == line
    assert encode(line).endswith(b"\n")


def test_topic_is_ready_once_a_subscriber_is_matched(scene: Scene) -> None:
    """Each is reported once."""
    scene.outputs.has_subscriber = False
    scene.guard.handle(GuardedTopic("/other", TWIST))
    scene.run(100)
    assert scene.guard.take_ready() == []
    scene.outputs.has_subscriber = True
    scene.run(100)
    assert scene.guard.take_ready() == [TypedTopic("/other", TWIST)]
    scene.run(100)
    assert scene.guard.take_ready() == []
    assert scene.guard.wait() is None


def test_topic_is_stopped_by_the_type_commanded_last(scene: Scene) -> None:
    scene.guard.handle(GuardedTopic(*STAMPED))
    scene.move()
    scene.guard.daemon_lost()
    assert {topic for _, topic in scene.outputs.zeros} == {CMD}


def test_publisher_of_a_forgotten_topic_is_removed(scene: Scene) -> None:
    scene.guard.handle(Forget(*CMD))
    scene.guard.act()
    assert scene.outputs.open_now == set()


def test_topic_that_moves_is_stopped_before_it_is_forgotten(scene: Scene) -> None:
    scene.move()
    scene.guard.handle(Forget(*CMD))
    scene.guard.act()
    assert scene.outputs.open_now == {CMD}
    scene.run(1000)
    assert len(scene.outputs.zeros) == 5
    assert scene.outputs.open_now == set()


def test_topic_that_is_commanded_again_keeps_its_publisher(scene: Scene) -> None:
    scene.move()
    scene.guard.handle(Forget(*CMD))
    scene.guard.handle(GuardedTopic(*CMD))
    scene.run(1000)
    assert scene.outputs.open_now == {CMD}


def test_failure_on_one_topic_does_not_prevent_the_stop_of_others(scene: Scene) -> None:
    scene.guard.handle(GuardedTopic(*STAMPED))
    scene.guard.handle(GuardedCommand(*STAMPED, True, scene.now))
    scene.move()
    honest = scene.outputs.zero

    def broken(topic: TypedTopic, zero_template: bytes) -> bool:
        if topic == STAMPED:
            raise RuntimeError("no publisher")
        return honest(topic, zero_template)

    scene.outputs.zero = broken  # type: ignore[method-assign]
    scene.guard.daemon_lost()
    assert [topic for _, topic in scene.outputs.zeros] == [CMD]


def test_answers_have_an_output_of_their_own() -> None:
    """Other writes to standard output, by ROS for one, go to the log."""
    program = (
        "import os; from robot_client.motion import guard; from robot_client.motion.guard_protocol import GuardAlive\n"
        "output = guard._reserve_stdout()\n"
        "os.write(1, b'noise'); guard._answer(output, GuardAlive())"
    )
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert found.stdout == encode(GuardAlive())
    assert b"noise" in found.stderr


def test_zero_has_the_shape_of_the_last_command(scene: Scene) -> None:
    """Until the topic is forgotten."""
    line = decoder.decode(encode(ZeroTemplate(*CMD, b"\0two axes")))
    scene.guard.handle(line)
    scene.move()
    scene.guard.daemon_lost()
    assert scene.outputs.zero_templates == [b"\0two axes"]
    other = Scene()
    other.guard.handle(ZeroTemplate(*CMD, b"shape"))
    other.guard.handle(Forget(*CMD))
    other.guard.handle(GuardedTopic(*CMD))
    other.move()
    other.guard.daemon_lost()
    assert other.outputs.zero_templates == [b""]


def test_a_topic_with_a_shorter_time_is_stopped_earlier(scene: Scene) -> None:
    arm = TypedTopic("/arm", TWIST)
    scene.guard.handle(GuardedTopic(*arm, 200))
    scene.guard.handle(GuardedCommand(*arm, True, scene.now))
    scene.move()
    scene.run(300)
    assert scene.outputs.zeros[0] == (1180, arm)
    assert {topic for _, topic in scene.outputs.zeros} == {arm}


SPIN = cancelling("/spin")


def test_goals_are_cancelled_at_once_when_the_daemon_has_ended(scene: Scene) -> None:
    """For two seconds, as a server may have died just before; not for actions whose goals have ended."""
    for topic in (SPIN, cancelling("/dock_robot")):
        scene.guard.handle(GuardedTopic(*topic, GOALS_WITHIN_MS))
        scene.guard.handle(GuardedCommand(*topic, True, scene.now))
    scene.guard.handle(GuardedCommand(*cancelling("/dock_robot"), False, scene.now))
    scene.guard.daemon_lost()
    scene.run(3000)
    assert {topic for _, topic in scene.outputs.zeros} == {SPIN}
    times = [at - 1000 for at, _ in scene.outputs.zeros]
    assert (times[:5], times[5:]) == ([0, 40, 80, 120, 160], list(range(200, 2000, 200)))
    assert scene.guard.done


def test_goals_are_cancelled_later_than_commands_end(scene: Scene) -> None:
    """1.8 s after the last notification."""
    scene.guard.handle(GuardedTopic(*SPIN, GOALS_WITHIN_MS))
    scene.guard.handle(GuardedCommand(*SPIN, True, scene.now))
    scene.move()
    scene.run(1799)
    assert {topic for _, topic in scene.outputs.zeros} == {CMD}
    scene.run(2)
    assert scene.outputs.zeros[-1] == (2800, SPIN)
