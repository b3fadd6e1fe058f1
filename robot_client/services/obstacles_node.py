"""The service ``obstacles`` in the graph."""

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
from robot_client.camera.messages import read_image
from robot_client.services import obstacles
from robot_client.services.health import InputWatch, Level, ServiceFinding
from robot_client.services.node_runner import LATCHED
from robot_client.services.obstacles import Band, ProximityAlarm, Scan, Sectors
from robot_client.services.pictures import ImageRequest, ImageSource

SILENT = 2.0
"""Seconds without a scan after which it says so."""


class ObstacleSettings(NamedTuple):
    """What it is to do.

    :ivar sectors: how many directions
    :ivar near: metres, nearer than which is too near
    :ivar frame: coordinate frame of what it says, x ahead and y to the left; empty: the sensor's
    """

    sectors: int = 12
    near: float = 0.5
    frame: str = ""


class Obstacles:
    """Says in each direction what is nearest.

    :param source: topic of a scan, or a camera that measures depth
    :param band: heights that count, for depth
    """

    def __init__(self, node: Any, source: str | ImageRequest, settings: ObstacleSettings, band: Band) -> None:
        self._settings = settings
        self._band = band
        self._nearness = ProximityAlarm(settings.near)
        self._last: Sectors | None = None
        self._trouble = ""
        self._rays = node.create_publisher(LaserScan, "obstacles", 10)
        self._places = node.create_publisher(PoseArray, "obstacles/places", 10)
        self._near = node.create_publisher(Bool, "obstacles/near", LATCHED)
        self._near.publish(Bool(data=False))
        self._pictures: ImageSource | None = None
        if isinstance(source, ImageRequest):
            self._pictures = ImageSource(node, source, self._saw)
        else:
            self._fresh = InputWatch(source, SILENT, time.monotonic)
            node.create_subscription(LaserScan, source, self._scanned, qos_profile_sensor_data)

    def finding(self) -> ServiceFinding:
        """How near the nearest is."""
        silent = self._pictures.finding() if self._pictures else self._fresh.trouble()
        if silent is not None:
            return silent
        if self._trouble:
            return ServiceFinding(Level.ERROR, self._trouble)
        return obstacles.finding(self._nearness.near, self._last.nearest if self._last else None)

    def close(self) -> None:
        """Nothing is left to do."""

    def _scanned(self, message: LaserScan) -> None:
        """What is near stays as it was when a scan tells nothing: pushed against a wall some scanners go blind."""
        self._fresh.came()
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
            self._trouble = str(error)
            return
        self._trouble = ""
        self._say(found, message.header, message.range_min, message.range_max)

    def _saw(self, message: bytes, header: Header) -> None:
        assert self._pictures is not None
        picture = read_image(message)
        depth = obstacles.metres(picture)
        lens = self._pictures.lens(picture.width, picture.height)
        found = obstacles.of_depth(depth, lens, self._settings.sectors, self._band)
        # Of pictures z is ahead; by REP 103 the frame beside them has x ahead.
        if header.frame_id.endswith("_optical_frame"):
            header.frame_id = header.frame_id.removesuffix("_optical_frame") + "_frame"
        self._say(found, header, 0.0, 65.535)

    def _say(self, found: Sectors, header: Header, least: float, most: float) -> None:
        self._last = found
        header.frame_id = self._settings.frame or header.frame_id
        self._rays.publish(_rays(found, header, least, most))
        self._places.publish(_poses(found, header))
        if self._nearness.see(found.nearest, least):
            self._near.publish(Bool(data=self._nearness.near))


def _rays(found: Sectors, header: Header, least: float, most: float) -> LaserScan:
    """A ray for each sector, through its middle; infinite where nothing is (REP 117)."""
    message = LaserScan(header=header)
    message.angle_min = found.first
    message.angle_increment = found.width
    message.angle_max = found.first + found.width * (len(found.places) - 1)
    message.range_min, message.range_max = least, most
    message.ranges = array.array("f", [each.distance if each else math.inf for each in found.places])
    return message


def _poses(found: Sectors, header: Header) -> PoseArray:
    """Where exactly they are, the nearest first, each looking away from the sensor."""
    message = PoseArray(header=header)
    for place in sorted(filter(None, found.places)):
        pose = Pose()
        pose.position.x = place.distance * math.cos(place.bearing)
        pose.position.y = place.distance * math.sin(place.bearing)
        pose.orientation.z, pose.orientation.w = math.sin(place.bearing / 2), math.cos(place.bearing / 2)
        message.poses.append(pose)
    return message
