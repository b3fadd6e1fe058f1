"""A ROS 2 node that publishes a point cloud ten times a second until it is killed. Arguments: topic and
number of points.

All points are in one cube of a grid.
"""

import array
import sys
import time

import rclpy
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2, PointField

topic, points = sys.argv[1], int(sys.argv[2])
rclpy.init()
publisher = rclpy.create_node("lidar").create_publisher(PointCloud2, topic, QoSProfile(depth=1))
cloud = PointCloud2(width=points, height=1, point_step=16, row_step=16 * points)
cloud.fields = [
    PointField(name=name, offset=4 * number, datatype=PointField.FLOAT32, count=1)
    for number, name in enumerate("xyz")
]
cloud.data = array.array("f", [0.01, 0.02, 0.03, 0.0] * points).tobytes()
print("READY", flush=True)
while True:
    publisher.publish(cloud)
    time.sleep(0.1)
