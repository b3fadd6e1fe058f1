"""The camera process's ROS 2 node and its subscriptions.

It does not use shared memory either, so that a publisher of images never waits for the camera process.
Shared memory also lost most large images: of 640×480 RGB at 15 Hz a quarter arrived, since the segment is
smaller than one image. By UDP all arrived with 4 MiB of socket buffer, and half with Linux's default of 208
KiB.
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
"""Depth of subscriptions: only the newest image matters."""

CHECK_INTERVAL = 1.0
"""Seconds between two checks of the publishers."""

_PROFILES = {
    "": QoS(depth=DEPTH),
    "sensor_data": QoS(depth=DEPTH, reliability="best_effort", durability="volatile"),
    "default": QoS(depth=10, reliability="reliable", durability="volatile"),
}
"""By the values of ``settings.qos``; policies that are left out match the publishers."""


class RosCameras:
    """A node that subscribes to images, with its own thread.

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
        self._node.create_timer(CHECK_INTERVAL, self._check, clock=steady)
        self._spinner.start()

    def subscribe(
        self, topic: str, compressed: bool, qos: str, on_message: Callable[[bytes], None]
    ) -> RosCamera:
        """Subscribe to a topic, which need not exist yet.

        :param compressed: whether its messages are CompressedImage
        :param qos: ``""`` to match the publishers, ``sensor_data`` or ``default``
        :param on_message: called with each message, on the executor's thread
        """
        message_class = CompressedImage if compressed else Image
        camera = RosCamera(self._node, message_class, topic, _PROFILES[qos], on_message, self._closed)
        self._spinner.call(self._opened, camera)
        return camera

    def close(self) -> None:
        """Leave the graph."""
        self._spinner.stop()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def _opened(self, camera: RosCamera) -> None:
        self._subscriptions.add(camera)
        camera.refresh()

    def _closed(self, camera: RosCamera) -> None:
        self._spinner.call(self._drop, camera)

    def _drop(self, camera: RosCamera) -> None:
        self._subscriptions.discard(camera)
        camera.drop()

    def _check(self) -> None:
        for camera in self._subscriptions:
            camera.refresh()


class RosCamera:
    """One subscription; used on the executor's thread, except for :meth:`close` and :attr:`latched`."""

    def __init__(
        self,
        node: Any,
        message_class: Any,
        topic: str,
        qos: QoS,
        on_message: Callable[[bytes], None],
        on_close: Callable[[RosCamera], None],
    ) -> None:
        self._node = node
        self._class = message_class
        self._topic = topic
        self._qos = qos
        self._on_message = on_message
        self._on_close = on_close
        self._closed = threading.Event()
        self._subscription: Any = None
        self._profile: QoSProfile | None = None
        self._latest: bytes | None = None
        self._repeated: bytes | None = None
        """A message that may arrive again after a new subscription."""
        self.latched = False
        """Whether the publisher keeps the latest image for late joiners; may be read from any thread."""

    def close(self) -> None:
        """End the subscription; from any thread."""
        self._closed.set()
        self._on_close(self)

    def refresh(self) -> None:
        """Subscribe with the publishers' quality of service, again if it changed."""
        found = ros2_qos.match(
            [each.qos_profile for each in self._node.get_publishers_info_by_topic(self._topic)]
        )
        profile = ros2_qos.for_subscription(found, self._qos)
        if self._subscription is not None and (found.publishers == 0 or profile == self._profile):
            return
        self.drop()
        self._profile, self._repeated = profile, self._latest
        self.latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        self._subscription = self._node.create_subscription(
            self._class, self._topic, self._arrived, profile, raw=True
        )

    def drop(self) -> None:
        """Destroy the subscription."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _arrived(self, cdr: bytes) -> None:
        repeated, self._repeated = self._repeated, None
        if self._closed.is_set() or (self.latched and cdr == repeated):
            return
        self._latest = cdr
        self._on_message(cdr)
