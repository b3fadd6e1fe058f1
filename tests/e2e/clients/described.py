"""A ROS 2 node with the description of a robot, as robot_state_publisher has it. Argument: a file with URDF."""

import sys
from pathlib import Path

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

rclpy.init(args=[])
node = rclpy.create_node("robot_state_publisher")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
publisher = node.create_publisher(String, "/robot_description", latched)
publisher.publish(String(data=Path(sys.argv[1]).read_text()))
print("READY", flush=True)
rclpy.spin(node)
