"""Motion control: commands are judged, and zero is published when they end."""

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
from robot_client.motion.motion_control import IDLE_TOPIC_SECONDS, MAX_ZERO_TEMPLATE, MotionControl
from robot_client.motion.motion_topics import MAX_TOPICS
from robot_client.motion.rules import MotionRules
from robot_client.motion.typed_topic import TypedTopic
from robot_client.motion.watchdog import DAEMON_SHARE, STOP_ZEROS, CommandTimes
from tests.worlds.memory_platform import TWIST, MemoryPlatform, twist

GO = twist(1.0)
ZERO = twist()
DRIVER = 7
"""The source that holds control."""
STAMPED = "geometry_msgs/msg/TwistStamped"
JOY = "sensor_msgs/msg/Joy"


class RecordingGuard:
    """Records the calls of motion control."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, object]] = []
        self.topics: set[TypedTopic] = set()
        self.able = True

    def add_topic(self, topic: TypedTopic) -> None:
        self.topics.add(topic)
        self.lines.append((topic.name, topic.type))

    def forget(self, topic: TypedTopic) -> None:
        self.topics.discard(topic)

    def set_zero_template(self, topic: TypedTopic, zero_template: bytes) -> None:
        self.lines.append((topic.name, zero_template))

    def note_command(self, topic: TypedTopic, moving: bool, at: int) -> None:
        self.lines.append((topic.name, moving))

    def ready(self, topic: TypedTopic) -> bool:
        return self.able


class Scene:
    def __init__(self, rules: MotionRules | None = None, deadline_ms: int = 500) -> None:
        self.clock = Clock()
        self.clock.advance(100)
        self.platform = MemoryPlatform()
        self.guard = RecordingGuard()
        self.authority = Authority()
        self.authority.grant_control(DRIVER, "ann", "operator", 0)
        policy = MotionPolicy(types=[TWIST], deadline_ms=deadline_ms)
        self.motion = MotionControl(
            policy, self.platform, self.clock, self.now, self.guard, self.authority, rules
        )
        self.offset = ClockOffset()
        self.offset.add(self.now(), self.now(), self.now())
        self.open("a")

    def now(self) -> int:
        return round(self.clock.seconds() * 1e9)

    def open(self, publication_id: str, topic: str = "/cmd_vel", type: str = TWIST) -> None:
        self.motion.open(
            publication_id, TypedTopic(topic, type), self.platform.advertise(topic, type, False, None)
        )

    def command(self, body: bytes, source: str = "a", age: float = 0.0, by: int = DRIVER) -> bool:
        return self.motion.command(source, body, self.now() - int(age * 1e9), self.offset, by)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 100)):
            self.clock.advance(0.01)

    @property
    def sent(self) -> list[bytes]:
        return [body for _, body in self.platform.published]


def speeds(scene: Scene) -> list[float]:
    """Linear speeds along x of all published commands."""
    return [struct.unpack_from("<d", body, 4)[0] for body in scene.sent]


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_zero_is_published_when_commands_end(scene: Scene) -> None:
    """400 ms after the last command, five times; counted once."""
    scene.command(GO)
    scene.clock.advance(0.399)
    assert scene.sent == [GO]
    scene.clock.advance(0.002)
    assert scene.sent == [GO, ZERO]
    for _ in range(20):
        scene.clock.advance(0.01)
    assert scene.sent == [GO] + STOP_ZEROS * [ZERO]
    scene.clock.advance(10)
    assert scene.sent == [GO] + STOP_ZEROS * [ZERO]
    assert scene.motion.watchdog_stops == 1


def test_no_zero_while_commands_arrive(scene: Scene) -> None:
    for _ in range(20):
        scene.command(GO)
        scene.clock.advance(0.3)
    assert ZERO not in scene.sent


def test_stale_commands_are_counted_and_keep_nothing_moving(scene: Scene) -> None:
    scene.command(GO)
    for _ in range(10):
        assert not scene.command(GO, age=0.6)
        scene.clock.advance(0.1)
    assert GO not in scene.sent[1:]
    assert ZERO in scene.sent
    assert scene.motion.stale_commands == 10


def test_overtaken_command_is_dropped(scene: Scene) -> None:
    """Per source and publication; also a movement that arrives after the zero that followed it."""
    scene.command(GO)
    scene.clock.advance(0.2)
    scene.command(ZERO)
    sent = list(scene.sent)
    assert not scene.command(GO, age=0.1)
    assert scene.sent == sent
    assert scene.motion.stale_commands == 1
    assert scene.command(GO)
    assert not scene.command(ZERO, age=0.1)
    scene.open("b", "/other/cmd_vel")
    assert scene.command(GO, "b", age=0.1)


def test_stale_zero_does_not_count_as_release(scene: Scene) -> None:
    """A stalled link delivers it after a resume."""
    scene.command(GO)
    scene.authority.stop(Stopped(by="eve", since=1.0), scene.now())
    scene.authority.resume(scene.now())
    assert not scene.command(ZERO, age=3.0)
    assert not scene.command(GO)
    assert scene.sent == [GO]
    scene.clock.advance(0.01)
    assert scene.command(ZERO)
    assert scene.command(GO)


def test_commands_delayed_through_a_stop_are_refused_after_the_resume() -> None:
    """So are later commands of the stream before a release, also with a long deadline."""
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


def test_stalled_link_does_not_count_as_release() -> None:
    """Commands that arrive too late afterwards show that the stream went on."""
    scene = Scene()
    scene.command(GO)
    scene.authority.stop(Stopped(by="eve", since=1.0), scene.now())
    scene.run(0.1)
    scene.authority.resume(scene.now())
    scene.command(GO)
    scene.run(1.0)
    assert not scene.command(GO, age=0.9)
    assert scene.motion.stale_commands == 0
    assert not scene.command(GO, age=0.1)
    assert scene.sent.count(GO) == 1


def test_stamp_in_the_future_does_not_count_as_release(scene: Scene) -> None:
    scene.authority.stop(Stopped(by="eve", since=1.0), scene.now())
    scene.authority.resume(scene.now())
    assert not scene.command(GO)
    assert not scene.command(GO, age=-3.0)
    scene.run(0.1)
    assert not scene.command(GO)


def test_commanded_zero_needs_no_watchdog(scene: Scene) -> None:
    """It is published five times within 200 ms."""
    scene.command(GO)
    scene.command(ZERO)
    scene.run(0.2)
    assert scene.sent == [GO] + STOP_ZEROS * [ZERO]
    scene.run(2)
    assert scene.sent == [GO] + STOP_ZEROS * [ZERO]
    assert scene.motion.watchdog_stops == 0


def test_invalid_commands_are_not_published(scene: Scene) -> None:
    """NaN, or bytes that are no message of the type."""
    assert not scene.command(twist(float("nan")))
    assert not scene.command(b"\0\1\0\0")
    assert scene.sent == []
    assert scene.motion.invalid_commands == 2


def test_end_of_the_moving_publication_stops_the_topic_at_once(scene: Scene) -> None:
    scene.open("b")
    scene.command(GO, "b")
    scene.motion.close("a")
    assert scene.sent == [GO]
    scene.motion.close("b")
    assert scene.sent == [GO, ZERO]


def test_failure_on_one_topic_does_not_prevent_the_stop_of_others(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene.open("b", "/second")
    scene.command(GO)
    scene.command(GO, "b")

    def broken(body: bytes) -> None:
        raise RuntimeError("middleware is gone")

    monkeypatch.setattr(scene.platform.publishers[0], "publish", broken)
    scene.motion.stop_moving_topics("test")
    assert scene.platform.published[-1] == ("/second", ZERO)


def test_guard_is_notified_of_topic_movement_and_standstill(scene: Scene) -> None:
    scene.command(GO)
    scene.run(1)
    assert scene.guard.lines == [("/cmd_vel", TWIST), ("/cmd_vel", True), ("/cmd_vel", False)]


def test_topics_are_stopped_by_their_own_commands(scene: Scene) -> None:
    scene.open("b", "/second")
    scene.command(GO, "b")
    scene.clock.advance(0.3)
    scene.command(GO)
    scene.clock.advance(0.15)
    assert scene.platform.published[2:] == [("/second", ZERO)]


def test_commands_are_dropped_until_the_guard_is_ready(scene: Scene) -> None:
    """They are counted; zero always passes."""
    scene.guard.able = False
    assert not scene.command(GO)
    assert scene.command(ZERO)
    assert scene.motion.unguarded_commands == 1
    scene.guard.able = True
    assert scene.command(GO)
    assert scene.sent == [ZERO, GO]


def test_new_command_ends_the_repetition_of_zero(scene: Scene) -> None:
    scene.command(GO)
    scene.command(ZERO)
    scene.run(0.05)
    scene.command(GO)
    scene.run(0.3)
    assert scene.sent == [GO, ZERO, ZERO, GO]


def test_zero_is_repeated_only_after_movement(scene: Scene) -> None:
    scene.command(ZERO)
    scene.run(1)
    assert scene.sent == [ZERO]


def test_guard_counts_the_robot_as_moving_until_the_last_zero(scene: Scene) -> None:
    """It would stop the robot if the daemon died now."""
    scene.command(GO)
    scene.command(ZERO)
    scene.run(0.15)
    assert scene.guard.lines[-1] == ("/cmd_vel", True)
    scene.run(0.02)
    assert len(scene.sent) == 1 + STOP_ZEROS
    assert scene.guard.lines[-1] == ("/cmd_vel", False)


def test_publisher_of_an_ended_publication_closes_after_the_last_zero(scene: Scene) -> None:
    scene.command(GO)
    scene.motion.close("a")
    scene.run(0.15)
    assert len(scene.platform.publishers) == 1
    scene.run(0.02)
    assert scene.platform.publishers == []
    assert scene.sent == [GO] + STOP_ZEROS * [ZERO]


def test_publisher_closes_at_once_if_it_moved_nothing(scene: Scene) -> None:
    scene.motion.close("a")
    assert scene.platform.publishers == []


def test_all_zeros_published_fires_after_the_last_zero(scene: Scene) -> None:
    said: list[None] = []
    scene.command(GO)
    scene.motion.stop_moving_topics("test")
    scene.motion.all_zeros_published().addCallback(said.append)
    scene.run(0.15)
    assert said == []
    scene.run(0.02)
    assert said == [None]
    scene.motion.all_zeros_published().addCallback(said.append)
    assert len(said) == 2


def test_zero_has_the_type_of_the_command(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The topic was advertised as TwistStamped before."""
    asked: list[str] = []
    honest = scene.platform.zero_command

    def noted(type: str, zero_template: bytes = b"") -> bytes:
        asked.append(type)
        return honest(type, zero_template)

    monkeypatch.setattr(scene.platform, "zero_command", noted)
    scene.open("stamped", "/base", STAMPED)
    scene.open("plain", "/base", TWIST)
    scene.command(GO, "plain")
    scene.run(1)
    assert set(asked) == {TWIST}
    assert ("/base", STAMPED) in scene.guard.lines
    assert ("/base", TWIST) in scene.guard.lines


def test_guard_forgets_a_topic_30_s_after_its_last_publication(scene: Scene) -> None:
    scene.motion.close("a")
    scene.clock.advance(IDLE_TOPIC_SECONDS - 1)
    assert len(scene.guard.topics) == 1
    scene.clock.advance(1)
    assert scene.guard.topics == set()
    assert scene.clock.getDelayedCalls() == []


def test_topic_that_is_commanded_again_in_time_stays_guarded(scene: Scene) -> None:
    scene.motion.close("a")
    scene.clock.advance(IDLE_TOPIC_SECONDS - 1)
    scene.open("b")
    scene.clock.advance(IDLE_TOPIC_SECONDS)
    assert len(scene.guard.topics) == 1
    assert scene.command(GO, "b")


def test_idle_topic_is_forgotten_when_advertised_with_another_type(scene: Scene) -> None:
    scene.open("wrong", "/base", STAMPED)
    scene.motion.close("wrong")
    scene.open("right", "/base", TWIST)
    assert TypedTopic("/base", STAMPED) not in scene.guard.topics
    assert TypedTopic("/base", TWIST) in scene.guard.topics


def test_guard_covers_at_most_64_topics(scene: Scene) -> None:
    """However many are opened and closed, or stay open."""
    for number in range(3 * MAX_TOPICS):
        scene.open("cycle", f"/t{number}")
        scene.motion.close("cycle")
        assert len(scene.guard.topics) <= MAX_TOPICS
    for number in range(3 * MAX_TOPICS):
        scene.open(str(number), f"/u{number}")
        assert len(scene.guard.topics) <= MAX_TOPICS


# --- places ------------------------------------------------------------------------------------------------

CMD_VEL = TypedTopic("/cmd_vel", TWIST)


def fill_topics(scene: Scene, moving: bool = False) -> None:
    """Open as many topics as the guard covers."""
    for number in range(MAX_TOPICS):
        source = f"topic{number}"
        scene.open(source, f"/topic{number}")
        assert scene.command(GO, source, by=DRIVER if moving else DRIVER + 1) == moving


def test_advertised_topic_does_not_evict_a_commanded_one(scene: Scene) -> None:
    scene.command(GO)
    scene.command(ZERO)
    scene.run(1)
    fill_topics(scene)
    fill_topics(scene)
    assert CMD_VEL in scene.guard.topics
    assert scene.command(GO)
    fill_topics(scene)
    assert CMD_VEL in scene.guard.topics


def test_new_topic_evicts_one_that_was_never_commanded(scene: Scene) -> None:
    fill_topics(scene)
    scene.open("b", "/base")
    assert TypedTopic("/base", TWIST) in scene.guard.topics
    assert scene.command(GO, "b")


def test_evicted_topic_is_guarded_again_with_its_first_allowed_command(scene: Scene) -> None:
    """It moves when the guard is ready for it."""
    fill_topics(scene)
    assert CMD_VEL not in scene.guard.topics
    assert not scene.command(GO, by=DRIVER + 1)
    assert CMD_VEL not in scene.guard.topics
    scene.guard.able = False
    assert not scene.command(GO)
    assert CMD_VEL in scene.guard.topics
    fill_topics(scene)
    scene.guard.able = True
    assert scene.command(GO)
    scene.run(1)
    assert scene.sent == [GO] + [ZERO] * STOP_ZEROS


def test_topic_with_the_oldest_command_is_evicted(scene: Scene) -> None:
    scene.command(ZERO)
    for number in range(MAX_TOPICS):
        scene.run(0.01)
        scene.open(str(number), f"/t{number}")
        scene.command(ZERO, str(number))
        if number == 0:
            scene.run(0.01)
            scene.command(ZERO)
    assert CMD_VEL in scene.guard.topics
    assert TypedTopic("/t0", TWIST) not in scene.guard.topics


def test_moving_topics_are_not_evicted(scene: Scene) -> None:
    """While all move, no topic is added; others can only be commanded zero."""
    fill_topics(scene, moving=True)
    assert CMD_VEL not in scene.guard.topics
    with pytest.raises(Unavailable, match="64 topics move the robot"):
        scene.open("more", "/more")
    assert not scene.command(GO)
    assert scene.motion.unguarded_commands == 1
    assert scene.command(ZERO)
    assert scene.platform.published[-1] == ("/cmd_vel", ZERO)
    scene.motion.close("topic7")
    scene.run(0.2)
    assert scene.command(GO)


def test_publisher_of_an_evicted_topic_closes_with_its_publication(scene: Scene) -> None:
    fill_topics(scene)
    scene.motion.close("a")
    assert len(scene.platform.publishers) == MAX_TOPICS


def test_topic_stays_guarded_until_its_last_publication_ends(scene: Scene) -> None:
    scene.open("b")
    fill_topics(scene)
    assert CMD_VEL not in scene.guard.topics
    scene.open("c")
    scene.motion.close("c")
    scene.clock.advance(IDLE_TOPIC_SECONDS + 1)
    assert CMD_VEL in scene.guard.topics
    assert scene.command(GO)
    scene.run(1)
    scene.motion.close("a")
    scene.clock.advance(IDLE_TOPIC_SECONDS + 1)
    assert CMD_VEL in scene.guard.topics
    scene.motion.close("b")
    scene.clock.advance(IDLE_TOPIC_SECONDS + 1)
    assert CMD_VEL not in scene.guard.topics


# --- limits, shapes, times of single topics ----------------------------------------------------------------


def test_commands_are_limited_by_the_level_of_the_holder() -> None:
    """The level of a suppressing source is unknown, so the strictest limits hold."""
    scene = Scene(MotionRules(limits={"operator": Limits(linear=0.5), "owner": Limits(linear=0.8)}))
    scene.command(GO)
    scene.authority.grant_control(DRIVER, "ann", "owner", scene.now())
    scene.command(GO)
    scene.authority.suppress("/cmd_vel", Suppression(frozenset({8}), scene.now() + 10**9, "eve"))
    scene.command(GO, by=8)
    assert scene.sent == [twist(0.5), twist(0.8), twist(0.5)]
    assert scene.motion.limited_commands == 3


def test_acceleration_counts_from_the_last_zero() -> None:
    """Whether a command or the watchdog published it."""
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


def test_command_without_readable_speed_is_invalid_under_limits() -> None:
    scene = Scene(MotionRules(limits={"operator": Limits(linear=0.5)}))
    assert scene.command(b"\0\7" + GO[2:]) is False
    assert scene.sent == []
    assert scene.motion.invalid_commands == 1


def test_types_without_speeds_are_refused_under_limits() -> None:
    """An alert is raised; zero passes, and so do commands of a level without limits."""
    scene = Scene(MotionRules(limits={"operator": Limits(linear=0.5)}))
    refusals: list[tuple[str, str]] = []
    scene.motion.on_unreadable = lambda topic, level: refusals.append((topic.name, level))
    scene.open("pad", "/joy", JOY)
    assert scene.command(GO, "pad") is False
    assert scene.command(ZERO, "pad")
    assert (refusals, scene.authority.refused, scene.motion.invalid_commands) == (
        [("/joy", "operator")],
        1,
        0,
    )
    scene.authority.grant_control(DRIVER, "ann", "owner", scene.now())
    assert scene.command(GO, "pad")
    scene.authority.suppress("/joy", Suppression(frozenset({8}), scene.now() + 10**9, "eve"))
    assert scene.command(GO, "pad", by=8) is False
    assert refusals[1:] == [("/joy", "")]
    assert scene.sent == [ZERO, GO]


def test_exempt_topics_pass_without_speeds() -> None:
    scene = Scene(MotionRules(limits={"operator": Limits(linear=0.5)}, unlimited=["/joy"]))
    scene.open("pad", "/joy", JOY)
    assert scene.command(GO, "pad")
    assert scene.sent == [GO]


def test_topic_that_no_level_may_command_can_not_be_advertised() -> None:
    """The error names the remedy."""
    scene = Scene(MotionRules(limits={"operator": Limits(linear=0.5), "owner": Limits(linear=0.8)}))
    with pytest.raises(
        Refused, match=r"sensor_msgs/msg/Joy on /joy .* 'unlimited' of the robot's \[limits\]"
    ):
        scene.open("pad", "/joy", JOY)
    assert TypedTopic("/joy", JOY) not in scene.guard.topics


def test_zero_has_the_shape_of_the_command(scene: Scene) -> None:
    """The guard gets the zero template before the command, and again when it changes."""
    scene.platform.zero_templates[TWIST] = b"two axes"
    scene.command(GO)
    scene.command(GO)
    assert scene.guard.lines[1:] == [("/cmd_vel", b"two axes"), ("/cmd_vel", True), ("/cmd_vel", True)]
    scene.motion.stop_moving_topics("test")
    assert scene.sent[-1] == b"two axes"


def test_command_with_too_large_a_zero_template_is_invalid(scene: Scene) -> None:
    scene.platform.zero_templates[TWIST] = bytes(MAX_ZERO_TEMPLATE + 1)
    assert scene.command(GO) is False
    assert (scene.sent, scene.motion.invalid_commands) == ([], 1)


def test_topic_with_times_of_its_own() -> None:
    """Deadline and time to stop are shorter than those of other topics."""
    scene = Scene(MotionRules(topics={"/arm": CommandTimes(200, 100)}))
    scene.open("arm", "/arm")
    assert scene.command(GO, "arm", age=0.15) is False
    assert scene.command(GO, "a", age=0.15)
    scene.command(GO, "arm")
    scene.run(0.2 * DAEMON_SHARE + 0.01)
    assert scene.platform.published[-1] == ("/arm", ZERO)
    assert ("/cmd_vel", ZERO) not in scene.platform.published


# --- links in one direction ------------------------------------------------------------------------------


def test_command_counts_until_it_is_too_old(scene: Scene) -> None:
    """One that arrived late ends sooner."""
    assert scene.command(GO, age=0.3)
    scene.run(0.14)
    assert scene.sent == [GO]
    scene.run(0.02)
    assert scene.sent[-1] == ZERO
    assert scene.motion.watchdog_stops == 1


def test_commands_end_without_proof_of_the_link(scene: Scene) -> None:
    """The relay answers no ping, so the client may receive nothing."""
    proof = scene.now()
    scene.motion.link_proven_at = lambda: proof
    passed = []
    for _ in range(60):
        passed.append(scene.command(GO))
        scene.run(0.01)
    assert passed == [True] * 45 + [False] * 15
    assert scene.sent[45:47] == [ZERO, ZERO]
    assert scene.motion.stale_commands == 15
    scene.motion.link_proven_at = scene.now
    assert scene.command(GO)


def test_longer_deadline_allows_an_older_proof_of_the_link() -> None:
    scene = Scene(deadline_ms=1000)
    proof = scene.now()
    scene.motion.link_proven_at = lambda: proof
    scene.run(0.8)
    assert scene.command(GO)
    scene.run(0.11)
    assert scene.sent[-1] == ZERO


def test_proof_of_the_link_counts_by_the_times_of_the_topic() -> None:
    """The longer of the topic's own times."""
    scene = Scene(MotionRules(topics={"/arm": CommandTimes(200, 100)}))
    scene.open("arm", "/arm")
    proof = scene.now()
    scene.motion.link_proven_at = lambda: proof
    passed = []
    for _ in range(25):
        passed.append((scene.command(GO, "arm"), scene.command(GO)))
        scene.run(0.01)
    assert passed == [(True, True)] * 18 + [(False, True)] * 7
    stopped = [topic for topic, body in scene.platform.published if body == ZERO]
    assert set(stopped) == {"/arm"}
    assert scene.motion.stale_commands == 7


def test_first_and_last_motion_input_are_reported(scene: Scene) -> None:
    changes: list[bool] = []
    scene.motion.on_motion_inputs_changed = changes.append
    scene.open("b")
    scene.motion.close("a")
    scene.motion.close("b")
    scene.motion.close("b")
    assert changes == [True, False]


# --- ramps -------------------------------------------------------------------------------------------------


def ramping() -> Scene:
    return Scene(MotionRules(ramp_ms=200))


def test_ramp_begins_earlier_and_ends_in_time() -> None:
    """Its zero is published when a watchdog without a ramp would publish its own."""
    scene = ramping()
    scene.command(GO)
    scene.run(0.2)
    assert speeds(scene) == [1.0]
    assert scene.motion.moving
    scene.run(0.19)
    slowing = speeds(scene)[1:]
    assert len(slowing) >= 5
    assert all(earlier > later > 0 for earlier, later in itertools.pairwise(slowing))
    assert scene.motion.moving
    scene.run(0.02)
    assert scene.sent[-1] == ZERO
    assert not scene.motion.moving
    scene.run(1)
    assert speeds(scene).count(0.0) == STOP_ZEROS
    assert scene.motion.watchdog_stops == 1
    assert scene.guard.lines[-1] == ("/cmd_vel", False)


def test_a_new_command_ends_a_ramp() -> None:
    """Zero too."""
    scene = ramping()
    scene.command(GO)
    scene.run(0.3)
    scene.command(twist(0.7))
    assert speeds(scene)[-1] == 0.7
    scene.run(0.3)
    assert 0.0 < speeds(scene)[-1] < 0.7
    scene.command(ZERO)
    scene.run(1)
    assert speeds(scene)[-STOP_ZEROS:] == [0.0] * STOP_ZEROS
    assert speeds(scene).count(0.0) == STOP_ZEROS


def test_acceleration_counts_from_the_speed_of_the_ramp() -> None:
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
    """It also ends an active ramp."""
    scene = ramping()
    scene.command(GO)
    scene.motion.zero_commanded_topics("test")
    assert scene.sent == [GO, ZERO]
    scene.run(1)
    scene.command(GO)
    scene.run(0.3)
    scene.motion.close("a")
    before = len(scene.sent)
    assert speeds(scene)[-1] > 0
    scene.motion.zero_commanded_topics("test")
    assert scene.sent[before:] == [ZERO]
    scene.run(1)
    assert scene.sent[before:] == [ZERO] * STOP_ZEROS
    assert scene.platform.publishers == []


def fail_once(scene: Scene, monkeypatch: pytest.MonkeyPatch, topic: int = 0) -> None:
    """Make the next message of a publisher fail."""
    sink = scene.platform.publishers[topic]
    honest = sink.publish

    def broken(body: bytes) -> None:
        monkeypatch.setattr(sink, "publish", honest)
        raise RuntimeError("middleware is busy")

    monkeypatch.setattr(sink, "publish", broken)


def halted(scene: Scene) -> None:
    assert scene.motion.zero_commanded_topics("test") == ["/cmd_vel"]


def suppressed(scene: Scene) -> None:
    scene.authority.suppress("/cmd_vel", Suppression(frozenset({8}), scene.now() + 10**9, "eve"))
    scene.motion.stop_unless_allowed("/cmd_vel", "test")


def said_zero(scene: Scene) -> None:
    with pytest.raises(RuntimeError):
        scene.command(ZERO)


@pytest.mark.parametrize("stop", [halted, suppressed, said_zero])
def test_failed_zero_ends_a_ramp_and_is_repeated(
    monkeypatch: pytest.MonkeyPatch, stop: Callable[[Scene], None]
) -> None:
    """By a stop, a suppression or a command of zero."""
    scene = ramping()
    scene.command(GO)
    scene.run(0.3)
    before = len(scene.sent)
    assert 0.0 < speeds(scene)[-1] < 1.0
    fail_once(scene, monkeypatch)
    stop(scene)
    assert not scene.motion.moving
    scene.run(1)
    assert scene.sent[before:] == [ZERO] * (STOP_ZEROS - 1)
    assert scene.guard.lines[-1] == ("/cmd_vel", False)


def test_failed_zero_is_repeated(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Any of the five; the publisher of an ended publication stays open for it."""
    scene.command(GO)
    fail_once(scene, monkeypatch)
    scene.motion.close("a")
    assert scene.sent == [GO]
    scene.run(0.05)
    fail_once(scene, monkeypatch)
    scene.run(1)
    assert scene.sent == [GO] + [ZERO] * (STOP_ZEROS - 2)
    assert scene.platform.publishers == []
    assert scene.guard.lines[-1] == ("/cmd_vel", False)


def test_guard_counts_a_topic_as_moving_when_no_zero_could_be_published(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[bytes] = []

    def broken(body: bytes) -> None:
        tried.append(body)
        raise RuntimeError("middleware is gone")

    scene.command(GO)
    monkeypatch.setattr(scene.platform.publishers[0], "publish", broken)
    scene.motion.zero_commanded_topics("test")
    scene.run(1)
    assert tried == [ZERO] * STOP_ZEROS
    assert scene.guard.lines[-1] == ("/cmd_vel", True)


def test_a_ramp_ends_in_time_however_late_it_begins() -> None:
    """A publication that ends long after its last command gets a shorter ramp, or none."""
    scene = ramping()
    scene.command(GO)
    scene.run(0.15)
    scene.motion.close("a")
    scene.run(0.19)
    assert 0.0 < speeds(scene)[-1] < 1.0
    scene.run(0.02)
    assert scene.sent[-1] == ZERO
    scene.run(1)
    assert scene.platform.publishers == []
    late = Scene(MotionRules(ramp_ms=200))
    late.command(GO)
    late.clock.pump([0.0])
    late.clock.rightNow += 0.39  # the process was delayed: its watchdog has not run yet
    late.motion.close("a")
    assert late.sent == [GO, ZERO]


def test_ramps_ended_fires_after_the_ramp() -> None:
    """With the topics whose ramp failed."""
    scene, stood = ramping(), []
    scene.motion.ramps_ended().addCallback(stood.append)
    assert stood == [[]]
    scene.command(GO)
    scene.motion.stop_moving_topics("control changes", gently=True)
    scene.motion.ramps_ended().addCallback(stood.append)
    scene.run(0.19)
    assert stood == [[]]
    scene.run(0.02)
    assert stood == [[], []]


def test_ramp_that_can_not_end_in_zero_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the topic's name; the guard still counts it as moving."""
    scene, stood = ramping(), []
    scene.command(GO)
    scene.motion.stop_moving_topics("control changes", gently=True)
    scene.motion.ramps_ended().addCallback(stood.append)

    def broken(body: bytes) -> None:
        raise RuntimeError("no middleware")

    monkeypatch.setattr(scene.platform.publishers[0], "publish", broken)
    scene.run(1)
    assert stood == [["/cmd_vel"]]
    assert scene.guard.lines[-1] == ("/cmd_vel", True)


def test_suppression_stops_the_topic_without_a_ramp() -> None:
    scene = ramping()
    scene.command(GO)
    scene.run(0.3)
    assert speeds(scene)[-1] < 1.0
    scene.authority.suppress("/cmd_vel", Suppression(frozenset({8}), scene.now() + 10**9, "eve"))
    scene.motion.stop_unless_allowed("/cmd_vel", "test")
    assert scene.sent[-1] == ZERO


def test_topic_without_speeds_is_stopped_without_a_ramp() -> None:
    """When a ramp would have begun."""
    scene = Scene(MotionRules(ramp_ms=200))
    scene.open("arm", "/arm", "some/msg/Type")
    scene.command(GO, "arm")
    scene.run(0.21)
    assert scene.platform.published == [("/arm", GO), ("/arm", ZERO)]
