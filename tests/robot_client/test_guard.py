"""The decisions of the guard."""

from __future__ import annotations

import pytest

from robot_client.guard import Guard
from robot_client.guard_protocol import Command, Leave, Probe, Topic, decoder, encode

MS = 1_000_000


class Outlets:
    def __init__(self) -> None:
        self.opened: list[str] = []
        self.zeros: list[tuple[int, str]] = []
        self.listened = True
        self.scene: Scene

    def open(self, topic: str, type: str) -> None:
        self.opened.append(topic)

    def zero(self, topic: str) -> bool:
        self.zeros.append((self.scene.now // MS, topic))
        return self.listened

    def heard(self, topic: str) -> bool:
        return self.listened


class Scene:
    def __init__(self) -> None:
        self.now = 1000 * MS
        self.outlets = Outlets()
        self.outlets.scene = self
        self.guard = Guard(500, self.outlets, lambda: self.now)
        self.guard.take(Topic("/cmd_vel", "geometry_msgs/msg/Twist"))
        self.guard.act()
        assert self.guard.take_ready() == ["/cmd_vel"]

    def move(self, moving: bool = True) -> None:
        self.guard.take(Command("/cmd_vel", moving, self.now))

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
    scene.guard.take(Leave())
    assert scene.guard.done
    assert scene.outlets.zeros == []


@pytest.mark.parametrize("line", [Topic("/a", "b"), Command("/a", True, 5), Probe(), Leave()])
def test_lines_come_out_as_they_went_in(line: Topic | Command | Probe | Leave) -> None:
    """Every line survives the pipe."""
    assert decoder.decode(encode(line)) == line
    assert encode(line).endswith(b"\n")


def test_a_topic_is_ready_once_somebody_listens(scene: Scene) -> None:
    """The guard says which topics it could stop: those its publisher has found a listener for, each once."""
    scene.outlets.listened = False
    scene.guard.take(Topic("/other", "geometry_msgs/msg/Twist"))
    scene.run(100)
    assert scene.guard.take_ready() == []
    scene.outlets.listened = True
    scene.run(100)
    assert scene.guard.take_ready() == ["/other"]
    scene.run(100)
    assert scene.guard.take_ready() == []
    assert scene.guard.wait() is None
