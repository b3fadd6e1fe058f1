"""The motion desk: commands judged, silence answered with zero."""

from __future__ import annotations

import pytest
from twisted.internet.task import Clock

from relay_protocol.errors import Unavailable
from relay_protocol.link import MotionPolicy
from robot_client.motion import KEPT, MAX_TOPICS, MotionDesk
from robot_client.offset import Offset
from robot_client.platforms.memory import TWIST, MemoryPlatform, twist
from robot_client.safety import REPEATS
from robot_client.topics import TypedTopic

GO = twist(1.0)
ZERO = twist()
STAMPED = "geometry_msgs/msg/TwistStamped"


class Feed:
    """Records what the guard is told."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, object]] = []
        self.topics: set[TypedTopic] = set()
        self.able = True

    def topic(self, on: TypedTopic) -> None:
        self.topics.add(on)
        self.lines.append((on.topic, on.type))

    def forget(self, on: TypedTopic) -> None:
        self.topics.discard(on)

    def command(self, on: TypedTopic, moving: bool, at: int) -> None:
        self.lines.append((on.topic, moving))

    def ready(self, on: TypedTopic) -> bool:
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

    def open(self, source: str, topic: str = "/cmd_vel", type: str = TWIST) -> None:
        self.desk.open(source, TypedTopic(topic, type), self.platform.advertise(topic, type, False, None))

    def command(self, body: bytes, source: str = "a", age: float = 0.0) -> bool:
        return self.desk.command(source, body, self.now() - int(age * 1e9), self.offset)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 100)):
            self.clock.advance(0.01)

    @property
    def sent(self) -> list[bytes]:
        return [body for _, body in self.platform.published]


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_silence_brings_zero_in_time(scene: Scene) -> None:
    """400 ms after the last command, and not before, zero goes out, five times, and is counted once."""
    scene.command(GO)
    scene.clock.advance(0.399)
    assert scene.sent == [GO]
    scene.clock.advance(0.002)
    assert scene.sent == [GO, ZERO]
    for _ in range(20):
        scene.clock.advance(0.01)
    assert scene.sent == [GO] + REPEATS * [ZERO]
    scene.clock.advance(10)
    assert scene.sent == [GO] + REPEATS * [ZERO]
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
    assert GO not in scene.sent[1:]
    assert ZERO in scene.sent
    assert scene.desk.stale_commands == 10


def test_zero_needs_no_stop(scene: Scene) -> None:
    """After a command of zero, said five times within 200 ms, the watchdog is quiet."""
    scene.command(GO)
    scene.command(ZERO)
    scene.run(0.2)
    assert scene.sent == [GO] + REPEATS * [ZERO]
    scene.run(2)
    assert scene.sent == [GO] + REPEATS * [ZERO]
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


def test_stop_all_stops_every_topic_though_one_fails(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A topic that can't be published on does not keep the next from its stop."""
    scene.open("b", "/second")
    scene.command(GO)
    scene.command(GO, "b")

    def broken(body: bytes) -> None:
        raise RuntimeError("middleware is gone")

    monkeypatch.setattr(scene.platform.sinks[0], "publish", broken)
    scene.desk.stop_all("test")
    assert scene.platform.published[-1] == ("/second", ZERO)


def test_guard_hears_all(scene: Scene) -> None:
    """The guard is told of the topic, of movement, and of standing."""
    scene.command(GO)
    scene.run(1)
    assert scene.feed.lines == [("/cmd_vel", TWIST), ("/cmd_vel", True), ("/cmd_vel", False)]


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


def test_fresh_command_ends_the_zeros(scene: Scene) -> None:
    """A driver who moves on is not stopped by what is left of an earlier stop."""
    scene.command(GO)
    scene.command(ZERO)
    scene.run(0.05)
    scene.command(GO)
    scene.run(0.3)
    assert scene.sent == [GO, ZERO, ZERO, GO]


def test_zero_while_standing_is_said_once(scene: Scene) -> None:
    """Only a change from moving to standing is repeated."""
    scene.command(ZERO)
    scene.run(1)
    assert scene.sent == [ZERO]


def test_guard_counts_the_robot_as_moving_until_the_last_zero(scene: Scene) -> None:
    """The guard, who would stop the robot if the daemon died now, hears of standing after the last zero."""
    scene.command(GO)
    scene.command(ZERO)
    scene.run(0.15)
    assert scene.feed.lines[-1] == ("/cmd_vel", True)
    scene.run(0.02)
    assert len(scene.sent) == 1 + REPEATS
    assert scene.feed.lines[-1] == ("/cmd_vel", False)


def test_publisher_that_leaves_says_its_zeros_first(scene: Scene) -> None:
    """The publisher of a driver who left is there until zero was said five times, then it goes."""
    scene.command(GO)
    scene.desk.close("a")
    scene.run(0.15)
    assert len(scene.platform.sinks) == 1
    scene.run(0.02)
    assert scene.platform.sinks == []
    assert scene.sent == [GO] + REPEATS * [ZERO]


def test_publisher_that_moved_nothing_goes_at_once(scene: Scene) -> None:
    """Without anything to stop a publisher goes in the same moment."""
    scene.desk.close("a")
    assert scene.platform.sinks == []


def test_finish_waits_for_the_last_zero(scene: Scene) -> None:
    """Who leaves can wait until all is said."""
    said: list[None] = []
    scene.command(GO)
    scene.desk.stop_all("test")
    scene.desk.finish().addCallback(said.append)
    scene.run(0.15)
    assert said == []
    scene.run(0.02)
    assert said == [None]
    scene.desk.finish().addCallback(said.append)
    assert len(said) == 2


def test_zero_has_the_type_of_the_command(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A topic advertised as TwistStamped first and driven as Twist is stopped as Twist."""
    asked: list[str] = []
    honest = scene.platform.zero

    def noted(type: str) -> bytes:
        asked.append(type)
        return honest(type)

    monkeypatch.setattr(scene.platform, "zero", noted)
    scene.open("stamped", "/base", STAMPED)
    scene.open("plain", "/base", TWIST)
    scene.command(GO, "plain")
    scene.run(1)
    assert set(asked) == {TWIST}
    assert ("/base", STAMPED) in scene.feed.lines
    assert ("/base", TWIST) in scene.feed.lines


def test_topics_nobody_commands_are_given_back(scene: Scene) -> None:
    """The guard keeps a topic for half a minute after its last client, then gives it back."""
    scene.desk.close("a")
    scene.clock.advance(KEPT - 1)
    assert len(scene.feed.topics) == 1
    scene.clock.advance(1)
    assert scene.feed.topics == set()
    assert scene.clock.getDelayedCalls() == []


def test_topic_that_is_commanded_again_is_kept(scene: Scene) -> None:
    """A client who comes back within that time finds the guard ready."""
    scene.desk.close("a")
    scene.clock.advance(KEPT - 1)
    scene.open("b")
    scene.clock.advance(KEPT)
    assert len(scene.feed.topics) == 1
    assert scene.command(GO, "b")


def test_other_type_of_an_idle_topic_takes_its_place(scene: Scene) -> None:
    """What was advertised with the wrong type is given back as soon as the topic is advertised with another."""
    scene.open("wrong", "/base", STAMPED)
    scene.desk.close("wrong")
    scene.open("right", "/base", TWIST)
    assert TypedTopic("/base", STAMPED) not in scene.feed.topics
    assert TypedTopic("/base", TWIST) in scene.feed.topics


def test_cycling_topics_cost_no_more_than_the_limit(scene: Scene) -> None:
    """However many topics come and go, the guard has 64 at most; when that many are in use, more are refused."""
    for number in range(3 * MAX_TOPICS):
        scene.open("cycle", f"/t{number}")
        scene.desk.close("cycle")
        assert len(scene.feed.topics) <= MAX_TOPICS
    for number in range(MAX_TOPICS - 1):
        scene.open(str(number), f"/u{number}")
    with pytest.raises(Unavailable, match="64 topics"):
        scene.open("more", "/more")
    scene.desk.close("0")
    scene.open("more", "/more")
