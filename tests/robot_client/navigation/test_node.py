"""The navigator's node in a real ROS 2 graph, with sensors that send what it can't use."""

from __future__ import annotations

import array
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Quaternion, TransformStamped, Twist
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionClient
from sensor_msgs.msg import CameraInfo, Image, LaserScan
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from robot_client.navigation import messages, navigator, node
from robot_client.navigation.grid import GridGeometry
from robot_client.navigation.navigator import NavigatorSettings
from robot_client.navigation.node import NavigatorNode, NavigatorTopics
from robot_client.services.health import Level, ServiceFinding
from robot_client.services.node_runner import LATCHED
from tests.worlds.ros_domains import free_domain
from tests.worlds.service_process import TopicWatcher

DEPTH, INFO = "camera/depth/image_rect_raw", "camera/depth/camera_info"
WIDTH, HEIGHT, FOCAL = 8, 8, 10.0
LEVEL_CAMERA = (-0.5, 0.5, -0.5, 0.5)
"""Rotation of an optical frame (REP 103) that looks ahead."""
TILTED_CAMERA = (-0.5, 0.5, -0.3, 0.6)
AT_ORIGIN = (0.0, 0.0, 0.0, 1.0)


class SensingRobot:
    """A navigator that uses its sensors, since its costmap is watched, and the sensors.

    :ivar used: how many scans and images the navigator has read, also those that it refused
    """

    def __init__(self, watcher: TopicWatcher, patch: pytest.MonkeyPatch) -> None:
        self.watcher = watcher
        ros = watcher.node
        self.used = {"scan": 0, "depth": 0}
        for sensor in self.used:
            patch.setattr(
                messages, f"{sensor}_view", self._counted(sensor, getattr(messages, f"{sensor}_view"))
            )
        watcher.watch("global_costmap/costmap", OccupancyGrid, LATCHED)
        topics = NavigatorTopics()
        self.navigator = NavigatorNode(ros, topics, NavigatorSettings(topics.sensors()))
        self._map = ros.create_publisher(OccupancyGrid, topics.map, LATCHED)
        self._transforms = ros.create_publisher(TFMessage, "tf_static", LATCHED)
        self._pose = ros.create_publisher(TFMessage, "tf", 100)
        self._scan = ros.create_publisher(LaserScan, topics.scan, 10)
        self._depth = ros.create_publisher(Image, topics.depth, 10)
        self._info = ros.create_publisher(CameraInfo, topics.depth_info, 10)

    def _counted(self, sensor: str, read: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*arguments: Any) -> Any:
            self.used[sensor] += 1
            return read(*arguments)

        return counted

    def send_map(self, turned: bool = False, side: int = 40) -> None:
        geometry = GridGeometry(-2.0, -2.0, 0.1, side, side)
        cells = np.zeros((side, side), dtype=np.int8)
        made = messages.grid_message(Header(frame_id="map"), geometry, cells)
        made.info.origin.orientation = (
            Quaternion(z=math.sin(0.5), w=math.cos(0.5)) if turned else Quaternion()
        )
        self._map.publish(made)

    def send_transforms(self, camera: tuple[float, float, float, float]) -> None:
        """Places the sensors in the map."""
        made = TFMessage()
        for frame, turn in (("laser", AT_ORIGIN), ("camera", camera)):
            transform = TransformStamped(header=Header(frame_id="map"), child_frame_id=frame)
            transform.transform.translation.z = 0.3
            x, y, z, w = turn
            transform.transform.rotation = Quaternion(x=x, y=y, z=z, w=w)
            made.transforms.append(transform)
        self._transforms.publish(made)

    def move(self) -> None:
        """Senses, and sends the robot's pose."""
        made = TransformStamped(header=Header(frame_id="map"), child_frame_id="base_link")
        self._pose.publish(TFMessage(transforms=[made]))
        self.sense()

    def sense(self, info: bool = True) -> None:
        """Sends a scan and a depth image.

        :param info: sends a camera_info, too
        """
        scan = LaserScan(header=Header(frame_id="laser"), angle_increment=0.1, range_max=10.0)
        scan.ranges = array.array("f", [math.inf] * 10)
        self._scan.publish(scan)
        if info:
            calibration = [FOCAL, 0.0, WIDTH / 2, 0.0, FOCAL, HEIGHT / 2, 0.0, 0.0, 1.0]
            self._info.publish(CameraInfo(width=WIDTH, height=HEIGHT, k=calibration))
        image = Image(header=Header(frame_id="camera"), encoding="16UC1", width=WIDTH, height=HEIGHT)
        image.step, image.data = 2 * WIDTH, array.array("B", bytes(2 * WIDTH * HEIGHT))
        self._depth.publish(image)

    def until(self, level: Level, text: str, info: bool = True) -> None:
        """Senses until the navigator says this."""

        def found() -> bool:
            said = self.navigator.finding()
            return said.level is level and text in said.message

        self.watcher.until(f"{level.name}: {text}", found, lambda: self.sense(info))

    def send_goal(self, x: float, y: float) -> None:
        client = ActionClient(self.watcher.node, NavigateToPose, "navigate_to_pose")
        self.watcher.until("the action is known", client.server_is_ready, self.sense)
        goal = NavigateToPose.Goal()
        goal.pose.pose.position.x, goal.pose.pose.position.y = x, y
        client.send_goal_async(goal)

    def findings(self, more: dict[str, int]) -> set[ServiceFinding]:
        """What the navigator says while it reads so many more scans and images."""
        until = {sensor: self.used[sensor] + number for sensor, number in more.items()}
        said: list[ServiceFinding] = []

        def read() -> bool:
            said.append(self.navigator.finding())
            return all(self.used[sensor] >= number for sensor, number in until.items())

        self.watcher.until("the navigator has read them", read, self.sense)
        return {each._replace(values=()) for each in said}  # type: ignore[arg-type]


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch) -> Iterator[SensingRobot]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    watcher = TopicWatcher(free_domain())
    try:
        yield SensingRobot(watcher, monkeypatch)
    finally:
        watcher.close()


def test_a_tilted_camera_is_reported_for_as_long_as_it_is_tilted(robot: SensingRobot) -> None:
    robot.send_map()
    robot.send_transforms(TILTED_CAMERA)
    robot.until(Level.ERROR, "not level")
    said = robot.findings({"scan": 10, "depth": 10})
    assert [each.level for each in said] == [Level.ERROR]
    assert "'depth'" in said.pop().message
    robot.send_transforms(LEVEL_CAMERA)
    robot.until(Level.OK, "waiting for a goal")


def test_a_missing_camera_info_is_reported_with_its_topic(robot: SensingRobot) -> None:
    robot.send_map()
    robot.send_transforms(LEVEL_CAMERA)
    robot.until(Level.ERROR, f"no camera_info on {INFO}", info=False)
    robot.until(Level.OK, "waiting for a goal")


def test_what_a_sensor_sends_hides_no_refused_map(robot: SensingRobot) -> None:
    robot.send_map()
    robot.send_transforms(LEVEL_CAMERA)
    robot.until(Level.OK, "waiting for a goal")
    robot.send_map(turned=True)
    robot.until(Level.ERROR, "the map is turned")
    assert {each.level for each in robot.findings({"scan": 5, "depth": 5})} == {Level.ERROR}
    robot.send_map()
    robot.until(Level.OK, "waiting for a goal")


def test_a_goal_waits_for_the_frames_that_are_not_connected(robot: SensingRobot) -> None:
    robot.send_map()
    robot.send_transforms(LEVEL_CAMERA)
    robot.until(Level.OK, "waiting for a goal")
    robot.send_goal(1.0, 0.0)
    robot.until(Level.WARN, "no transforms connect the frames 'map' and 'base_link'")


def test_the_robot_stands_before_a_large_map_of_another_size_is_computed(
    robot: SensingRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(node, "STANDING_CELLS", 2000)
    monkeypatch.setattr(navigator, "PROGRESS_SECONDS", math.inf)  # the pose stays as it is
    robot.watcher.watch("cmd_vel", Twist)
    robot.send_map()
    robot.send_transforms(LEVEL_CAMERA)
    robot.until(Level.OK, "waiting for a goal")
    robot.send_goal(1.5, 0.0)
    robot.watcher.newest("cmd_vel", lambda command: command.linear.x > 0, meanwhile=robot.move)
    robot.send_map(side=50)
    robot.watcher.newest("cmd_vel", lambda command: command.linear.x == 0, meanwhile=robot.move)
