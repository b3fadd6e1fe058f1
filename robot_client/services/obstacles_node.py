"""ROS node of the service ``obstacles``."""

from __future__ import annotations

import array
import math
import time
from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import Pose, PoseArray
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool, Header

from relay_protocol.errors import Invalid
from robot_client.camera.images import read_image
from robot_client.services import obstacles
from robot_client.services.health import InputWatch, Level, ServiceFinding
from robot_client.services.images import ImageRequest, ImageSource
from robot_client.services.node_runner import LATCHED
from robot_client.services.obstacles import Band, ProximityAlarm, Scan, Sectors

SILENT_SECONDS = 2.0
"""Seconds without a scan after which the input counts as silent."""


class ObstacleSettings(NamedTuple):
    """Settings.

    :ivar sectors: number of directions
    :ivar near: nearer obstacles are too near, metres
    :ivar frame: coordinate frame of the output, x ahead and y to the left; empty: the sensor's
    """

    sectors: int = 12
    near: float = 0.5
    frame: str = ""


class Obstacles:
    """Publishes the nearest obstacle in each direction.

    :param source: topic of a scan, or a camera that measures depth
    :param band: heights that count, for depth
    """

    def __init__(self, node: Any, source: str | ImageRequest, settings: ObstacleSettings, band: Band) -> None:
        self._settings = settings
        self._band = band
        self._alarm = ProximityAlarm(settings.near)
        self._last: Sectors | None = None
        self._problem = ""
        self._rays = node.create_publisher(LaserScan, "obstacles", 10)
        self._places = node.create_publisher(PoseArray, "obstacles/places", 10)
        self._near = node.create_publisher(Bool, "obstacles/near", LATCHED)
        self._near.publish(Bool(data=False))
        self._images: ImageSource | None = None
        if isinstance(source, ImageRequest):
            self._images = ImageSource(node, source, self._on_image)
        else:
            self._input = InputWatch(source, SILENT_SECONDS, time.monotonic)
            node.create_subscription(LaserScan, source, self._on_scan, qos_profile_sensor_data)

    def finding(self) -> ServiceFinding:
        """Distance of the nearest obstacle."""
        silent = self._images.finding() if self._images else self._input.problem()
        if silent is not None:
            return silent
        if self._problem:
            return ServiceFinding(Level.ERROR, self._problem)
        return obstacles.finding(self._alarm.near, self._last.nearest if self._last else None)

    def close(self) -> None:
        """Nothing to close."""

    def _on_scan(self, message: LaserScan) -> None:
        """An unusable scan changes nothing, because some scanners are blind when pushed against a wall."""
        self._input.received()
        scan = Scan(
            np.array(message.ranges, dtype=np.float64),
            message.angle_min,
            message.angle_increment,
            message.range_min,
            message.range_max,
        )
        try:
            found = obstacles.of_scan(scan, self._settings.sectors)
        except Invalid as error:
            self._problem = str(error)
            return
        self._problem = ""
        self._publish(found, message.header, message.range_min, message.range_max)

    def _on_image(self, message: bytes, header: Header) -> None:
        assert self._images is not None
        image = read_image(message)
        depth = obstacles.metres(image)
        model = self._images.camera_model(image.width, image.height)
        found = obstacles.of_depth(depth, model, self._settings.sectors, self._band)
        # In optical frames z is ahead; by REP 103 the related frame has x ahead.
        if header.frame_id.endswith("_optical_frame"):
            header.frame_id = header.frame_id.removesuffix("_optical_frame") + "_frame"
        self._publish(found, header, 0.0, 65.535)

    def _publish(self, found: Sectors, header: Header, least: float, most: float) -> None:
        self._last = found
        header.frame_id = self._settings.frame or header.frame_id
        self._rays.publish(_rays(found, header, least, most))
        self._places.publish(_poses(found, header))
        if self._alarm.update(found.nearest, least):
            self._near.publish(Bool(data=self._alarm.near))


def _rays(found: Sectors, header: Header, least: float, most: float) -> LaserScan:
    """A ray for each sector, through its middle; infinite without an obstacle (REP 117)."""
    message = LaserScan(header=header)
    message.angle_min = found.first
    message.angle_increment = found.width
    message.angle_max = found.first + found.width * (len(found.places) - 1)
    message.range_min, message.range_max = least, most
    message.ranges = array.array("f", [each.distance if each else math.inf for each in found.places])
    return message


def _poses(found: Sectors, header: Header) -> PoseArray:
    """Positions of the obstacles, the nearest first, facing away from the sensor."""
    message = PoseArray(header=header)
    for place in sorted(filter(None, found.places)):
        pose = Pose()
        pose.position.x = place.distance * math.cos(place.bearing)
        pose.position.y = place.distance * math.sin(place.bearing)
        pose.orientation.z, pose.orientation.w = math.sin(place.bearing / 2), math.cos(place.bearing / 2)
        message.poses.append(pose)
    return message
