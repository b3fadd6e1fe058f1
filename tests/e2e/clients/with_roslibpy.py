"""An unmodified roslibpy user: lists, subscribes, drives, calls. Prints its results as JSON.

Arguments: websocket URL, access token.
"""

import json
import sys
import threading
import time

import roslibpy

STROKE, PAUSE = 2.0, 1.0
url, token = sys.argv[1:]
ros = roslibpy.Ros(host=url, headers={"Authorization": f"Bearer {token}"})
ros.run(timeout=20)

seen = {"topics": ros.get_topics(), "services": ros.get_services(), "scan_type": ros.get_topic_type("/scan")}
scanned = threading.Event()
first_odom = threading.Event()
moved = threading.Event()
poses = []


def on_scan(message):
    seen["rays"] = len(message["ranges"])
    scanned.set()


def on_odom(message):
    poses.append(message["pose"]["pose"]["position"]["x"])
    first_odom.set()
    if abs(poses[-1] - poses[0]) > 0.05:
        moved.set()


scan = roslibpy.Topic(ros, "/scan", "sensor_msgs/LaserScan")
odom = roslibpy.Topic(ros, "/odom", "nav_msgs/Odometry")
scan.subscribe(on_scan)
odom.subscribe(on_odom)
seen["scanned"] = scanned.wait(20)
seen["odom"] = first_odom.wait(20)

command = roslibpy.Topic(ros, "/cmd_vel", "geometry_msgs/Twist")
begun = time.monotonic()
while not moved.is_set() and time.monotonic() < begun + 60:
    # Commands that began under another controller, or were late, are refused until a pause.
    if (time.monotonic() - begun) % (STROKE + PAUSE) < STROKE:
        command.publish(roslibpy.Message({"linear": {"x": 0.3}}))
    moved.wait(0.1)
command.publish(roslibpy.Message({}))
seen["moved"] = moved.is_set()

reset = roslibpy.Service(ros, "/reset", "std_srvs/Trigger")
seen["reset"] = dict(reset.call(roslibpy.ServiceRequest(), timeout=20))
scan.unsubscribe()
odom.unsubscribe()
command.unadvertise()
ros.terminate()
print(json.dumps(seen))
