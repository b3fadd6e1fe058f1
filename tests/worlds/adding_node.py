"""A ROS 2 node that has its sums made by a worker: ``python -m tests.worlds.adding_node FILE``, as a module of a robot.

It publishes numbers, and for each that arrives the sum as the worker says it; the latest sum goes into the file.
"""

from __future__ import annotations

import sys
from pathlib import Path

import rclpy
from std_msgs.msg import Float64

from robot_client.offload import cloud, decisions, offload


@offload("add", when=lambda device: True, fallback=False, version=1, timeout=30)
def add(a: float, b: float = 1.0) -> float:
    raise AssertionError("it must run on a worker")


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("adding")
    sums = node.create_publisher(Float64, "sums", 10)
    numbers = node.create_publisher(Float64, "numbers", 10)
    pending = Path(f"{sys.argv[1]}.pending")

    def on_number(message: Float64) -> None:
        sums.publish(Float64(data=add(message.data)))

    def on_sum(message: Float64) -> None:
        pending.write_text(f"{message.data} {decisions()[-1].where} {cloud.call('add', a=1, version=1)}")
        pending.rename(sys.argv[1])

    node.create_subscription(Float64, "numbers", on_number, 10)
    node.create_subscription(Float64, "sums", on_sum, 10)
    node.create_timer(0.5, lambda: numbers.publish(Float64(data=41.0)))
    rclpy.spin(node)


if __name__ == "__main__":
    main()
