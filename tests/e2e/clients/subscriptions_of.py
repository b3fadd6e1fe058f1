"""Prints the number of subscriptions of a topic in the ROS graph, once there is at least one. Argument: the
topic.
"""

import sys
import time

import rclpy

rclpy.init()
node = rclpy.create_node("counts_subscriptions")
until = time.monotonic() + 20
while not node.get_subscriptions_info_by_topic(sys.argv[1]) and time.monotonic() < until:
    time.sleep(0.05)
time.sleep(1.0)  # shows absence: further ones would have been discovered by now
print(len(node.get_subscriptions_info_by_topic(sys.argv[1])))
node.destroy_node()
rclpy.shutdown()
