"""A ROS 2 node that publishes numbered messages at steady rates. Started by the measurements, as a process.

Argument: JSON, a list of {"topic", "kind" ("string", "scan", "image" or "cloud"), "rate" (per second), "size" (bytes)}.
Prints READY; a line on the standard input is answered by the numbers published so far, as JSON. Ends with it. Each
message begins with ``#<number>@<monotonic nanoseconds>``, in ``data`` or in the header's ``frame_id``.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy
import rclpy
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image, LaserScan, PointCloud2, PointField
from std_msgs.msg import String

BEAMS = 1080


def maker(kind: str, size: int) -> tuple[type, Callable[[str], Any]]:
    """A message class, and what makes a message with a mark."""
    noise = numpy.random.default_rng(1)
    if kind == "string":
        return String, lambda mark: String(data=mark.ljust(size, "."))
    if kind == "scan":
        scan = LaserScan(angle_min=-2.35, angle_max=2.35, angle_increment=4.7 / BEAMS, range_max=30.0)
        scan.ranges = noise.uniform(0.2, 30, BEAMS).astype("f4").tolist()
        scan.intensities = noise.uniform(0, 255, BEAMS).astype("f4").tolist()
        return LaserScan, lambda mark: marked(scan, mark)
    if kind == "image":
        image = Image(height=480, width=640, encoding="rgb8", step=1920)
        image.data = noise.integers(0, 256, 480 * 1920, "u1").tobytes()
        return Image, lambda mark: marked(image, mark)
    points = size // 16
    cloud = PointCloud2(height=1, width=points, point_step=16, row_step=16 * points, is_dense=True)
    cloud.fields = [
        PointField(name=name, offset=4 * at, datatype=7, count=1) for at, name in enumerate("xyzi")
    ]
    cloud.data = noise.normal(scale=5, size=4 * points).astype("f4").tobytes()
    return PointCloud2, lambda mark: marked(cloud, mark)


def marked(message: Any, mark: str) -> Any:
    """The message with this mark."""
    message.header.frame_id = mark
    return message


class Stream:
    """One topic."""

    def __init__(self, node: Any, topic: str, kind: str, rate: float, size: int) -> None:
        self.topic = topic
        self.rate = rate
        self.sent = 0
        message, self._make = maker(kind, size)
        self._publisher = node.create_publisher(
            message, topic, QoSProfile(depth=100 if kind == "string" else 20)
        )

    def due(self, passed: float) -> None:
        """Publish what should be out by now; who was held up catches up by twos."""
        for _ in range(min(2, int(passed * self.rate) - self.sent)):
            self._publisher.publish(self._make(f"#{self.sent:09d}@{time.monotonic_ns()} "))
            self.sent += 1


def main() -> None:
    """Publish until the standard input ends."""
    rclpy.init()
    node = rclpy.create_node("bench_publisher")
    streams = [Stream(node, **each) for each in json.loads(sys.argv[1])]
    ended = threading.Event()

    def answer() -> None:
        for _ in sys.stdin:
            print(json.dumps({each.topic: each.sent for each in streams}), flush=True)
        ended.set()

    threading.Thread(target=answer, daemon=True).start()
    print("READY", flush=True)
    begun = time.monotonic()
    while not ended.wait(0.002):
        for stream in streams:
            stream.due(time.monotonic() - begun)


if __name__ == "__main__":
    main()
