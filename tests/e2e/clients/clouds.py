"""A ROS 2 node that publishes point clouds until it is killed. Arguments: pairs of topic and bytes."""

import array
import sys
import time

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2

rclpy.init()
node = rclpy.create_node("clouds")
profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
publishers = []
for topic, size in zip(sys.argv[1::2], sys.argv[2::2], strict=True):
    publisher = node.create_publisher(PointCloud2, topic, profile)
    cloud = PointCloud2(width=int(size) // 16, height=1, point_step=16, row_step=int(size))
    cloud.data = array.array("B", bytes(range(16)) * (int(size) // 16))
    publisher.publish(cloud)
    publishers.append(publisher)
print("READY", flush=True)
while True:
    time.sleep(1)
