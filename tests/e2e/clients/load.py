"""A ROS 2 node that publishes numbered messages on several topics at a high rate, once they have subscribers.

Arguments: seconds, messages per second on /load/small. Prints SUBSCRIBED when all topics have a subscriber,
then DONE with the numbers of published messages, as JSON. It runs on for late subscribers until it is ended.
"""

import json
import signal
import sys
import time

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

SECONDS, RATE = float(sys.argv[1]), float(sys.argv[2])
SMALL_BYTES, BIG_BYTES, BIG_RATE, UNSURE_RATE, BURST = 200, 20_000, 10.0, 50.0, 100

rclpy.init()
node = rclpy.create_node("publishes_much")
reliable = QoSProfile(depth=1000)
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
publishers = {
    "small": node.create_publisher(String, "/load/small", reliable),
    "big": node.create_publisher(String, "/load/big", reliable),
    "unsure": node.create_publisher(String, "/load/unsure", best_effort),
    "burst": node.create_publisher(String, "/load/burst", reliable),
    "latched": node.create_publisher(String, "/load/latched", latched),
}
sent = dict.fromkeys(publishers, 0)


def publish(name, size):
    publishers[name].publish(String(data=f"{sent[name]:09d} ".ljust(size, ".")))
    sent[name] += 1


publish("latched", SMALL_BYTES)
while not all(each.get_subscription_count() for name, each in publishers.items() if name != "latched"):
    time.sleep(0.05)
print("SUBSCRIBED", flush=True)

rates = {"small": (RATE, SMALL_BYTES), "big": (BIG_RATE, BIG_BYTES), "unsure": (UNSURE_RATE, SMALL_BYTES)}
begun = time.monotonic()
cpu = time.process_time()
while (passed := time.monotonic() - begun) < SECONDS:
    for name, (rate, size) in rates.items():
        # At most 10 ms worth of messages at once, so a delayed process catches up slowly.
        for _ in range(min(int(passed * rate) - sent[name], max(1, int(rate / 50)))):
            publish(name, size)
    time.sleep(0.002)
took = time.monotonic() - begun
cpu = time.process_time() - cpu
for _ in range(BURST):
    publish("burst", SMALL_BYTES)
print("DONE", json.dumps({**sent, "seconds": took, "cpu": cpu}), flush=True)
signal.pause()
