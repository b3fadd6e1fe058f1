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
    Leave,
    Probe,
    ZeroShape,
    cancelling,
    decoder,
    encode,
)
from robot_client.motion.typed_topic import TypedTopic

MS = 1_000_000
TWIST = "geometry_msgs/msg/Twist"
CMD = TypedTopic("/cmd_vel", TWIST)
STAMPED = TypedTopic("/cmd_vel", "geometry_msgs/msg/TwistStamped")


class Outlets:
    def __init__(self) -> None:
        self.open_now: set[TypedTopic] = set()
        self.zeros: list[tuple[int, TypedTopic]] = []
        self.rests: list[bytes] = []
        self.listened = True
        self.scene: Scene

    def open(self, on: TypedTopic) -> None:
        self.open_now.add(on)

    def close(self, on: TypedTopic) -> None:
        self.open_now.discard(on)

    def zero(self, on: TypedTopic, rest: bytes) -> bool:
        self.zeros.append((self.scene.now // MS, on))
        self.rests.append(rest)
        return self.listened

    def heard(self, on: TypedTopic) -> bool:
        return self.listened


class Scene:
    def __init__(self) -> None:
        self.now = 1000 * MS
        self.outlets = Outlets()
        self.outlets.scene = self
        self.guard = Guard(500, self.outlets, lambda: self.now)
        self.guard.take(GuardedTopic(*CMD))
        self.guard.act()
        assert self.guard.take_ready() == [CMD]

    def move(self, moving: bool = True) -> None:
        self.guard.take(GuardedCommand(*CMD, moving, self.now))

    def run(self, ms: int) -> None:
        """Let time pass as the loop does: sleep as long as the guard says, then act."""
        end = self.now + ms * MS
        while (wait := self.guard.wait()) is not None and self.now + int(wait * 1e9) <= end:
            self.now += max(1, int(wait * 1e9))
            self.guard.act()
        self.now = end


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_dead_daemon_is_followed_by_zero_at_once(scene: Scene) -> None:
    """When the pipe ends while the robot moves, zero goes out at once and five times within 200 ms."""
    scene.move()
    scene.guard.orphaned()
    scene.run(1000)
    assert [at for at, _ in scene.outlets.zeros] == [1000, 1040, 1080, 1120, 1160]
    assert scene.guard.done


def test_dead_daemon_of_a_standing_robot_needs_nothing(scene: Scene) -> None:
    """When the robot stands, the guard of a dead daemon leaves without a word."""
    scene.move()
    scene.move(False)
    scene.guard.orphaned()
    assert scene.guard.done
    assert scene.outlets.zeros == []


def test_frozen_daemon_is_followed_by_zero(scene: Scene) -> None:
    """450 ms after the last word of a daemon that moved the robot, zero goes out."""
    scene.move()
    scene.run(449)
    assert scene.outlets.zeros == []
    scene.run(2)
    assert scene.outlets.zeros
    assert not scene.guard.done


def test_command_ends_a_stop_in_progress(scene: Scene) -> None:
    """A daemon that commands again is not spoken over."""
    scene.move()
    scene.run(460)
    count = len(scene.outlets.zeros)
    scene.move()
    scene.run(300)
    assert len(scene.outlets.zeros) == count


def test_idle_guard_sleeps(scene: Scene) -> None:
    """While nothing moves there is no time at which the guard wakes."""
    assert scene.guard.wait() is None


def test_orphan_does_not_stay(scene: Scene) -> None:
    """A guard whose stop nobody hears goes on for ten seconds, no longer."""
    scene.outlets.listened = False
    scene.move()
    scene.guard.orphaned()
    scene.run(9900)
    assert not scene.guard.done
    scene.run(300)
    assert scene.guard.done


def test_leaving_in_order_says_nothing(scene: Scene) -> None:
    """A daemon that leaves in order has stopped the robot itself."""
    scene.move()
    scene.move(False)
    scene.guard.take(Leave())
    assert scene.guard.done
    assert scene.outlets.zeros == []


def test_what_still_moves_when_the_daemon_leaves_is_stopped(scene: Scene) -> None:
    """It could not do that itself."""
    scene.move()
    scene.guard.take(Leave())
    scene.run(1000)
    assert len(scene.outlets.zeros) == 5
    assert scene.guard.done


@pytest.mark.parametrize(
    "line", [GuardedTopic("/a", "b"), Forget("/a", "b"), GuardedCommand("/a", "b", True, 5), Probe(), Leave()]
)
def test_lines_come_out_as_they_went_in(line: GuardedTopic | Forget | GuardedCommand | Probe | Leave) -> None:
    """Every line survives the pipe."""
    assert decoder.decode(encode(line)) == line
    assert encode(line).endswith(b"\n")


def test_a_topic_is_ready_once_somebody_listens(scene: Scene) -> None:
    """The guard says which topics it could stop: those its publisher has found a listener for, each once."""
    scene.outlets.listened = False
    scene.guard.take(GuardedTopic("/other", TWIST))
    scene.run(100)
    assert scene.guard.take_ready() == []
    scene.outlets.listened = True
    scene.run(100)
    assert scene.guard.take_ready() == [TypedTopic("/other", TWIST)]
    scene.run(100)
    assert scene.guard.take_ready() == []
    assert scene.guard.wait() is None


def test_the_type_commanded_last_is_the_one_stopped(scene: Scene) -> None:
    """A topic commanded as Twist after it was opened as TwistStamped is stopped as Twist."""
    scene.guard.take(GuardedTopic(*STAMPED))
    scene.move()
    scene.guard.orphaned()
    assert {on for _, on in scene.outlets.zeros} == {CMD}


def test_forgotten_topic_costs_no_publisher(scene: Scene) -> None:
    """The publisher of a topic nobody commands any more is taken away."""
    scene.guard.take(Forget(*CMD))
    scene.guard.act()
    assert scene.outlets.open_now == set()


def test_topic_that_moves_is_stopped_before_it_is_forgotten(scene: Scene) -> None:
    """A daemon that could not stop a topic and forgets it leaves the stop to the guard."""
    scene.move()
    scene.guard.take(Forget(*CMD))
    scene.guard.act()
    assert scene.outlets.open_now == {CMD}
    scene.run(1000)
    assert len(scene.outlets.zeros) == 5
    assert scene.outlets.open_now == set()


def test_topic_that_comes_back_is_not_forgotten(scene: Scene) -> None:
    """A topic commanded again before it could be forgotten keeps its publisher."""
    scene.move()
    scene.guard.take(Forget(*CMD))
    scene.guard.take(GuardedTopic(*CMD))
    scene.run(1000)
    assert scene.outlets.open_now == {CMD}


def test_topic_that_can_not_be_stopped_does_not_keep_the_next_from_it(scene: Scene) -> None:
    """A publisher that fails leaves the other topics their zeros."""
    scene.guard.take(GuardedTopic(*STAMPED))
    scene.guard.take(GuardedCommand(*STAMPED, True, scene.now))
    scene.move()
    honest = scene.outlets.zero

    def broken(on: TypedTopic, rest: bytes) -> bool:
        if on == STAMPED:
            raise RuntimeError("no publisher")
        return honest(on, rest)

    scene.outlets.zero = broken  # type: ignore[method-assign]
    scene.guard.orphaned()
    assert [on for _, on in scene.outlets.zeros] == [CMD]


def test_answers_have_their_output_for_themselves() -> None:
    """What else is written to standard output, by ROS for one, goes to the log and not between the answers."""
    program = (
        "import os; from robot_client.motion import guard; from robot_client.motion.guard_protocol import GuardAlive\n"
        "outlet = guard._own_stdout()\n"
        "os.write(1, b'noise'); guard._answer(outlet, GuardAlive())"
    )
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert found.stdout == encode(GuardAlive())
    assert b"noise" in found.stderr


def test_zero_has_the_shape_of_the_last_command(scene: Scene) -> None:
    """As the daemon told it, until the topic is forgotten."""
    line = decoder.decode(encode(ZeroShape(*CMD, b"\0two axes")))
    scene.guard.take(line)
    scene.move()
    scene.guard.orphaned()
    assert scene.outlets.rests == [b"\0two axes"]
    other = Scene()
    other.guard.take(ZeroShape(*CMD, b"shape"))
    other.guard.take(Forget(*CMD))
    other.guard.take(GuardedTopic(*CMD))
    other.move()
    other.guard.orphaned()
    assert other.outlets.rests == [b""]


def test_a_topic_with_a_shorter_time_is_stopped_earlier(scene: Scene) -> None:
    """The daemon says it with the topic."""
    arm = TypedTopic("/arm", TWIST)
    scene.guard.take(GuardedTopic(*arm, 200))
    scene.guard.take(GuardedCommand(*arm, True, scene.now))
    scene.move()
    scene.run(300)
    assert scene.outlets.zeros[0] == (1180, arm)
    assert {on for _, on in scene.outlets.zeros} == {arm}


SPIN = cancelling("/spin")


def test_goals_of_a_dead_daemon_are_cancelled_at_once(scene: Scene) -> None:
    """Several times, as topics are stopped; not those of an action whose goals have ended."""
    for on in (SPIN, cancelling("/dock_robot")):
        scene.guard.take(GuardedTopic(*on, GOALS_WITHIN_MS))
        scene.guard.take(GuardedCommand(*on, True, scene.now))
    scene.guard.take(GuardedCommand(*cancelling("/dock_robot"), False, scene.now))
    scene.guard.orphaned()
    scene.run(1000)
    assert [on for _, on in scene.outlets.zeros] == [SPIN] * 5
    assert scene.guard.done


def test_goals_have_longer_than_commands(scene: Scene) -> None:
    """A daemon that stands still for a moment loses its commands, and its goals 1.8 s after its last word of them."""
    scene.guard.take(GuardedTopic(*SPIN, GOALS_WITHIN_MS))
    scene.guard.take(GuardedCommand(*SPIN, True, scene.now))
    scene.move()
    scene.run(1799)
    assert {on for _, on in scene.outlets.zeros} == {CMD}
    scene.run(2)
    assert scene.outlets.zeros[-1] == (2800, SPIN)
