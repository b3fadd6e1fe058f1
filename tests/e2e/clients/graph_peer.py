"""A ROS 2 node that publishes on topics until it is ended. Arguments: its name, then TOPIC=TYPE of each topic."""

import importlib
import signal
import sys
import threading

import rclpy
from rclpy.signals import SignalHandlerOptions

name, *topics = sys.argv[1:]
ended = threading.Event()
rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
signal.signal(signal.SIGTERM, lambda *_: ended.set())
node = rclpy.create_node(name)
publishers = []
for each in topics:
    topic, _, type_name = each.partition("=")
    package, _, kind = type_name.split("/")
    message = getattr(importlib.import_module(f"{package}.msg"), kind)
    publishers.append((node.create_publisher(message, topic, 1), message()))
print("READY", flush=True)
while not ended.wait(0.05):
    for publisher, message in publishers:
        publisher.publish(message)
# So the graph learns of the end at once.
node.destroy_node()
rclpy.shutdown()
