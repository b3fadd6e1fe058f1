"""ROS node of the service ``gps``."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from sensor_msgs.msg import NavSatFix

from robot_client.services import gps
from robot_client.services.gps import Fix, Lines, Nmea
from robot_client.services.gps_source import ByteReader, ByteSource
from robot_client.services.health import InputWatch, ServiceFinding

SILENT_SECONDS = 5.0
"""Seconds without a sentence after which the input counts as silent."""


class Gps:
    """Publishes the positions of a receiver.

    :param name: of the source, for display
    :param open_source: opens it
    :param frame: coordinate frame of the antenna
    """

    def __init__(self, node: Any, name: str, open_source: Callable[[], ByteSource], frame: str) -> None:
        self._node = node
        self._frame = frame
        self._lines = Lines()
        self._nmea = Nmea()
        self._input = InputWatch(name, SILENT_SECONDS, time.monotonic)
        self._publisher = node.create_publisher(NavSatFix, "fix", 10)
        self._reader = ByteReader(name, open_source, self._on_message)

    def finding(self) -> ServiceFinding:
        """Whether there is a fix, and how good."""
        problem = self._reader.finding() or self._input.problem()
        found = self._nmea.finding(self._lines.too_long)
        return problem._replace(values=found.values) if problem else found

    def close(self) -> None:
        """Close the receiver."""
        self._reader.close()

    def _on_message(self, data: bytes) -> None:
        """Runs in the reader's thread; publishers are thread-safe."""
        self._input.received()
        for line in self._lines.feed(data):
            fix = self._nmea.read(line)
            if fix is not None:
                self._publisher.publish(self._message(fix))

    def _message(self, fix: Fix) -> NavSatFix:
        message = NavSatFix()
        # Time of reception: the clocks of receiver and robot may differ.
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.header.frame_id = self._frame
        message.status.status, message.status.service = fix.status, fix.service
        message.latitude, message.longitude, message.altitude = fix.latitude, fix.longitude, fix.altitude
        message.position_covariance_type = gps.UNKNOWN
        if fix.variances is not None:
            east, north, up = fix.variances
            message.position_covariance = [east, 0.0, 0.0, 0.0, north, 0.0, 0.0, 0.0, up]
            message.position_covariance_type = gps.APPROXIMATED
        return message
