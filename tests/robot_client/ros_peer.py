"""A ROS 2 node for tests, in a process of its own: publishes, serves, records; told what to do by lines on stdin."""

from __future__ import annotations

import json
import os
import sys
import threading
import time

import rclpy
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import BatteryState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

LATCHED = QoSProfile(
    depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE
)
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)

node = None
ends: dict[str, object] = {}


def tell(**what: object) -> None:
    sys.stdout.write(json.dumps({"at": time.monotonic_ns(), **what}) + "\n")
    sys.stdout.flush()


def invert(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
    response.success = not request.data
    response.message = "inverted"
    return response


def slow(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
    time.sleep(4.0)
    return response


def advertise(topic: str, qos: str = "reliable") -> None:
    profile = {"latched": LATCHED, "best_effort": BEST_EFFORT, "reliable": QoSProfile(depth=10)}[qos]
    ends[topic] = node.create_publisher(String, topic, profile)


def publish(topic: str, text: str) -> None:
    ends[topic].publish(String(data=text))


def unadvertise(topic: str) -> None:
    node.destroy_publisher(ends.pop(topic))


def serve(service: str, kind: str) -> None:
    type, function = {"invert": (SetBool, invert), "slow": (Trigger, slow)}[kind]
    ends[service] = node.create_service(type, service, function, callback_group=ReentrantCallbackGroup())


def unserve(service: str) -> None:
    node.destroy_service(ends.pop(service))


def listen(topic: str, kind: str) -> None:
    def twist(message: Twist) -> None:
        tell(topic=topic, x=message.linear.x, z=message.angular.z)

    def stamped(message: TwistStamped) -> None:
        tell(topic=topic, x=message.twist.linear.x, stamp=message.header.stamp.sec)

    def string(message: String) -> None:
        tell(topic=topic, text=message.data)

    type, function = {
        "twist": (Twist, twist),
        "stamped": (TwistStamped, stamped),
        "string": (String, string),
    }[kind]
    ends["<" + topic] = node.create_subscription(type, topic, function, 10)


def publishers(topic: str) -> None:
    tell(publishers=[each.node_name for each in node.get_publishers_info_by_topic(topic)])


def battery(topic: str, charge: float) -> None:
    publisher = ends[topic] = node.create_publisher(BatteryState, topic, 1)
    node.create_timer(0.1, lambda: publisher.publish(BatteryState(percentage=charge)))


def main() -> None:
    global node
    rclpy.init()
    node = rclpy.create_node("peer", namespace="/robot")
    executor = MultiThreadedExecutor(4)
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    tell(ready=True)
    for line in sys.stdin:
        name, *arguments = json.loads(line)
        globals()[name](*arguments)
        tell(done=name)
    os._exit(0)


main()
