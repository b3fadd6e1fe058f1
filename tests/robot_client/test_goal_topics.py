"""Topics on which one message sends the robot off, through the whole daemon."""

from __future__ import annotations

import pytest

from relay_protocol import frames, link
from robot_client.motion import MOTION_QOS
from robot_client.platforms.base import GraphView
from robot_client.platforms.memory import twist
from tests.robot_client.daemon_scene import DRIVER, Line, Scene

POSE = "geometry_msgs/msg/PoseStamped"
GOAL = twist(1.0)
"""The platform in memory knows no poses; it is enough that this makes sense to it."""


class Goals:
    """A driver who may publish goals."""

    def __init__(self, topic: str = "/robot1/goal_pose") -> None:
        self.scene = Scene()
        self.topic = topic
        self.control = self.scene.register()
        self.control.say(link.Control(id=1, holder=DRIVER, user="ann", level="operator"))
        self.channel: Line = self.scene.channel(self.control)
        self.channel.heard()
        self.channel.say(link.Advertise(number=5, topic=topic, type=POSE, latch=True, queue_size=9))
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
