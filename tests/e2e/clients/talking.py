"""A ROS 2 node that publishes on a topic until it is ended. Arguments: topic, type, `reliable` or `latched`."""

import importlib
import signal
import sys
import time

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions

topic, name, qos = sys.argv[1:]
package, _, type_name = name.split("/")
kind = getattr(importlib.import_module(f"{package}.msg"), type_name)
profile = QoSProfile(depth=1)
if qos == "latched":
    profile.durability = DurabilityPolicy.TRANSIENT_LOCAL

stop = False


def end(*_: object) -> None:
    """Leaves the loop, so that the graph learns of the end at once."""
    global stop
    stop = True


rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
signal.signal(signal.SIGTERM, end)
node = rclpy.create_node("talks_" + type_name.lower())
publisher = node.create_publisher(kind, topic, profile)
publisher.publish(kind())
print("READY", flush=True)
while not stop:
    if qos != "latched":
        publisher.publish(kind())
    time.sleep(0.05)
node.destroy_node()
rclpy.shutdown()
