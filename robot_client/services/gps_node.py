"""The service ``gps`` in the graph."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from sensor_msgs.msg import NavSatFix

from robot_client.services import gps
from robot_client.services.gps import Fix, Lines, Nmea
from robot_client.services.gps_source import ByteReader, ByteSource
from robot_client.services.health import InputWatch, ServiceFinding

SILENT = 5.0
"""Seconds without a sentence after which it says so."""


class Gps:
    """Publishes what a receiver says.

    :param name: of the source, for people
    :param open_source: opens it
    :param frame: coordinate frame of the antenna
    """

    def __init__(self, node: Any, name: str, open_source: Callable[[], ByteSource], frame: str) -> None:
        self._node = node
        self._frame = frame
        self._lines = Lines()
        self._nmea = Nmea()
        self._fresh = InputWatch(name, SILENT, time.monotonic)
        self._publisher = node.create_publisher(NavSatFix, "fix", 10)
        self._reader = ByteReader(name, open_source, self._came)

    def finding(self) -> ServiceFinding:
        """Whether there is a fix, and how good."""
        trouble = self._reader.finding() or self._fresh.trouble()
        found = self._nmea.finding(self._lines.too_long)
        return trouble._replace(values=found.values) if trouble else found

    def close(self) -> None:
        """Let go of the receiver."""
        self._reader.close()

    def _came(self, data: bytes) -> None:
        """In the reader's thread: publishers may be used in any."""
        self._fresh.came()
        for line in self._lines.feed(data):
            fix = self._nmea.read(line)
            if fix is not None:
                self._publisher.publish(self._message(fix))

    def _message(self, fix: Fix) -> NavSatFix:
        message = NavSatFix()
        # When it was heard: the clocks of receiver and robot need not agree.
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
