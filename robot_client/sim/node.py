"""The simulated robot in the ROS 2 graph: topics in and out, the reset service, the parameters."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist as TwistMessage
from nav_msgs.msg import OccupancyGrid, Odometry
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import BatteryState, CameraInfo, CompressedImage, Image, LaserScan
from std_srvs.srv import Trigger

from robot_client.addresses import SIMULATOR
from robot_client.sim import health, messages
from robot_client.sim.camera import CAMERA_HEIGHT, SimCamera, to_jpeg, to_rgb
from robot_client.sim.depth_camera import HEIGHT as DEPTH_HEIGHT
from robot_client.sim.depth_camera import WIDTH as DEPTH_WIDTH
from robot_client.sim.depth_camera import SimDepthCamera
from robot_client.sim.drive import HIGHEST_SPEED, LONGEST_STEP
from robot_client.sim.floor_plan import floor_plan
from robot_client.sim.robot import FIRST_MAX_SPEED, SimRobot
from robot_client.sim.schedule import Schedule

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # not available as a wheel; see scripts/build_interfaces.py
    TFMessage = None

STEP = LONGEST_STEP
SCAN_PERIOD = 1 / 10
DEPTH_PERIOD = 1 / 10
SLOW_PERIOD = 1.0
_CATCH_UP = 5
"""Most steps made up after a delay; a delay over 0.1 s pauses the simulated world."""

_RELIABLE = QoSProfile(depth=10)
_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class SimNode(Node):  # type: ignore[misc]  # rclpy is untyped
    """A robot's node. The owner calls :meth:`run_due` between two spins.

    :param namespace: before every name, may be empty
    :param camera: None leaves the camera topics silent
    :param fps: images per second
    :param depth_camera: None: there is none
    :param battery: whether to publish the battery's state
    :param command_timeout: first value of the parameter ``cmd_vel_timeout``, seconds
    :param clock: seconds, monotonic
    """

    def __init__(
        self,
        robot: SimRobot,
        camera: SimCamera | None,
        fps: int,
        namespace: str,
        *,
        depth_camera: SimDepthCamera | None = None,
        scan: bool = True,
        battery: bool = True,
        command_timeout: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(SIMULATOR, namespace=namespace)
        self._robot = robot
        self._camera = camera
        self._depth_camera = depth_camera
        self._label = self.get_namespace().strip("/") or "robot"
        self._frames = messages.Frames(self.get_namespace())
        self._frames_sent = 0
        self._render_ms = 0.0
        self._declare_parameters(command_timeout)
        self._create_endpoints()
        self._battery: Any = None
        if battery:
            self._battery = self.create_publisher(BatteryState, "battery_state", _RELIABLE)
        self._schedule = Schedule(clock)
        self._schedule.every(STEP, self._step, catch_up=_CATCH_UP)
        if scan:
            self._scan = self.create_publisher(LaserScan, "scan", qos_profile_sensor_data)
            self._schedule.every(SCAN_PERIOD, self._publish_scan)
        self._schedule.every(SLOW_PERIOD, self._publish_slow)
        if camera is not None:
            self._schedule.every(1 / fps, self._publish_image)
        if depth_camera is not None:
            self._create_depth_camera()

    def run_due(self) -> float:
        """Run due tasks, and return the seconds until the next one."""
        return self._schedule.run_due()

    def _declare_parameters(self, command_timeout: float) -> None:
        self.declare_parameter(
            "max_speed", FIRST_MAX_SPEED, _between(0.05, HIGHEST_SPEED, "Maximum speed, m/s")
        )
        self.declare_parameter(
            "cmd_vel_timeout",
            command_timeout,
            _between(0.0, 60.0, "Seconds after which the robot stops without a new command; 0: never"),
        )
        self._apply(self.get_parameters(["max_speed", "cmd_vel_timeout"]))
        self.add_on_set_parameters_callback(self._on_parameters)

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        # rclpy has checked type and range before it asks
        self._apply(parameters)
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == "max_speed":
                self._robot.max_speed = parameter.value
            elif parameter.name == "cmd_vel_timeout":
                self._robot.command_timeout = parameter.value

    def _create_endpoints(self) -> None:
        sensor = qos_profile_sensor_data
        self._odom = self.create_publisher(Odometry, "odom", _RELIABLE)
        self._diagnostics = self.create_publisher(DiagnosticArray, "diagnostics", _RELIABLE)
        self._raw = self.create_publisher(Image, "camera/image_raw", sensor)
        self._jpeg = self.create_publisher(CompressedImage, "camera/image_raw/compressed", sensor)
        self._map = self.create_publisher(OccupancyGrid, "map", _LATCHED)
        self._map.publish(messages.occupancy_grid(self._now(), self._frames, floor_plan(self._robot.world)))
        self._tf: Any = None
        if TFMessage is not None:
            self._tf = self.create_publisher(TFMessage, "tf", _RELIABLE)
            self._tf_static = self.create_publisher(TFMessage, "tf_static", _LATCHED)
            fixed = messages.static_transforms(self._now(), self._frames, CAMERA_HEIGHT)
            self._tf_static.publish(TFMessage(transforms=fixed))
        else:
            self.get_logger().warning(
                "the package tf2_msgs is missing, so maps do not show the robot; source a ROS 2 that has it, or run "
                "'make web' in a checkout"
            )
        self.create_subscription(TwistMessage, "cmd_vel", self._on_command, _RELIABLE)
        self.create_service(Trigger, "reset", self._on_reset)

    def _create_depth_camera(self) -> None:
        sensor = qos_profile_sensor_data
        self._depth = self.create_publisher(Image, "camera/depth/image_rect_raw", sensor)
        self._depth_info = self.create_publisher(CameraInfo, "camera/depth/camera_info", sensor)
        self._schedule.every(DEPTH_PERIOD, self._publish_depth)

    def _on_command(self, message: TwistMessage) -> None:
        self._robot.command(message.linear.x, message.angular.z)

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._robot.reset()
        response.success = True
        response.message = "the robot and its battery are reset"
        return response

    # Each measures, draws and encodes only what is subscribed to: most of a robot's topics mostly are not.

    def _step(self) -> None:
        self._robot.step(STEP)
        odom = self._odom.get_subscription_count()
        tf = self._tf is not None and self._tf.get_subscription_count()
        if not (odom or tf):
            return
        body, stamp = self._robot.body, self._now()
        if odom:
            self._odom.publish(messages.odometry(stamp, self._frames, body.pose, body.velocity))
        if tf:
            self._tf.publish(TFMessage(transforms=[messages.transform(stamp, self._frames, body.pose)]))

    def _publish_scan(self) -> None:
        if self._scan.get_subscription_count():
            self._scan.publish(messages.scan(self._now(), self._frames, self._robot.scan(), SCAN_PERIOD))

    def _publish_image(self) -> None:
        raw, jpeg = self._raw.get_subscription_count(), self._jpeg.get_subscription_count()
        if self._camera is None or not (raw or jpeg):
            return
        stamp, begin = self._now(), time.perf_counter()
        body = self._robot.body
        frame = self._camera.render(body.pose, body.velocity.speed, stamp.sec + stamp.nanosec / 1e9)
        self._render_ms = (time.perf_counter() - begin) * 1000
        self._frames_sent += 1
        if raw:
            self._raw.publish(messages.image(stamp, self._frames, to_rgb(frame)))
        if jpeg:
            self._jpeg.publish(messages.compressed(stamp, self._frames, to_jpeg(frame)))

    def _publish_depth(self) -> None:
        if self._depth_camera is None or not self._depth.get_subscription_count():
            return
        stamp = self._now()
        depth = self._depth_camera.render(self._robot.body.pose)
        self._depth_info.publish(messages.depth_camera_info(stamp, self._frames, DEPTH_WIDTH, DEPTH_HEIGHT))
        self._depth.publish(messages.depth_image(stamp, self._frames, depth))

    def _publish_slow(self) -> None:
        stamp = self._now()
        if self._battery is not None:
            self._battery.publish(messages.battery(stamp, self._frames, self._robot.battery))
        self._diagnostics.publish(messages.diagnostics(stamp, self._label, self._findings()))

    def _findings(self) -> list[health.PartFinding]:
        body, pack = self._robot.body, self._robot.battery
        viewers = self._raw.get_subscription_count() + self._jpeg.get_subscription_count()
        return [
            health.motors(
                body.velocity.speed, body.velocity.turn, blocked=body.blocked, travelled=body.travelled
            ),
            health.battery(pack.charge, pack.voltage, pack.current, pack.charging),
            health.camera(self._camera is not None, viewers, self._frames_sent, self._render_ms),
        ]

    def _now(self) -> Any:
        return self.get_clock().now().to_msg()


def _between(lowest: float, highest: float, description: str) -> ParameterDescriptor:
    return ParameterDescriptor(
        description=description,
        floating_point_range=[FloatingPointRange(from_value=lowest, to_value=highest, step=0.0)],
    )
