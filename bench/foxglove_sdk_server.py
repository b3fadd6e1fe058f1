"""The server of PyPI's foxglove-sdk beside the robot: subscribes raw, and logs what it gets. Started as a process.

Arguments: a port, and JSON with the type of each topic. Prints READY. Messages of ROS 2 go out unconverted, as from
Foxglove's own bridge, which is not on the package index.
"""

from __future__ import annotations

import importlib
import json
import sys
from typing import Any

import foxglove
import rclpy
from foxglove import Channel, Schema
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions


def message_class(kind: str) -> Any:
    """The class of a type, such as ``sensor_msgs/msg/Image``."""
    package, _, name = kind.partition("/msg/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def main() -> None:
    """Serve until SIGTERM."""
    port, topics = int(sys.argv[1]), json.loads(sys.argv[2])
    foxglove.start_server(name="bench", host="127.0.0.1", port=port)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("foxglove_sdk_server")
    for topic, kind in topics.items():
        # Its text is not looked at by these receivers.
        schema = Schema(name=kind, encoding="ros2msg", data=b"# not needed\n")
        channel = Channel(topic, schema=schema, message_encoding="cdr")
        node.create_subscription(message_class(kind), topic, channel.log, QoSProfile(depth=10), raw=True)
    print("READY", flush=True)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
