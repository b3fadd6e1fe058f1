"""Zero on topics of other nodes, on a real graph."""

from __future__ import annotations

import pytest_twisted
from geometry_msgs.msg import Twist
from rclpy.serialization import serialize_message
from twisted.internet import reactor

from relay_protocol.link import MotionPolicy
from robot_client.motion.graph_zero_publisher import GraphZeroPublisher
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import until
from tests.worlds.ros_endpoints import TWIST, Listener, node, seen


@pytest_twisted.ensureDeferred
async def test_zeros_reach_a_subscriber_and_the_publisher_is_removed(ros: Ros2Platform) -> None:
    """Other topics get none."""
    with node("base") as base:
        base.create_subscription(Twist, "/base_vel", lambda message: None, 1)
        base.create_subscription(Twist, "/other", lambda message: None, 1)
        await seen(ros, lambda graph: {"/base_vel", "/other"} <= graph.topics.keys())
        heard, other = Listener(ros, "/base_vel", TWIST), Listener(ros, "/other", TWIST)
        GraphZeroPublisher(MotionPolicy(topics=["/base_vel"]), ros, reactor, lambda topic: False).start()
        await until(lambda: len(heard.bodies) > 5)
        assert set(heard.bodies) == {bytes(serialize_message(Twist()))}
        await until(lambda: heard.source.publishers == 0)
        assert other.bodies == []
        heard.source.close()
        other.source.close()
