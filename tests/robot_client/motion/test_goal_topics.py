"""Topics on which one message starts motion, through the whole daemon."""

from __future__ import annotations

import pytest

from relay_protocol import frames, link
from robot_client.motion.motion_control import MOTION_QOS
from robot_client.platforms.base import GraphView
from tests.worlds.memory_platform import TWIST, twist
from tests.worlds.robot_daemon import DRIVER, RelayEnd, Scene

POSE = "geometry_msgs/msg/PoseStamped"
GOAL = twist(1.0)
"""The platform in memory knows no poses; it is enough that this makes sense to it."""


class Goals:
    """A driver who may publish goals.

    :param answers: as of :class:`Scene`
    """

    def __init__(self, topic: str = "/robot1/goal_pose", answers: bool = True) -> None:
        self.scene = Scene(answers=answers)
        self.topic = topic
        self.control = self.scene.register()
        self.control.send(link.ControlGrant(id=1, holder=DRIVER, user="ann", level="operator"))
        self.channel: RelayEnd = self.scene.channel(self.control)
        self.channel.received()
        if answers:
            self.advertise()

    def advertise(self) -> None:
        self.channel.send(link.Advertise(number=5, topic=self.topic, type=POSE, latch=True, queue_size=9))
        self.advertised = [each for each in self.channel.received() if each["op"] == "advertised"]

    def heard(self) -> list[bytes]:
        return [body for topic, body in self.scene.platform.published if topic == self.topic]

    def send(self, source: int = DRIVER, body: bytes = GOAL, age: float = 0.0) -> int:
        """Publish a goal; return how many messages the robot got."""
        stamp = self.scene.now() - round(age * 1e9)
        self.channel.protocol.dataReceived(frames.encode_command(5, stamp, source, body))
        return len(self.heard())


@pytest.fixture
def goals() -> Goals:
    return Goals()


@pytest.mark.parametrize("topic", ["/goal_update", "/robot1/goals_update"])
def test_topics_that_change_an_active_goal_need_control(topic: str) -> None:
    goals = Goals(topic)
    assert goals.advertised[0]["motion"] is True
    assert goals.send(DRIVER + 1) == 0
    assert goals.send() == 1


def test_goal_topic_takes_commands_of_the_holder_only(goals: Goals) -> None:
    """It is reported as a motion topic."""
    assert goals.advertised[0]["motion"] is True
    assert goals.send(DRIVER + 1) == 0
    assert goals.send(0) == 0
    goals.channel.protocol.dataReceived(frames.encode_sample(5, goals.scene.now(), GOAL))
    assert goals.heard() == []
    assert goals.scene.daemon.authority.refused == 3
    assert goals.send() == 1


def test_goal_is_refused_while_the_robot_is_stopped(goals: Goals) -> None:
    """It passes if it is sent again after the resume."""
    goals.control.send(link.Stop(id=2, by="eve"))
    assert goals.send() == 0
    goals.scene.run(2.0)
    goals.control.send(link.Resume(id=3, by="eve"))
    goals.scene.run(1.0)
    assert goals.heard() == []
    assert goals.send() == 1


def test_goal_is_refused_while_others_suppress_a_topic(goals: Goals) -> None:
    """One that waited for the proof of the link is judged again."""
    goals.scene.platform.view = GraphView(topics={"/cmd_vel": link.Topic(types=[TWIST])})
    goals.scene.run(1.0)
    goals.control.send(link.Suppress(id=2, resource="/cmd_vel", sources=[DRIVER + 1], ms=200, by="eve"))
    assert goals.send() == 0
    assert goals.scene.daemon.authority.refused == 1
    goals.scene.run(0.3)
    assert goals.send() == 1


def test_zero_is_never_published_on_a_goal_topic(goals: Goals) -> None:
    """It would be a goal."""
    goals.scene.platform.view = GraphView(
        topics={goals.topic: link.Topic(types=[POSE], subscribers=["/planner"])}
    )
    assert goals.send() == 1
    goals.scene.run(2.0)
    goals.control.send(link.Stop(id=2, by="eve"))
    goals.scene.run(2.0)
    goals.channel.lose()
    goals.scene.daemon.stop()
    goals.scene.run(1.0)
    assert goals.heard() == [GOAL]


@pytest.mark.parametrize("age", [0.6, 60.0, -0.6])
def test_stale_goals_are_dropped_and_counted(goals: Goals, age: float) -> None:
    assert goals.send(age=age) == 0
    assert goals.scene.daemon.motion.stale_commands == 1


def test_invalid_goals_are_dropped_and_counted(goals: Goals) -> None:
    assert goals.send(body=twist(float("nan"))) == 0
    assert goals.scene.daemon.motion.invalid_commands == 1


def test_goal_topic_is_not_latched(goals: Goals) -> None:
    """A node that starts later would start motion, whatever the client requested."""
    (sink,) = goals.scene.platform.publishers
    assert (sink.latch, sink.qos, sink.queue_size) == (False, MOTION_QOS, 0)


def test_described_policy_includes_goal_topics() -> None:
    control = Scene().register()
    (described,) = [each for each in control.received() if each.get("op") == "describe"]
    assert "*/goal_pose" in described["motion"]["topics"]


def test_other_topics_are_not_goal_topics() -> None:
    other = Goals("/initialpose")
    assert not other.advertised[0].get("motion", False)
    other.channel.protocol.dataReceived(frames.encode_sample(5, 0, GOAL))
    assert other.heard() == [GOAL]


# --- a relay that takes its time ---------------------------------------------------------------------------

WAY = 0.02
"""Seconds between a ping and its answer."""


class Paced(Goals):
    """A daemon whose relay answers pings on request of the test."""

    def __init__(self) -> None:
        super().__init__(answers=False)
        self.deaf = False
        self.pings = 0
        self._due: list[tuple[float, RelayEnd, int]] = []
        self.live(3.0)

    def live(self, seconds: float) -> None:
        """Lets time pass in steps of 10 ms."""
        for _ in range(round(seconds * 100)):
            self.scene.clock.advance(0.01)
            now = self.scene.clock.seconds()
            for line in (self.control, self.channel):
                asked = [
                    each["t"] for each in line.received() if isinstance(each, dict) and each["op"] == "ping"
                ]
                self.pings += len(asked) if line is self.control else 0
                if not (self.deaf and line is self.control):
                    self._due += [(now + WAY, line, t) for t in asked]
            for due in [each for each in self._due if each[0] <= now]:
                self._due.remove(due)
                due[1].send(link.Pong(t=due[2], at=self.scene.now()))


@pytest.fixture
def paced() -> Paced:
    return Paced()


def test_goal_passes_however_long_after_the_last_ping(paced: Paced) -> None:
    """The control link is pinged often while goals may be sent."""
    paced.advertise()
    for count in range(1, 41):
        paced.live(0.37)
        assert paced.send() == count
    assert paced.scene.daemon.motion.stale_commands == 0


def test_first_goal_may_arrive_with_the_advertisement(paced: Paced) -> None:
    """It waits for the answer to the first frequent ping."""
    paced.live(0.9)
    paced.advertise()
    assert paced.send() == 0
    paced.live(WAY + 0.02)
    assert paced.heard() == [GOAL]
    paced.live(2.0)
    assert paced.heard() == [GOAL]


def test_link_is_pinged_often_only_while_goals_may_be_published(paced: Paced) -> None:
    counts = []
    for step in (lambda: None, paced.advertise, lambda: paced.channel.send(link.Unadvertise(number=5))):
        step()
        paced.pings = 0
        paced.live(4.0)
        counts.append(paced.pings)
    assert counts[0] <= 4
    assert counts[1] >= 35
    assert counts[2] <= 4


def test_goal_on_a_one_way_link_is_dropped_and_counted_once(paced: Paced) -> None:
    paced.deaf = True
    paced.live(1.0)
    paced.advertise()
    assert paced.send() == 0
    paced.live(0.44)
    assert paced.scene.daemon.motion.stale_commands == 0
    paced.live(0.02)
    assert paced.scene.daemon.motion.stale_commands == 1
    paced.deaf = False
    paced.live(2.0)
    assert paced.heard() == []
    assert paced.scene.daemon.motion.stale_commands == 1
    assert paced.send() == 1


def test_newest_waiting_goal_is_published(paced: Paced) -> None:
    """The one before counts as stale."""
    paced.live(0.9)
    paced.advertise()
    paced.send()
    paced.send(body=twist(2.0))
    paced.live(0.2)
    assert paced.heard() == [twist(2.0)]
    assert paced.scene.daemon.motion.stale_commands == 1


def test_refused_goal_does_not_replace_a_waiting_one(paced: Paced) -> None:
    paced.live(0.9)
    paced.advertise()
    paced.send()
    paced.send(DRIVER + 1, twist(2.0))
    paced.send(body=twist(3.0), age=0.6)
    paced.send(body=twist(float("nan")))
    paced.live(0.2)
    assert paced.heard() == [GOAL]


def test_waiting_goal_is_refused_after_a_stop(paced: Paced) -> None:
    """Also if the robot is resumed before the link is proved."""
    paced.live(0.9)
    paced.advertise()
    paced.send()
    paced.live(0.01)
    authority = paced.scene.daemon.authority
    authority.stop(link.Stopped(by="eve", since=1.0), paced.scene.now())
    authority.resume(paced.scene.now())
    paced.live(2.0)
    assert paced.heard() == []
    assert authority.refused == 1
    assert paced.send() == 1


def test_goal_delayed_through_a_stop_is_refused(goals: Goals) -> None:
    """The channel link was slower than the control link."""
    goals.scene.run(0.1)
    goals.control.send(link.Stop(id=2, by="eve"))
    goals.scene.run(0.2)
    goals.control.send(link.Resume(id=3, by="eve"))
    goals.scene.run(0.1)
    assert goals.send(age=0.4) == 0
    assert goals.scene.daemon.authority.refused == 1
    assert goals.send() == 1


def sends_one_goal(paced: Paced) -> None:
    """As a program that advertises, publishes and unadvertises at once."""
    paced.live(0.9)
    paced.advertise()
    assert paced.send() == 0
    paced.channel.send(link.Unadvertise(number=5))


def test_waiting_goal_is_published_after_unadvertise(paced: Paced) -> None:
    """The publisher ends behind it."""
    sends_one_goal(paced)
    paced.live(WAY + 0.02)
    assert paced.heard() == [GOAL]
    assert paced.scene.platform.publishers == []
    paced.pings = 0
    paced.live(4.0)
    assert paced.pings <= 4


@pytest.mark.parametrize("end", ["lost control", "stop", "lost channel", "the same number again"])
def test_waiting_goal_is_dropped_after_unadvertise(paced: Paced, end: str) -> None:
    sends_one_goal(paced)
    if end == "lost control":
        paced.control.send(link.ControlGrant(id=2, holder=DRIVER + 1, user="bob", level="operator"))
    elif end == "stop":
        paced.control.send(link.Stop(id=2, by="eve"))
    elif end == "lost channel":
        paced.channel.lose()
    else:
        paced.advertise()
    paced.live(2.0)
    assert paced.heard() == []
    assert len(paced.scene.platform.publishers) == (end == "the same number again")


def test_waiting_goal_is_dropped_with_control(paced: Paced) -> None:
    paced.live(0.9)
    paced.advertise()
    paced.send()
    paced.control.send(link.ControlGrant(id=2, holder=DRIVER + 1, user="bob", level="operator"))
    paced.live(2.0)
    assert paced.heard() == []


def test_failure_to_publish_a_goal_does_not_affect_the_next(
    paced: Paced, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(body: bytes) -> None:
        raise RuntimeError("middleware is gone")

    paced.live(0.9)
    paced.advertise()
    with monkeypatch.context() as patched:
        patched.setattr(paced.scene.platform.publishers[0], "publish", broken)
        paced.send()
        paced.live(0.2)
    assert paced.send() == 1
