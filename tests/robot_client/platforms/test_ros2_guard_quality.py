"""The guard's publishers, in a real graph: its stops reach every subscriber."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import time
import rclpy
from geometry_msgs.msg import Twist
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from robot_client.motion.guard import PUBLISHERS, RosStopOutputs
from robot_client.motion.typed_topic import TypedTopic

outputs = RosStopOutputs("switchboard_guard_test", False)
on = TypedTopic("/cmd_vel", "geometry_msgs/msg/Twist")
context = rclpy.Context()
rclpy.init(context=context)
base = rclpy.create_node("base", context=context)


def wait(true):
    until = time.monotonic() + 60
    while not true():
        assert time.monotonic() < until
        time.sleep(0.01)


def stopped(subscription):
    return lambda: outputs.zero(on, b"") and subscription.handle.take_message(Twist, False)


plain = base.create_subscription(Twist, "/cmd_vel", print, 1)
outputs.open(on)
wait(lambda: outputs.is_matched(on))
wait(stopped(plain))
strict = base.create_subscription(Twist, "/cmd_vel", print, QoSProfile(depth=1, deadline=Duration(seconds=1)))
wait(stopped(strict))
wait(stopped(plain))
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
base.create_subscription(Twist, "/cmd_vel", print, latched)
wait(lambda: base.count_subscribers("/cmd_vel") == 3)
for _ in range(20):
    outputs.zero(on, b"")
print(len(outputs._publishers[on]), len(outputs._publishers[on]) < PUBLISHERS)
outputs.close(on)
wait(lambda: base.count_publishers("/cmd_vel") == 0)
base.destroy_node()
rclpy.shutdown(context=context)
rclpy.shutdown()
"""


def test_stops_reach_a_subscriber_with_a_deadline(environment: dict[str, str]) -> None:
    """Also one that came after the guard was ready; one that wants commands kept gets none, and costs no publishers."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=environment,
        capture_output=True,
        text=True,
        timeout=200,
        check=True,
    )
    assert done.stdout.split() == ["2", "True"]
