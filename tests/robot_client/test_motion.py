"""The motion desk: commands judged, silence answered with zero."""

from __future__ import annotations

import pytest
from twisted.internet.task import Clock

from relay_protocol.link import MotionPolicy
from robot_client.motion import MotionDesk
from robot_client.offset import Offset
from robot_client.platforms.memory import TWIST, MemoryPlatform, twist

GO = twist(1.0)
ZERO = twist()


class Feed:
    """Records what the guard is told."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, bool]] = []
        self.able = True

    def topic(self, topic: str, type: str) -> None:
        self.lines.append((topic + " " + type, False))

    def command(self, topic: str, moving: bool, at: int) -> None:
        self.lines.append((topic, moving))

    def ready(self, topic: str) -> bool:
        return self.able


class Scene:
    def __init__(self) -> None:
        self.clock = Clock()
        self.clock.advance(100)
        self.platform = MemoryPlatform()
        self.feed = Feed()
        self.desk = MotionDesk(MotionPolicy(types=[TWIST]), self.platform, self.clock, self.now, self.feed)
        self.offset = Offset()
        self.offset.add(self.now(), self.now(), self.now())
        self.open("a")

    def now(self) -> int:
        return round(self.clock.seconds() * 1e9)

    def open(self, source: str, topic: str = "/cmd_vel") -> None:
        self.desk.open(source, topic, TWIST, self.platform.advertise(topic, TWIST, False, None))

    def command(self, body: bytes, source: str = "a", age: float = 0.0) -> bool:
        return self.desk.command(source, body, self.now() - int(age * 1e9), self.offset)

    @property
    def sent(self) -> list[bytes]:
        return [body for _, body in self.platform.published]


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_silence_brings_zero_in_time(scene: Scene) -> None:
    """400 ms after the last command, and not before, zero goes out, once, and is counted."""
    scene.command(GO)
    scene.clock.advance(0.399)
    assert scene.sent == [GO]
    scene.clock.advance(0.002)
    assert scene.sent == [GO, ZERO]
    scene.clock.advance(10)
    assert scene.sent == [GO, ZERO]
    assert scene.desk.watchdog_stops == 1


def test_commands_feed_the_watchdog(scene: Scene) -> None:
    """While commands come the robot is not stopped."""
    for _ in range(20):
        scene.command(GO)
        scene.clock.advance(0.3)
    assert ZERO not in scene.sent


def test_stale_commands_do_not_feed_it(scene: Scene) -> None:
    """Commands too old are not published, are counted, and don't keep the robot moving."""
    scene.command(GO)
    for _ in range(10):
        assert not scene.command(GO, age=0.6)
        scene.clock.advance(0.1)
    assert scene.sent == [GO, ZERO]
    assert scene.desk.stale_commands == 10


def test_zero_needs_no_stop(scene: Scene) -> None:
    """After a command of zero the watchdog is quiet."""
    scene.command(GO)
    scene.command(ZERO)
    scene.clock.advance(2)
    assert scene.sent == [GO, ZERO]
    assert scene.desk.watchdog_stops == 0


def test_senseless_commands_are_not_published(scene: Scene) -> None:
    """A command with NaN, or one that is no message at all, goes nowhere."""
    assert not scene.command(twist(float("nan")))
    assert not scene.command(b"\0\1\0\0")
    assert scene.sent == []
    assert scene.desk.invalid_commands == 2


def test_driver_leaving_stops_at_once(scene: Scene) -> None:
    """When the publication that drives ends, zero goes out before its publisher does."""
    scene.open("b")
    scene.command(GO, "b")
    scene.desk.close("a")
    assert scene.sent == [GO]
    scene.desk.close("b")
    assert scene.sent == [GO, ZERO]


def test_stop_all_stops_every_topic_though_one_fails(scene: Scene) -> None:
    """A topic that can't be published on does not keep the next from its stop."""
    scene.open("b", "/second")
    scene.command(GO)
    scene.command(GO, "b")

    def broken(body: bytes) -> None:
        raise RuntimeError("middleware is gone")

    scene.platform.sinks[0].publish = broken  # type: ignore[method-assign]
    scene.desk.stop_all("test")
    assert scene.platform.published[-1] == ("/second", ZERO)


def test_guard_hears_all(scene: Scene) -> None:
    """The guard is told of the topic, of movement, and of standing."""
    scene.command(GO)
    scene.clock.advance(1)
    assert scene.feed.lines == [("/cmd_vel " + TWIST, False), ("/cmd_vel", True), ("/cmd_vel", False)]


def test_watchdog_of_one_topic_leaves_the_other(scene: Scene) -> None:
    """A topic still commanded goes on while another is stopped."""
    scene.open("b", "/second")
    scene.command(GO, "b")
    scene.clock.advance(0.3)
    scene.command(GO)
    scene.clock.advance(0.15)
    assert scene.platform.published[2:] == [("/second", ZERO)]


def test_nothing_moves_before_the_guard_can_stop_it(scene: Scene) -> None:
    """Commands that move are dropped and counted until the guard is ready; zero always passes."""
    scene.feed.able = False
    assert not scene.command(GO)
    assert scene.command(ZERO)
    assert scene.desk.unguarded_commands == 1
    scene.feed.able = True
    assert scene.command(GO)
    assert scene.sent == [ZERO, GO]
