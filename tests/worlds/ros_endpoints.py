"""Endpoints of the robot's graph in this process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from relay_protocol import link
from robot_client.platforms.base import GraphView
from robot_client.platforms.ros2.platform import Ros2Platform
from tests.robot_client.ros import until

STRING = "std_msgs/msg/String"
TWIST = "geometry_msgs/msg/Twist"
STAMPED = "geometry_msgs/msg/TwistStamped"


class Listener:
    """A subscription of the platform, and its samples."""

    def __init__(self, ros: Ros2Platform, topic: str, type: str = "", qos: link.QoS | None = None) -> None:
        self.bodies: list[bytes] = []
        self.changes = 0
        self.source = ros.subscribe(topic, type, qos, self.bodies.append, self.changed)

    def changed(self) -> None:
        self.changes += 1

    @property
    def texts(self) -> list[str]:
        return [deserialize_message(body, String).data for body in self.bodies]


async def seen(ros: Ros2Platform, found: Callable[[GraphView], bool]) -> GraphView:
    """The graph, once the condition holds."""
    await until(lambda: found(ros.graph()))
    return ros.graph()


@contextmanager
def node(name: str) -> Iterator[Any]:
    """A node that is not the platform's."""
    context = rclpy.Context()
    rclpy.init(context=context)
    made = rclpy.create_node(name, context=context)
    try:
        yield made
    finally:
        made.destroy_node()
        rclpy.try_shutdown(context=context)
