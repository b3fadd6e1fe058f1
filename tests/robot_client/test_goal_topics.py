"""Topics on which one message sends the robot off, through the whole daemon."""

from __future__ import annotations

import pytest

from relay_protocol import frames, link
from robot_client.motion.motion import MOTION_QOS
from robot_client.platforms.base import GraphView
from robot_client.platforms.memory import TWIST, twist
from tests.robot_client.daemon_scene import DRIVER, Line, Scene

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
        self.control.say(link.Control(id=1, holder=DRIVER, user="ann", level="operator"))
        self.channel: Line = self.scene.channel(self.control)
        self.channel.heard()
        if answers:
            self.advertise()

    def advertise(self) -> None:
        self.channel.say(link.Advertise(number=5, topic=self.topic, type=POSE, latch=True, queue_size=9))
        self.told = [each for each in self.channel.heard() if each["op"] == "advertised"]

    def heard(self) -> list[bytes]:
        return [body for topic, body in self.scene.platform.published if topic == self.topic]

    def say(self, source: int = DRIVER, body: bytes = GOAL, age: float = 0.0) -> int:
        """Publish; how often the robot has heard anything."""
        stamp = self.scene.now() - round(age * 1e9)
        self.channel.protocol.dataReceived(frames.encode_command(5, stamp, source, body))
        return len(self.heard())


@pytest.fixture
def goals() -> Goals:
    return Goals()


@pytest.mark.parametrize("topic", ["/goal_update", "/robot1/goals_update"])
def test_what_bends_a_goal_under_way_is_for_who_holds_control(topic: str) -> None:
    """Nav2 takes it for the goal from then on."""
    goals = Goals(topic)
    assert goals.told[0]["motion"] is True
    assert goals.say(DRIVER + 1) == 0
    assert goals.say() == 1


def test_goals_are_for_who_holds_control(goals: Goals) -> None:
    """The topic is told as motion, and takes the commands of the holder alone."""
    assert goals.told[0]["motion"] is True
    assert goals.say(DRIVER + 1) == 0
    assert goals.say(0) == 0
    goals.channel.protocol.dataReceived(frames.encode_sample(5, goals.scene.now(), GOAL))
    assert goals.heard() == []
    assert goals.scene.daemon.authority.refused == 3
    assert goals.say() == 1


def test_no_goal_passes_while_the_robot_is_stopped(goals: Goals) -> None:
    """It passes again after the resume, if it is given again."""
    goals.control.say(link.Stop(id=2, by="eve"))
    assert goals.say() == 0
    goals.scene.run(2.0)
    goals.control.say(link.Resume(id=3, by="eve"))
    goals.scene.run(1.0)
    assert goals.heard() == []
    assert goals.say() == 1


def test_no_goal_passes_while_others_suppress_a_topic(goals: Goals) -> None:
    """It would drive past the suppression; one that waited for the link to prove itself is judged again."""
    goals.scene.platform.view = GraphView(topics={"/cmd_vel": link.Topic(types=[TWIST])})
    goals.scene.run(1.0)
    goals.control.say(link.Suppress(id=2, resource="/cmd_vel", sources=[DRIVER + 1], ms=200, by="eve"))
    assert goals.say() == 0
    assert goals.scene.daemon.authority.refused == 1
    goals.scene.run(0.3)
    assert goals.say() == 1


def test_nothing_else_is_ever_said_on_a_goal_topic(goals: Goals) -> None:
    """Neither silence nor a stop nor the end of everything says zero there: it would be a goal."""
    goals.scene.platform.view = GraphView(
        topics={goals.topic: link.Topic(types=[POSE], subscribers=["/planner"])}
    )
    assert goals.say() == 1
    goals.scene.run(2.0)
    goals.control.say(link.Stop(id=2, by="eve"))
    goals.scene.run(2.0)
    goals.channel.lose()
    goals.scene.daemon.stop()
    goals.scene.run(1.0)
    assert goals.heard() == [GOAL]


@pytest.mark.parametrize("age", [0.6, 60.0, -0.6])
def test_old_goals_are_dropped_and_counted(goals: Goals, age: float) -> None:
    """No goal that waited somewhere sends the robot off later."""
    assert goals.say(age=age) == 0
    assert goals.scene.daemon.motion.stale_commands == 1


def test_goals_that_make_no_sense_are_dropped_and_counted(goals: Goals) -> None:
    """A number that is none is no place to go to."""
    assert goals.say(body=twist(float("nan"))) == 0
    assert goals.scene.daemon.motion.invalid_commands == 1


def test_goals_are_kept_for_nobody(goals: Goals) -> None:
    """A planner that starts later must not find the goal of before, whatever the client asked for."""
    (sink,) = goals.scene.platform.sinks
    assert (sink.latch, sink.qos, sink.queue_size) == (False, MOTION_QOS, 0)


def test_the_relay_is_told_that_goals_need_control() -> None:
    """What the robot describes has goal topics among those that move it."""
    control = Scene().register()
    (described,) = [each for each in control.heard() if each.get("op") == "describe"]
    assert "*/goal_pose" in described["motion"]["topics"]


def test_other_topics_are_no_goals() -> None:
    """A pose elsewhere is nobody's business."""
    other = Goals("/initialpose")
    assert not other.told[0].get("motion", False)
    other.channel.protocol.dataReceived(frames.encode_sample(5, 0, GOAL))
    assert other.heard() == [GOAL]


# --- a relay that takes its time ---------------------------------------------------------------------------

WAY = 0.02
"""Seconds between a ping and its answer."""


class Paced(Goals):
    """With a relay that answers the pings that come, and when they come."""

    def __init__(self) -> None:
        super().__init__(answers=False)
        self.deaf = False
        self.pings = 0
        self._due: list[tuple[float, Line, int]] = []
        self.live(3.0)

    def live(self, seconds: float) -> None:
        """Time passes, a hundredth at a time."""
        for _ in range(round(seconds * 100)):
            self.scene.clock.advance(0.01)
            now = self.scene.clock.seconds()
            for line in (self.control, self.channel):
                asked = [
                    each["t"] for each in line.heard() if isinstance(each, dict) and each["op"] == "ping"
                ]
                self.pings += len(asked) if line is self.control else 0
                if not (self.deaf and line is self.control):
                    self._due += [(now + WAY, line, t) for t in asked]
            for due in [each for each in self._due if each[0] <= now]:
                self._due.remove(due)
                due[1].say(link.Pong(t=due[2], at=self.scene.now()))


@pytest.fixture
def paced() -> Paced:
    return Paced()


def test_a_goal_is_obeyed_whenever_it_is_given(paced: Paced) -> None:
    """However long after the last ping: the control link proves itself often while goals may come."""
    paced.advertise()
    for count in range(1, 41):
        paced.live(0.37)
        assert paced.say() == count
    assert paced.scene.daemon.motion.stale_commands == 0


def test_the_first_goal_may_come_with_the_topic(paced: Paced) -> None:
    """It waits for the answer to the ping that this begins with: clients advertise and publish in one go."""
    paced.live(0.9)
    paced.advertise()
    assert paced.say() == 0
    paced.live(WAY + 0.02)
    assert paced.heard() == [GOAL]
    paced.live(2.0)
    assert paced.heard() == [GOAL]


def test_the_link_proves_itself_often_only_while_goals_may_come(paced: Paced) -> None:
    """Ten times a second, and as agreed when nobody may publish any."""
    counts = []
    for step in (lambda: None, paced.advertise, lambda: paced.channel.say(link.Unadvertise(number=5))):
        step()
        paced.pings = 0
        paced.live(4.0)
        counts.append(paced.pings)
    assert counts[0] <= 4
    assert counts[1] >= 35
    assert counts[2] <= 4


def test_a_goal_on_a_link_that_works_one_way_is_dropped_and_counted(paced: Paced) -> None:
    """Once, and it never comes: neither when it has grown too old, nor when the link works again."""
    paced.deaf = True
    paced.live(1.0)
    paced.advertise()
    assert paced.say() == 0
    paced.live(0.44)
    assert paced.scene.daemon.motion.stale_commands == 0
    paced.live(0.02)
    assert paced.scene.daemon.motion.stale_commands == 1
    paced.deaf = False
    paced.live(2.0)
    assert paced.heard() == []
    assert paced.scene.daemon.motion.stale_commands == 1
    assert paced.say() == 1


def test_of_goals_that_wait_the_newest_goes(paced: Paced) -> None:
    """The one before is counted as if it had come too late."""
    paced.live(0.9)
    paced.advertise()
    paced.say()
    paced.say(body=twist(2.0))
    paced.live(0.2)
    assert paced.heard() == [twist(2.0)]
    assert paced.scene.daemon.motion.stale_commands == 1


def test_what_must_not_be_published_takes_the_place_of_no_goal(paced: Paced) -> None:
    """Neither what comes from somebody else nor what is too old or makes no sense."""
    paced.live(0.9)
    paced.advertise()
    paced.say()
    paced.say(DRIVER + 1, twist(2.0))
    paced.say(body=twist(3.0), age=0.6)
    paced.say(body=twist(float("nan")))
    paced.live(0.2)
    assert paced.heard() == [GOAL]


def test_a_goal_that_waits_does_not_outlast_a_stop(paced: Paced) -> None:
    """Though the robot is resumed before the link has proved itself: a resume moves nothing."""
    paced.live(0.9)
    paced.advertise()
    paced.say()
    paced.live(0.01)
    authority = paced.scene.daemon.authority
    authority.stop(link.Stopped(by="eve", since=1.0), paced.scene.now())
    authority.resume(paced.scene.now())
    paced.live(2.0)
    assert paced.heard() == []
    assert authority.refused == 1
    assert paced.say() == 1


def test_a_goal_that_was_held_up_does_not_outlast_a_stop(goals: Goals) -> None:
    """The channel's link was slower than the one by which the robot was stopped, and resumed."""
    goals.scene.run(0.1)
    goals.control.say(link.Stop(id=2, by="eve"))
    goals.scene.run(0.2)
    goals.control.say(link.Resume(id=3, by="eve"))
    goals.scene.run(0.1)
    assert goals.say(age=0.4) == 0
    assert goals.scene.daemon.authority.refused == 1
    assert goals.say() == 1


def test_a_goal_that_waits_does_not_outlast_its_publication(paced: Paced) -> None:
    """Nor the control of who gave it."""
    paced.live(0.9)
    paced.advertise()
    paced.say()
    paced.channel.say(link.Unadvertise(number=5))
    paced.live(0.9)
    paced.advertise()
    paced.say()
    paced.control.say(link.Control(id=2, holder=DRIVER + 1, user="bob", level="operator"))
    paced.live(2.0)
    assert paced.heard() == []


def test_a_goal_that_can_not_be_published_keeps_nobody_from_the_next(
    paced: Paced, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though it had waited, and nobody was there to catch the error."""

    def broken(body: bytes) -> None:
        raise RuntimeError("middleware is gone")

    paced.live(0.9)
    paced.advertise()
    with monkeypatch.context() as patched:
        patched.setattr(paced.scene.platform.sinks[0], "publish", broken)
        paced.say()
        paced.live(0.2)
    assert paced.say() == 1
