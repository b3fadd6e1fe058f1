"""The motion desk: commands judged, silence answered with zero."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable

import pytest
from twisted.internet.task import Clock

from relay_protocol.errors import Refused, Unavailable
from relay_protocol.link import Limits, MotionPolicy, Stopped
from robot_client.link.clock_offset import ClockOffset
from robot_client.motion.authority import Authority, Suppression
from robot_client.motion.motion import KEPT, MAX_SHAPE, MotionControl
from robot_client.motion.motion_topics import MAX_TOPICS
from robot_client.motion.rules import MotionRules
from robot_client.motion.safety import DAEMON_SHARE, REPEATS, Times
from robot_client.motion.typed_topic import TypedTopic
from robot_client.platforms.memory import TWIST, MemoryPlatform, twist

GO = twist(1.0)
ZERO = twist()
DRIVER = 7
"""The source that holds control."""
STAMPED = "geometry_msgs/msg/TwistStamped"
JOY = "sensor_msgs/msg/Joy"


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

    def shape(self, on: TypedTopic, rest: bytes) -> None:
        self.lines.append((on.topic, rest))

    def command(self, on: TypedTopic, moving: bool, at: int) -> None:
        self.lines.append((on.topic, moving))

    def ready(self, on: TypedTopic) -> bool:
        return self.able


class Scene:
    def __init__(self, rules: MotionRules | None = None, deadline_ms: int = 500) -> None:
        self.clock = Clock()
        self.clock.advance(100)
        self.platform = MemoryPlatform()
        self.feed = Feed()
        self.authority = Authority()
        self.authority.hold(DRIVER, "ann", "operator", 0)
        policy = MotionPolicy(types=[TWIST], deadline_ms=deadline_ms)
        self.desk = MotionControl(
            policy, self.platform, self.clock, self.now, self.feed, self.authority, rules
        )
        self.offset = ClockOffset()
        self.offset.add(self.now(), self.now(), self.now())
        self.open("a")

    def now(self) -> int:
        return round(self.clock.seconds() * 1e9)

    def open(self, source: str, topic: str = "/cmd_vel", type: str = TWIST) -> None:
        self.desk.open(source, TypedTopic(topic, type), self.platform.advertise(topic, type, False, None))

    def command(self, body: bytes, source: str = "a", age: float = 0.0, by: int = DRIVER) -> bool:
        return self.desk.command(source, body, self.now() - int(age * 1e9), self.offset, by)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 100)):
            self.clock.advance(0.01)

    @property
    def sent(self) -> list[bytes]:
        return [body for _, body in self.platform.published]


def speeds(scene: Scene) -> list[float]:
    """Of everything that was published."""
    return [struct.unpack_from("<d", body, 4)[0] for body in scene.sent]


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


def test_a_command_that_a_newer_one_has_overtaken_is_dropped(scene: Scene) -> None:
    """A movement that comes after the zero that followed it, of the same source and topic, moves nothing."""
    scene.command(GO)
    scene.clock.advance(0.2)
    scene.command(ZERO)
    sent = list(scene.sent)
    assert not scene.command(GO, age=0.1)
    assert scene.sent == sent
    assert scene.desk.stale_commands == 1
    assert scene.command(GO)
    assert not scene.command(ZERO, age=0.1)
    scene.open("b", "/other/cmd_vel")
    assert scene.command(GO, "b", age=0.1)


def test_stale_zero_is_no_letting_go(scene: Scene) -> None:
    """One that a stalled link delivers after a resume does not let the stream go on that was there before."""
    scene.command(GO)
    scene.authority.stop(Stopped(by="eve", since=1.0), scene.now())
    scene.authority.resume(scene.now())
    assert not scene.command(ZERO, age=3.0)
    assert not scene.command(GO)
    assert scene.sent == [GO]
    scene.clock.advance(0.01)
    assert scene.command(ZERO)
    assert scene.command(GO)


def test_what_a_stalled_link_held_back_through_a_stop_is_not_obeyed_after_the_resume() -> None:
    """Nor what follows it, before its driver lets go, also where commands may be old."""
    scene = Scene(deadline_ms=2000)
    scene.run(0.1)
    scene.command(GO)
    scene.authority.stop(Stopped(by="eve", since=1.0), scene.now())
    scene.run(0.2)
    scene.authority.resume(scene.now())
    scene.run(0.7)
    for age in (1.0, 0.8, 0.6, 0.4, 0.2, 0.0):
        assert not scene.command(GO, age=age)
    assert scene.sent.count(GO) == 1
    assert scene.command(ZERO)
    assert scene.command(GO)


def test_stall_of_the_link_is_no_letting_go() -> None:
    """What comes too old when it ends shows that nobody did."""
    scene = Scene()
    scene.command(GO)
    scene.authority.stop(Stopped(by="eve", since=1.0), scene.now())
    scene.run(0.1)
    scene.authority.resume(scene.now())
    scene.command(GO)
    scene.run(1.0)
    assert not scene.command(GO, age=0.9)
    assert scene.desk.stale_commands == 0
    assert not scene.command(GO, age=0.1)
    assert scene.sent.count(GO) == 1


def test_stamp_of_the_future_is_no_letting_go(scene: Scene) -> None:
    """Nobody was silent until then."""
    scene.authority.stop(Stopped(by="eve", since=1.0), scene.now())
    scene.authority.resume(scene.now())
    assert not scene.command(GO)
    assert not scene.command(GO, age=-3.0)
    scene.run(0.1)
    assert not scene.command(GO)


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

    def noted(type: str, rest: bytes = b"") -> bytes:
        asked.append(type)
        return honest(type, rest)

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
    """However many topics come and go, or come and stay, the guard has 64 at most."""
    for number in range(3 * MAX_TOPICS):
        scene.open("cycle", f"/t{number}")
        scene.desk.close("cycle")
        assert len(scene.feed.topics) <= MAX_TOPICS
    for number in range(3 * MAX_TOPICS):
        scene.open(str(number), f"/u{number}")
        assert len(scene.feed.topics) <= MAX_TOPICS


# --- places ------------------------------------------------------------------------------------------------

CMD_VEL = TypedTopic("/cmd_vel", TWIST)


def crowd(scene: Scene, moving: bool = False) -> None:
    """As many topics as there are places, of somebody who holds no control; or of who does."""
    for number in range(MAX_TOPICS):
        source = f"crowd{number}"
        scene.open(source, f"/crowd{number}")
        assert scene.command(GO, source, by=DRIVER if moving else DRIVER + 1) == moving


def test_who_only_advertises_takes_no_place_from_who_drives(scene: Scene) -> None:
    """What was commanded by who may keeps its place, standing or not."""
    scene.command(GO)
    scene.command(ZERO)
    scene.run(1)
    crowd(scene)
    crowd(scene)
    assert CMD_VEL in scene.feed.topics
    assert scene.command(GO)
    crowd(scene)
    assert CMD_VEL in scene.feed.topics


def test_who_may_command_opens_a_topic_though_all_places_are_taken(scene: Scene) -> None:
    """By somebody who has never moved the robot."""
    crowd(scene)
    scene.open("b", "/base")
    assert TypedTopic("/base", TWIST) in scene.feed.topics
    assert scene.command(GO, "b")


def test_a_topic_that_lost_its_place_has_it_again_with_the_first_command(scene: Scene) -> None:
    """But not by one of somebody who may not command. It moves when the guard is ready for it, as ever."""
    crowd(scene)
    assert CMD_VEL not in scene.feed.topics
    assert not scene.command(GO, by=DRIVER + 1)
    assert CMD_VEL not in scene.feed.topics
    scene.feed.able = False
    assert not scene.command(GO)
    assert CMD_VEL in scene.feed.topics
    crowd(scene)
    scene.feed.able = True
    assert scene.command(GO)
    scene.run(1)
    assert scene.sent == [GO] + [ZERO] * REPEATS


def test_of_topics_that_were_commanded_the_latest_keep_their_places(scene: Scene) -> None:
    """The one whose last command is the longest ago gives way."""
    scene.command(ZERO)
    for number in range(MAX_TOPICS):
        scene.run(0.01)
        scene.open(str(number), f"/t{number}")
        scene.command(ZERO, str(number))
        if number == 0:
            scene.run(0.01)
            scene.command(ZERO)
    assert CMD_VEL in scene.feed.topics
    assert TypedTopic("/t0", TWIST) not in scene.feed.topics


def test_what_moves_keeps_its_place(scene: Scene) -> None:
    """When all do, no more topics are opened, and what has no place can be told zero alone."""
    crowd(scene, moving=True)
    assert CMD_VEL not in scene.feed.topics
    with pytest.raises(Unavailable, match="64 topics move the robot"):
        scene.open("more", "/more")
    assert not scene.command(GO)
    assert scene.desk.unguarded_commands == 1
    assert scene.command(ZERO)
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    scene.desk.close("crowd7")
    scene.run(0.2)
    assert scene.command(GO)


def test_the_publisher_of_a_topic_without_a_place_goes_with_its_client(scene: Scene) -> None:
    """There is nothing to be stopped."""
    crowd(scene)
    scene.desk.close("a")
    assert len(scene.platform.sinks) == MAX_TOPICS


def test_a_place_is_that_of_all_who_may_command_the_topic(scene: Scene) -> None:
    """Whoever of them took it again: it goes when the last of them has left."""
    scene.open("b")
    crowd(scene)
    assert CMD_VEL not in scene.feed.topics
    scene.open("c")
    scene.desk.close("c")
    scene.clock.advance(KEPT + 1)
    assert CMD_VEL in scene.feed.topics
    assert scene.command(GO)
    scene.run(1)
    scene.desk.close("a")
    scene.clock.advance(KEPT + 1)
    assert CMD_VEL in scene.feed.topics
    scene.desk.close("b")
    scene.clock.advance(KEPT + 1)
    assert CMD_VEL not in scene.feed.topics


# --- limits, shapes, times of single topics ----------------------------------------------------------------


def test_commands_are_held_to_the_limits_of_who_holds_control() -> None:
    """An operator's here; whoever suppresses is of no level that is known, and has the strictest."""
    scene = Scene(MotionRules(limits={"operator": Limits(linear=0.5), "owner": Limits(linear=0.8)}))
    scene.command(GO)
    scene.authority.hold(DRIVER, "ann", "owner", scene.now())
    scene.command(GO)
    scene.authority.suppress("/cmd_vel", Suppression(frozenset({8}), scene.now() + 10**9, "eve"))
    scene.command(GO, by=8)
    assert scene.sent == [twist(0.5), twist(0.8), twist(0.5)]
    assert scene.desk.limited_commands == 3


def test_after_zero_speed_grows_from_there() -> None:
    """Whoever said it: the driver, or the watchdog."""
    scene = Scene(MotionRules(limits={"operator": Limits(linear_acceleration=2.0)}))
    for _ in range(10):
        scene.command(GO)
        scene.run(0.1)
    assert scene.sent[-1] == GO
    scene.run(1)
    assert scene.sent[-1] == ZERO
    scene.command(GO)
    assert speeds(scene)[-1] == pytest.approx(2.0 * 0.1)
    scene.command(ZERO)
    scene.run(0.01)
    scene.command(GO)
    assert speeds(scene)[-1] == pytest.approx(2.0 * 0.01)


def test_what_can_not_be_limited_is_not_followed() -> None:
    """A command whose speeds can't be found counts as no command."""
    scene = Scene(MotionRules(limits={"operator": Limits(linear=0.5)}))
    assert scene.command(b"\0\7" + GO[2:]) is False
    assert scene.sent == []
    assert scene.desk.invalid_commands == 1


def test_who_is_limited_moves_nothing_by_what_has_no_speeds_to_read() -> None:
    """He is refused, and somebody is told; his zero passes, and so does who has no limits."""
    scene = Scene(MotionRules(limits={"operator": Limits(linear=0.5)}))
    told: list[tuple[str, str]] = []
    scene.desk.on_unread = lambda on, level: told.append((on.topic, level))
    scene.open("pad", "/joy", JOY)
    assert scene.command(GO, "pad") is False
    assert scene.command(ZERO, "pad")
    assert (told, scene.authority.refused, scene.desk.invalid_commands) == ([("/joy", "operator")], 1, 0)
    scene.authority.hold(DRIVER, "ann", "owner", scene.now())
    assert scene.command(GO, "pad")
    scene.authority.suppress("/joy", Suppression(frozenset({8}), scene.now() + 10**9, "eve"))
    assert scene.command(GO, "pad", by=8) is False
    assert told[1:] == [("/joy", "")]
    assert scene.sent == [ZERO, GO]


def test_what_is_listed_moves_the_robot_without_speeds() -> None:
    """Whoever set the limits says that it may."""
    scene = Scene(MotionRules(limits={"operator": Limits(linear=0.5)}, unlimited=["/joy"]))
    scene.open("pad", "/joy", JOY)
    assert scene.command(GO, "pad")
    assert scene.sent == [GO]


def test_what_nobody_may_command_can_not_be_advertised() -> None:
    """Everybody is limited; it is said why, and what helps."""
    scene = Scene(MotionRules(limits={"operator": Limits(linear=0.5), "owner": Limits(linear=0.8)}))
    with pytest.raises(
        Refused, match=r"sensor_msgs/msg/Joy on /joy .* 'unlimited' of the robot's \[limits\]"
    ):
        scene.open("pad", "/joy", JOY)
    assert TypedTopic("/joy", JOY) not in scene.feed.topics


def test_zero_has_the_shape_of_the_command(scene: Scene) -> None:
    """The guard hears of the shape before the command, and again only when it changes."""
    scene.platform.rests[TWIST] = b"two axes"
    scene.command(GO)
    scene.command(GO)
    assert scene.feed.lines[1:] == [("/cmd_vel", b"two axes"), ("/cmd_vel", True), ("/cmd_vel", True)]
    scene.desk.stop_all("test")
    assert scene.sent[-1] == b"two axes"


def test_a_shape_without_measure_is_no_command(scene: Scene) -> None:
    """What the guard would have to keep is bounded."""
    scene.platform.rests[TWIST] = bytes(MAX_SHAPE + 1)
    assert scene.command(GO) is False
    assert (scene.sent, scene.desk.invalid_commands) == ([], 1)


def test_a_topic_may_have_shorter_times() -> None:
    """Its commands grow old sooner, and it is stopped sooner; other topics have the robot's."""
    scene = Scene(MotionRules(topics={"/arm": Times(200, 100)}))
    scene.open("arm", "/arm")
    assert scene.command(GO, "arm", age=0.15) is False
    assert scene.command(GO, "a", age=0.15)
    scene.command(GO, "arm")
    scene.run(0.2 * DAEMON_SHARE + 0.01)
    assert scene.platform.published[-1] == ("/arm", ZERO)
    assert ("/cmd_vel", ZERO) not in scene.platform.published


# --- links that work one way only --------------------------------------------------------------------------


def test_a_command_ends_when_it_has_grown_too_old(scene: Scene) -> None:
    """One that was old when it came is over sooner: its driver may hear nothing any more."""
    assert scene.command(GO, age=0.3)
    scene.run(0.14)
    assert scene.sent == [GO]
    scene.run(0.02)
    assert scene.sent[-1] == ZERO
    assert scene.desk.watchdog_stops == 1


def test_a_driver_who_is_not_heard_by_the_relay_does_not_go_on(scene: Scene) -> None:
    """Commands that come all the time count no longer than the proof that the robot's own word arrives."""
    proof = scene.now()
    scene.desk.proof = lambda: proof
    passed = []
    for _ in range(60):
        passed.append(scene.command(GO))
        scene.run(0.01)
    assert passed == [True] * 45 + [False] * 15
    assert scene.sent[45:47] == [ZERO, ZERO]
    assert scene.desk.stale_commands == 15
    scene.desk.proof = scene.now
    assert scene.command(GO)


def test_a_longer_deadline_leaves_more_time_for_the_proof() -> None:
    """Else nobody far away could drive at all."""
    scene = Scene(deadline_ms=1000)
    proof = scene.now()
    scene.desk.proof = lambda: proof
    scene.run(0.8)
    assert scene.command(GO)
    scene.run(0.11)
    assert scene.sent[-1] == ZERO


def test_a_topic_of_shorter_times_waits_no_longer_for_the_proof() -> None:
    """The greater of its own times counts, not of the robot's."""
    scene = Scene(MotionRules(topics={"/arm": Times(200, 100)}))
    scene.open("arm", "/arm")
    proof = scene.now()
    scene.desk.proof = lambda: proof
    passed = []
    for _ in range(25):
        passed.append((scene.command(GO, "arm"), scene.command(GO)))
        scene.run(0.01)
    assert passed == [(True, True)] * 18 + [(False, True)] * 7
    stopped = [topic for topic, body in scene.platform.published if body == ZERO]
    assert set(stopped) == {"/arm"}
    assert scene.desk.stale_commands == 7


def test_whether_somebody_may_command_is_told(scene: Scene) -> None:
    """With the first publication and after the last."""
    told: list[bool] = []
    scene.desk.on_commanded = told.append
    scene.open("b")
    scene.desk.close("a")
    scene.desk.close("b")
    scene.desk.close("b")
    assert told == [True, False]


# --- ramps -------------------------------------------------------------------------------------------------


def ramping() -> Scene:
    return Scene(MotionRules(ramp_ms=200))


def test_silence_ends_in_a_ramp_that_is_over_in_time() -> None:
    """It begins earlier by its length; the last zero is said when a watchdog without a ramp would say its first."""
    scene = ramping()
    scene.command(GO)
    scene.run(0.2)
    assert speeds(scene) == [1.0]
    assert scene.desk.moving
    scene.run(0.19)
    slowing = speeds(scene)[1:]
    assert len(slowing) >= 5
    assert all(earlier > later > 0 for earlier, later in itertools.pairwise(slowing))
    assert scene.desk.moving
    scene.run(0.02)
    assert scene.sent[-1] == ZERO
    assert not scene.desk.moving
    scene.run(1)
    assert speeds(scene).count(0.0) == REPEATS
    assert scene.desk.watchdog_stops == 1
    assert scene.feed.lines[-1] == ("/cmd_vel", False)


def test_a_new_command_ends_a_ramp() -> None:
    """To move or to stand: it counts, and not the rest of the ramp."""
    scene = ramping()
    scene.command(GO)
    scene.run(0.3)
    scene.command(twist(0.7))
    assert speeds(scene)[-1] == 0.7
    scene.run(0.3)
    assert 0.0 < speeds(scene)[-1] < 0.7
    scene.command(ZERO)
    scene.run(1)
    assert speeds(scene)[-REPEATS:] == [0.0] * REPEATS
    assert speeds(scene).count(0.0) == REPEATS


def test_who_ends_a_ramp_goes_on_from_its_speed() -> None:
    """Not from the one before it: the most that his acceleration allows is counted from what was said last."""
    scene = Scene(MotionRules(limits={"operator": Limits(linear_acceleration=1.0)}, ramp_ms=200))
    for _ in range(20):
        scene.command(GO)
        scene.run(0.1)
    assert scene.sent[-1] == GO
    while speeds(scene)[-1] > 0.15:
        scene.run(0.01)
    slow = speeds(scene)[-1]
    assert slow > 0.0
    scene.clock.advance(0.005)
    scene.command(GO)
    assert speeds(scene)[-1] == pytest.approx(slow + 1.0 * 0.005)


def test_stop_is_never_a_ramp() -> None:
    """Neither one that begins nor one that is under way; zero is said at once."""
    scene = ramping()
    scene.command(GO)
    scene.desk.halt("test")
    assert scene.sent == [GO, ZERO]
    scene.run(1)
    scene.command(GO)
    scene.run(0.3)
    scene.desk.close("a")
    before = len(scene.sent)
    assert speeds(scene)[-1] > 0
    scene.desk.halt("test")
    assert scene.sent[before:] == [ZERO]
    scene.run(1)
    assert scene.sent[before:] == [ZERO] * REPEATS
    assert scene.platform.sinks == []


def fail_once(scene: Scene, monkeypatch: pytest.MonkeyPatch, topic: int = 0) -> None:
    """The next message of a publisher is lost with an error."""
    sink = scene.platform.sinks[topic]
    honest = sink.publish

    def broken(body: bytes) -> None:
        monkeypatch.setattr(sink, "publish", honest)
        raise RuntimeError("middleware is busy")

    monkeypatch.setattr(sink, "publish", broken)


def halted(scene: Scene) -> None:
    assert scene.desk.halt("test") == ["/cmd_vel"]


def suppressed(scene: Scene) -> None:
    scene.authority.suppress("/cmd_vel", Suppression(frozenset({8}), scene.now() + 10**9, "eve"))
    scene.desk.yield_topic("/cmd_vel", "test")


def said_zero(scene: Scene) -> None:
    with pytest.raises(RuntimeError):
        scene.command(ZERO)


@pytest.mark.parametrize("stop", [halted, suppressed, said_zero])
def test_a_zero_that_fails_ends_a_ramp_and_is_said_again(
    monkeypatch: pytest.MonkeyPatch, stop: Callable[[Scene], None]
) -> None:
    """Nothing of it is said after a stop, a suppression or a zero of the driver, though that could not be said."""
    scene = ramping()
    scene.command(GO)
    scene.run(0.3)
    before = len(scene.sent)
    assert 0.0 < speeds(scene)[-1] < 1.0
    fail_once(scene, monkeypatch)
    stop(scene)
    assert not scene.desk.moving
    scene.run(1)
    assert scene.sent[before:] == [ZERO] * (REPEATS - 1)
    assert scene.feed.lines[-1] == ("/cmd_vel", False)


def test_a_zero_that_fails_is_said_again(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether the first fails or one of the others; the publisher of a driver who left stays for it."""
    scene.command(GO)
    fail_once(scene, monkeypatch)
    scene.desk.close("a")
    assert scene.sent == [GO]
    scene.run(0.05)
    fail_once(scene, monkeypatch)
    scene.run(1)
    assert scene.sent == [GO] + [ZERO] * (REPEATS - 2)
    assert scene.platform.sinks == []
    assert scene.feed.lines[-1] == ("/cmd_vel", False)


def test_a_topic_on_which_nothing_can_be_said_is_left_to_the_guard(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is tried as often as zero is said, and the guard goes on counting it as moving."""
    tried: list[bytes] = []

    def broken(body: bytes) -> None:
        tried.append(body)
        raise RuntimeError("middleware is gone")

    scene.command(GO)
    monkeypatch.setattr(scene.platform.sinks[0], "publish", broken)
    scene.desk.halt("test")
    scene.run(1)
    assert tried == [ZERO] * REPEATS
    assert scene.feed.lines[-1] == ("/cmd_vel", True)


def test_a_ramp_ends_in_time_however_late_it_begins() -> None:
    """A publisher that leaves long after its last command leaves less of it, or none."""
    scene = ramping()
    scene.command(GO)
    scene.run(0.15)
    scene.desk.close("a")
    scene.run(0.19)
    assert 0.0 < speeds(scene)[-1] < 1.0
    scene.run(0.02)
    assert scene.sent[-1] == ZERO
    scene.run(1)
    assert scene.platform.sinks == []
    late = Scene(MotionRules(ramp_ms=200))
    late.command(GO)
    late.clock.pump([0.0])
    late.clock.rightNow += 0.39  # the process was held up: its watchdog has not had its turn
    late.desk.close("a")
    assert late.sent == [GO, ZERO]


def test_who_waits_for_a_standstill_waits_for_its_ramp() -> None:
    """Control is another's only then; a failure at its end is told."""
    scene, stood = ramping(), []
    scene.desk.standing().addCallback(stood.append)
    assert stood == [[]]
    scene.command(GO)
    scene.desk.stop_all("control changes", gently=True)
    scene.desk.standing().addCallback(stood.append)
    scene.run(0.19)
    assert stood == [[]]
    scene.run(0.02)
    assert stood == [[], []]


def test_a_ramp_that_can_not_end_in_zero_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the name of the topic; the guard, not told that it stands, stops it."""
    scene, stood = ramping(), []
    scene.command(GO)
    scene.desk.stop_all("control changes", gently=True)
    scene.desk.standing().addCallback(stood.append)

    def broken(body: bytes) -> None:
        raise RuntimeError("no middleware")

    monkeypatch.setattr(scene.platform.sinks[0], "publish", broken)
    scene.run(1)
    assert stood == [["/cmd_vel"]]
    assert scene.feed.lines[-1] == ("/cmd_vel", True)


def test_a_suppressor_does_not_wait_for_a_ramp() -> None:
    """What others moved there stands at once when a suppression begins."""
    scene = ramping()
    scene.command(GO)
    scene.run(0.3)
    assert speeds(scene)[-1] < 1.0
    scene.authority.suppress("/cmd_vel", Suppression(frozenset({8}), scene.now() + 10**9, "eve"))
    scene.desk.yield_topic("/cmd_vel", "test")
    assert scene.sent[-1] == ZERO


def test_what_has_no_speeds_is_stopped_without_a_ramp() -> None:
    """A joystick's axes, say; when a ramp would have begun."""
    scene = Scene(MotionRules(ramp_ms=200))
    scene.open("arm", "/arm", "some/msg/Type")
    scene.command(GO, "arm")
    scene.run(0.21)
    assert scene.platform.published == [("/arm", GO), ("/arm", ZERO)]
