"""A simulation's clock: publishes on /clock, from a time on and at its pace, until it is ended. Argument: seconds."""

import signal
import sys
import threading
import time

import rclpy
from rclpy.signals import SignalHandlerOptions
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

begin = int(sys.argv[1])
ended = threading.Event()
rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
signal.signal(signal.SIGTERM, lambda *_: ended.set())
node = rclpy.create_node("simulator_clock")
publisher = node.create_publisher(Clock, "/clock", 10)
started = time.monotonic()
print("READY", flush=True)
while not ended.wait(0.02):
    now = Time(nanoseconds=int((begin + time.monotonic() - started) * 1e9))
    publisher.publish(Clock(clock=now.to_msg()))
node.destroy_node()
rclpy.shutdown()
