"""Modules that are nodes in the ROS 2 graph. rclpy is imported when the module starts."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from robot_client.devices.drive import MobileRobot, Odometry
from robot_client.devices.module import Call, Module

SPIN_SECONDS = 1.0
"""Longest time of one ``spin_once``; the first callback ends it. ``spin`` of rclpy 7.1's EventsExecutor hangs."""


class RosNode(Module):
    """A module with a node. Its callbacks and the module's methods run in one thread, one at a time.

    :meth:`start` creates the node's topics, services and timers with :attr:`node`, an ``rclpy.node.Node``.

    :cvar node_name: name of the node, which a class sets, or an object before it is started
    :cvar namespace: before all its names
    """

    node_name = "module"
    namespace = ""
    node: Any = None
    _ros_executor: Any = None
    _ros_failure: BaseException | None = None

    def _host_run(self) -> None:
        """Spin the node until :meth:`_host_end`."""
        thread = threading.Thread(target=self._ros_spin, name="ros")
        thread.start()
        try:
            while (call := self._core.calls.get()) is not None:
                self._ros_executor.create_task(partial(self._ros_call, call))
        finally:
            self._ros_ended = True
            self._ros_executor.create_task(_nothing)  # ends spin_once
            thread.join()
        if self._ros_failure is not None:
            raise self._ros_failure

    def _host_open(self) -> None:
        """Create the node."""
        import rclpy
        from rclpy.signals import SignalHandlerOptions

        from robot_client.platforms.ros2.executor import make_executor
        from robot_client.platforms.ros2.transport import without_shared_memory
        from robot_client.ros_log import ensure_log_folder

        ensure_log_folder()
        self._ros_context = rclpy.Context()
        # A frozen module must not block other nodes.
        with without_shared_memory(rclpy.get_rmw_implementation_identifier()):
            rclpy.init(args=[], context=self._ros_context, signal_handler_options=SignalHandlerOptions.NO)
            self.node = rclpy.create_node(self.node_name, context=self._ros_context, namespace=self.namespace)
        self._ros_executor = make_executor("events", self._ros_context)
        self._ros_executor.add_node(self.node)

    def _host_close(self) -> None:
        """Leave the graph."""
        import rclpy

        self._ros_executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._ros_context)

    _ros_context: Any = None
    _ros_ended = False

    def _ros_spin(self) -> None:
        self._core.own_thread = threading.get_ident()
        while not self._ros_ended:
            try:
                self._ros_executor.spin_once(timeout_sec=SPIN_SECONDS)
            except Exception as error:
                self._ros_fail(error)

    def _ros_call(self, call: Call) -> None:
        try:
            call()
        except Exception as error:
            self._ros_fail(error)

    def _ros_fail(self, error: BaseException) -> None:
        self._ros_failure = self._ros_failure or error
        self._ros_ended = True
        self._host_end()


class RobotNode(RosNode):
    """The node of a mobile base: takes ``cmd_vel``, publishes ``odom`` and ``tf``.

    The base stands still when ``cmd_vel`` is older than ``command_limit``, and while the robot is stopped. While it
    should stand still, ``drive(0, 0)`` is repeated every ``command_limit``, as it may have been disconnected.

    :param base: the drive
    :param cmd_vel: topic of type geometry_msgs/Twist that drives it
    :param odom: topic of type nav_msgs/Odometry
    :param odom_period: seconds between two messages of it
    :param odom_reliable: whether lost messages of it are sent again
    :param tf: whether the transform from ``odom_frame`` to ``base_frame`` is published, with each odometry
    :param command_limit: seconds that a command is good for
    """

    node_name = "base"

    def __init__(
        self,
        base: MobileRobot,
        *,
        cmd_vel: str = "cmd_vel",
        odom: str = "odom",
        odom_period: float = 0.05,
        odom_reliable: bool = True,
        tf: bool = True,
        odom_frame: str = "odom",
        base_frame: str = "base_link",
        command_limit: float = 0.5,
    ) -> None:
        self.base = base
        self._cmd_vel = cmd_vel
        self._odom = odom
        self._odom_period = odom_period
        self._odom_reliable = odom_reliable
        self._tf = tf
        self._frames = odom_frame, base_frame
        self._watch = CommandWatch(base, command_limit, time.monotonic)

    def start(self) -> None:
        """Create topics and timers."""
        from geometry_msgs.msg import Twist
        from nav_msgs.msg import Odometry as OdometryMessage
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        node = self.node
        node.create_subscription(Twist, self._cmd_vel, self._on_command, 1)
        reliability = ReliabilityPolicy.RELIABLE if self._odom_reliable else ReliabilityPolicy.BEST_EFFORT
        quality = QoSProfile(depth=10, reliability=reliability)
        self._odometry = node.create_publisher(OdometryMessage, self._odom, quality)
        self._transforms = self._create_transforms() if self._tf else None
        node.create_timer(self._odom_period, self._publish)
        node.create_timer(self._watch.period, self._watch.check)

    def stop(self) -> None:
        """Have the base stand still."""
        self._watch.halt()

    def robot_stopped(self, stopped: bool) -> None:
        """Have the base stand still while the robot is stopped."""
        self._watch.hold(stopped)

    def _create_transforms(self) -> Any:
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            self.node.get_logger().warning("tf2_msgs is not installed, so tf is not published")
            return None
        return self.node.create_publisher(TFMessage, "tf", 10)

    def _on_command(self, message: Any) -> None:
        self._watch.command(message.linear.x, message.angular.z)

    def _publish(self) -> None:
        now = self.base.odometry()
        stamp = self.node.get_clock().now().to_msg()
        self._odometry.publish(odometry_message(now, stamp, self._frames))
        if self._transforms is not None:
            self._transforms.publish(transform_message(now, stamp, self._frames))


class CommandWatch:
    """Passes commands to a base, and has it stand still without fresh ones.

    :param limit: seconds that a command is good for
    :param clock: seconds, monotonic
    """

    def __init__(self, base: MobileRobot, limit: float, clock: Callable[[], float]) -> None:
        if not limit > 0:
            raise ValueError(f"command_limit = {limit} is not a positive number of seconds")
        self._base = base
        self._limit = limit
        self._clock = clock
        self._held = True
        self._until = -math.inf
        """When the latest order is too old: a motion ends, standing still is repeated."""

    @property
    def period(self) -> float:
        """Seconds between two calls of :meth:`check`: a tenth of the limit."""
        return self._limit / 10

    def command(self, speed: float, turn: float) -> None:
        """Drive (m/s, rad/s), unless the robot is stopped. What is no number stops the base."""
        if self._held or not (math.isfinite(speed) and math.isfinite(turn)):
            self.halt()
            return
        self._drive(speed, turn)

    def check(self) -> None:
        """Stop the base if the last command is too old.

        This is repeated every ``limit``: a base that was disconnected has missed it, and may still move.
        """
        if self._clock() >= self._until:
            self.halt()

    def hold(self, held: bool) -> None:
        """Begin or end to refuse commands."""
        self._held = held
        if held:
            self.halt()

    def halt(self) -> None:
        """Stop the base."""
        self._drive(0.0, 0.0)

    def _drive(self, speed: float, turn: float) -> None:
        self._until = self._clock() + self._limit
        self._base.drive(speed, turn)


def odometry_message(odometry: Odometry, stamp: Any, frames: tuple[str, str]) -> Any:
    """As nav_msgs/Odometry.

    :param frames: of the start, and of the base
    """
    from nav_msgs.msg import Odometry as OdometryMessage

    message = OdometryMessage()
    message.header.stamp = stamp
    message.header.frame_id, message.child_frame_id = frames
    pose, twist = message.pose.pose, message.twist.twist
    pose.position.x, pose.position.y = odometry.x, odometry.y
    pose.orientation.z, pose.orientation.w = math.sin(odometry.heading / 2), math.cos(odometry.heading / 2)
    twist.linear.x, twist.angular.z = odometry.speed, odometry.turn
    return message


def transform_message(odometry: Odometry, stamp: Any, frames: tuple[str, str]) -> Any:
    """As tf2_msgs/TFMessage; parameters as of :func:`odometry_message`."""
    from geometry_msgs.msg import TransformStamped
    from tf2_msgs.msg import TFMessage

    message = TransformStamped()
    message.header.stamp = stamp
    message.header.frame_id, message.child_frame_id = frames
    moved, turned = message.transform.translation, message.transform.rotation
    moved.x, moved.y = odometry.x, odometry.y
    turned.z, turned.w = math.sin(odometry.heading / 2), math.cos(odometry.heading / 2)
    return TFMessage(transforms=[message])


def _nothing() -> None:
    pass
