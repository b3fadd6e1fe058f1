"""Cameras in ROS 2: the camera process's node, and what it subscribes to.

It shares no memory with other nodes either: who publishes pictures must not wait for a process that shows them. And
of 640×480 RGB at 15 Hz a quarter came through shared memory, whose segment is smaller than one of them; by UDP all did
with 4 MiB of socket buffer, and half with the 208 KiB that Linux grants by default.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CompressedImage, Image

from relay_protocol.errors import Unavailable
from relay_protocol.link import QoS
from robot_client.platforms.ros2 import qos as ros2_qos
from robot_client.platforms.ros2.executor import Spinner, make_executor
from robot_client.platforms.ros2.transport import without_shared_memory
from robot_client.ros_log import ensure_log_folder

DEPTH = 1
"""Pictures the middleware keeps for us: the newest."""

LOOK_EVERY = 1.0
"""Seconds between two looks at who publishes."""

_ASKED = {
    "": QoS(depth=DEPTH),
    "sensor_data": QoS(depth=DEPTH, reliability="best_effort", durability="volatile"),
    "default": QoS(depth=10, reliability="reliable", durability="volatile"),
}
"""By the names of ``settings.qos``; what is left out is matched to the publishers."""


class RosCameras:
    """A node that subscribes to pictures, served by a thread.

    :param name: of the node
    :raises Unavailable: ROS 2 does not start
    """

    def __init__(self, name: str) -> None:
        ensure_log_folder()
        self._context = context = rclpy.Context()
        try:
            with without_shared_memory(rclpy.get_rmw_implementation_identifier()):
                rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
                self._node: Any = rclpy.create_node(
                    name, context=context, start_parameter_services=False, enable_rosout=False
                )
        except Unavailable:
            raise
        except Exception as error:
            raise Unavailable(f"ROS 2 does not start: {error}") from error
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._spinner = Spinner(make_executor("single", context), self._node, steady)
        self._subscriptions: set[RosCamera] = set()
        self._node.create_timer(LOOK_EVERY, self._look, clock=steady)
        self._spinner.start()

    def subscribe(
        self, topic: str, compressed: bool, qos: str, on_picture: Callable[[bytes], None]
    ) -> RosCamera:
        """Have the pictures of a topic, present or not yet.

        :param compressed: whether its messages are CompressedImage
        :param qos: ``""`` to match the publishers, ``sensor_data`` or ``default``
        :param on_picture: called with each message, in the thread
        """
        kind = CompressedImage if compressed else Image
        camera = RosCamera(self._node, kind, topic, _ASKED[qos], on_picture, self._closed)
        self._spinner.do(self._opened, camera)
        return camera

    def close(self) -> None:
        """Leave the graph."""
        self._spinner.stop()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def _opened(self, camera: RosCamera) -> None:
        self._subscriptions.add(camera)
        camera.look()

    def _closed(self, camera: RosCamera) -> None:
        self._spinner.do(self._drop, camera)

    def _drop(self, camera: RosCamera) -> None:
        self._subscriptions.discard(camera)
        camera.drop()

    def _look(self) -> None:
        for camera in self._subscriptions:
            camera.look()


class RosCamera:
    """One subscription; made, followed and dropped in the executor's thread."""

    def __init__(
        self,
        node: Any,
        kind: Any,
        topic: str,
        asked: QoS,
        on_picture: Callable[[bytes], None],
        on_close: Callable[[RosCamera], None],
    ) -> None:
        self._node = node
        self._kind = kind
        self._topic = topic
        self._asked = asked
        self._on_picture = on_picture
        self._on_close = on_close
        self._closed = threading.Event()
        self._subscription: Any = None
        self._profile: QoSProfile | None = None
        self._latest: bytes | None = None
        self._passed_on: bytes | None = None
        """What may come again, because it was subscribed anew."""
        self.latched = False
        """Whether the latest picture was kept for us, and would be for others; to be read from any thread."""

    def close(self) -> None:
        """Listen no more; from any thread."""
        self._closed.set()
        self._on_close(self)

    def look(self) -> None:
        """Subscribe as the publishers want it, anew if they want it otherwise than before."""
        found = ros2_qos.match(
            [each.qos_profile for each in self._node.get_publishers_info_by_topic(self._topic)]
        )
        profile = ros2_qos.for_subscription(found, self._asked)
        if self._subscription is not None and (found.publishers == 0 or profile == self._profile):
            return
        self.drop()
        self._profile, self._passed_on = profile, self._latest
        self.latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        self._subscription = self._node.create_subscription(
            self._kind, self._topic, self._arrived, profile, raw=True
        )

    def drop(self) -> None:
        """Give the subscription up."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _arrived(self, cdr: bytes) -> None:
        passed_on, self._passed_on = self._passed_on, None
        if self._closed.is_set() or (self.latched and cdr == passed_on):
            return
        self._latest = cdr
        self._on_picture(cdr)
