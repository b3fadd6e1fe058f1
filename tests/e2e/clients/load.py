"""A ROS 2 node that publishes numbered messages on several topics, once they have subscribers.

Arguments: least messages on /load/small, most of them per second, a window, and a folder. Its file ``taken`` has
the number of the last one that a client has received; the node is at most the window ahead. It continues until
there is a file ``enough``. Prints SUBSCRIBED when all topics have a subscriber, then DONE with the numbers of published
messages, as JSON. It runs on for late subscribers until it is ended.
"""

import json
import signal
import sys
import time
from pathlib import Path

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

LEAST, RATE, WINDOW, FOLDER = int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])
SMALL_BYTES, BIG_BYTES, BURST = 200, 20_000, 100
SMALL_PER_BIG, SMALL_PER_UNSURE = 100, 20
PATIENCE = 1.0
"""Seconds without progress of the client after which one more message is published: it may have missed the first."""

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


def taken():
    """The number of the last message that a client has received."""
    try:
        return int((FOLDER / "taken").read_bytes() or b"0")
    except FileNotFoundError:
        return 0


begun = moved = time.monotonic()
last = 0
while sent["small"] < LEAST or not (FOLDER / "enough").exists():
    if (now_taken := taken()) != last:
        last, moved = now_taken, time.monotonic()
    due = min(int((time.monotonic() - begun) * RATE), last + WINDOW)
    if time.monotonic() - moved > PATIENCE:
        due, moved = sent["small"] + 1, time.monotonic()
    # At most 20 ms worth of messages at once, so a delayed process catches up slowly.
    for _ in range(min(due - sent["small"], max(1, int(RATE / 50)))):
        publish("small", SMALL_BYTES)
        if sent["small"] % SMALL_PER_BIG == 0:
            publish("big", BIG_BYTES)
        if sent["small"] % SMALL_PER_UNSURE == 0:
            publish("unsure", SMALL_BYTES)
    time.sleep(0.002)
for _ in range(BURST):
    publish("burst", SMALL_BYTES)
print("DONE", json.dumps(sent), flush=True)
signal.pause()
