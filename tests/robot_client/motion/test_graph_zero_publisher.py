"""Zero after a stop, on topics that other nodes may command."""

from __future__ import annotations

import pytest
from twisted.internet.task import Clock

from relay_protocol import link
from relay_protocol.link import MotionPolicy
from robot_client.motion.graph_zero_publisher import MAX_TOPICS, ZERO_EVERY, ZEROS, GraphZeroPublisher
from robot_client.platforms.base import GraphView
from tests.worlds import robot_daemon
from tests.worlds.memory_platform import TWIST, MemoryPlatform, twist

ZERO = twist()
HEARD = link.Topic(types=[TWIST], publishers=["/nav2"], subscribers=["/base"])


class Scene:
    """A graph in which some topics have subscribers.

    :attr commanded: those that clients may command
    """

    def __init__(self, *topics: str) -> None:
        self.clock = Clock()
        self.platform = MemoryPlatform(GraphView(topics=dict.fromkeys(topics, HEARD)))
        self.commanded: set[str] = set()
        self.graph_zero_publisher = GraphZeroPublisher(
            MotionPolicy(types=[TWIST]), self.platform, self.clock, lambda topic: topic in self.commanded
        )

    def run(self) -> None:
        for _ in range(2 * ZEROS):
            self.clock.advance(ZERO_EVERY)


@pytest.mark.parametrize("commanded", [True, False])
def test_zero_is_published_for_a_second(commanded: bool) -> None:
    """Whether clients command the topic or not; then the publisher is removed."""
    scene = Scene("/cmd_vel")
    scene.commanded = {"/cmd_vel"} if commanded else set()
    scene.graph_zero_publisher.start()
    scene.run()
    assert scene.platform.published == [("/cmd_vel", ZERO)] * ZEROS
    assert scene.platform.publishers == []


def test_publishers_that_are_kept_ready_are_those_that_publish_zero() -> None:
    """They outlive the zeros of a stop, and end when no goal moves the robot any more, but not before the zeros."""
    scene = Scene("/cmd_vel")
    zeros = scene.graph_zero_publisher
    zeros.keep_ready(True)
    (ready,) = scene.platform.publishers
    assert scene.platform.published == []
    zeros.start()
    scene.run()
    assert scene.platform.publishers == [ready]
    zeros.start()
    zeros.keep_ready(False)
    scene.run()
    assert scene.platform.published == [("/cmd_vel", ZERO)] * 2 * ZEROS
    assert scene.platform.publishers == []


def test_topics_that_clients_command_come_first() -> None:
    scene = Scene(*(f"/a{number:02}" for number in range(MAX_TOPICS)), "/x", "/y")
    scene.commanded = {"/x", "/y"}
    scene.graph_zero_publisher.start()
    said = [topic for topic, _ in scene.platform.published]
    assert said == ["/x", "/y", *(f"/a{number:02}" for number in range(MAX_TOPICS - 2))]


def test_stop_publishes_zero_also_on_a_clients_topic_for_longer() -> None:
    """Another node may command it too."""
    scene = robot_daemon.Scene()
    scene.platform.view = GraphView(topics={"/cmd_vel": HEARD})
    control = scene.register()
    line = scene.driving(control)
    control.send(link.Stop(id=2, by="eve"))
    scene.run(0.5)
    before = len(scene.platform.published)
    for _ in range(8):
        scene.clock.advance(ZERO_EVERY)
    assert scene.platform.published[before:] == [("/cmd_vel", ZERO)] * 8
    scene.run(2.0)
    control.send(link.Resume(id=3, by="eve"))
    scene.run(1.0)
    scene.command(line, twist(0.5))
    assert scene.platform.published[-1] == ("/cmd_vel", twist(0.5))
    assert len(scene.platform.publishers) == 1
