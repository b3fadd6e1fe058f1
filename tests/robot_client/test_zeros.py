"""Zero after a stop, on what other nodes may move as well."""

from __future__ import annotations

import pytest
from twisted.internet.task import Clock

from relay_protocol import link
from relay_protocol.link import MotionPolicy
from robot_client.motion.zero_publisher import EVERY, MAX_TOPICS, TIMES, ZeroPublisher
from robot_client.platforms.base import GraphView
from robot_client.platforms.memory import TWIST, MemoryPlatform, twist
from tests.robot_client import daemon_scene

ZERO = twist()
HEARD = link.Topic(types=[TWIST], publishers=["/nav2"], subscribers=["/base"])


class Scene:
    """A graph in which somebody listens to some topics.

    :attr commanded: those that clients may command
    """

    def __init__(self, *topics: str) -> None:
        self.clock = Clock()
        self.platform = MemoryPlatform(GraphView(topics=dict.fromkeys(topics, HEARD)))
        self.commanded: set[str] = set()
        self.zeros = ZeroPublisher(
            MotionPolicy(types=[TWIST]), self.platform, self.clock, lambda topic: topic in self.commanded
        )

    def run(self) -> None:
        for _ in range(2 * TIMES):
            self.clock.advance(EVERY)


@pytest.mark.parametrize("commanded", [True, False])
def test_zero_is_said_for_a_second_whether_clients_command_the_topic_or_not(commanded: bool) -> None:
    """Another node that publishes there is contradicted as long in either case; then the publisher goes."""
    scene = Scene("/cmd_vel")
    scene.commanded = {"/cmd_vel"} if commanded else set()
    scene.zeros.say()
    scene.run()
    assert scene.platform.published == [("/cmd_vel", ZERO)] * TIMES
    assert scene.platform.sinks == []


def test_what_clients_command_comes_first() -> None:
    """Where more topics move the robot than zero is said on, those are among them."""
    scene = Scene(*(f"/a{number:02}" for number in range(MAX_TOPICS)), "/x", "/y")
    scene.commanded = {"/x", "/y"}
    scene.zeros.say()
    said = [topic for topic, _ in scene.platform.published]
    assert said == ["/x", "/y", *(f"/a{number:02}" for number in range(MAX_TOPICS - 2))]


def test_a_stop_contradicts_another_node_on_the_drivers_own_topic() -> None:
    """With a client that has advertised it, zero still comes after what the driver's own stop takes."""
    scene = daemon_scene.Scene()
    scene.platform.view = GraphView(topics={"/cmd_vel": HEARD})
    control = scene.register()
    line = scene.driving(control)
    control.say(link.Stop(id=2, by="eve"))
    scene.run(0.5)
    before = len(scene.platform.published)
    for _ in range(8):
        scene.clock.advance(EVERY)
    assert scene.platform.published[before:] == [("/cmd_vel", ZERO)] * 8
    scene.run(2.0)
    control.say(link.Resume(id=3, by="eve"))
    scene.run(1.0)
    scene.command(line, twist(0.5))
    assert scene.platform.published[-1] == ("/cmd_vel", twist(0.5))
    assert len(scene.platform.sinks) == 1
