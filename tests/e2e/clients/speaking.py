"""ROS 2 nodes that publish and subscribe by lines of JSON on stdin; they print received messages on stdout.

["publish", node, topic, {"depth": 1, "durability": "transient_local", …}, [texts]] ["subscribe", node, topic,
{…}] ["serve", node, service, {…}] ["end", node]
"""

import json
import sys
import threading

import rclpy
from geometry_msgs.msg import Twist
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSLivelinessPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
)
from std_msgs.msg import String
from std_srvs.srv import Trigger

TIMES = ("deadline", "lifespan", "liveliness_lease_duration")
WORDS = {
    "durability": QoSDurabilityPolicy,
    "reliability": QoSReliabilityPolicy,
    "liveliness": QoSLivelinessPolicy,
}

rclpy.init()
executor = SingleThreadedExecutor()
nodes: dict[str, Node] = {}
ends: dict[tuple[str, str], object] = {}
jobs: list[list[object]] = []
lock = threading.Lock()


def report(**what: object) -> None:
    with lock:
        print(json.dumps(what), flush=True)


def profile(options: dict[str, object]) -> QoSProfile:
    made = QoSProfile(depth=options.get("depth", 1))
    for name, value in options.items():
        if name in WORDS:
            setattr(made, name, WORDS[name][value.upper()])
        elif name in TIMES:
            setattr(made, name, Duration(nanoseconds=int(value * 1e9)))
    return made


def node(name: str) -> Node:
    if name not in nodes:
        nodes[name] = rclpy.create_node(name)
        executor.add_node(nodes[name])
    return nodes[name]


def publish(name: str, topic: str, options: dict[str, object], texts: list[str]) -> None:
    if (name, topic) not in ends:
        quiet = PublisherEventCallbacks(use_default_callbacks=False)
        ends[name, topic] = node(name).create_publisher(
            String, topic, profile(options), event_callbacks=quiet
        )
    for text in texts:
        ends[name, topic].publish(String(data=text))


def subscribe(name: str, topic: str, options: dict[str, object]) -> None:
    kind = Twist if options.get("kind") == "twist" else String

    def received(message: object) -> None:
        report(node=name, topic=topic, text=message.data if kind is String else str(message.linear.x))

    ends[name, topic] = node(name).create_subscription(
        kind,
        topic,
        received,
        profile(options),
        event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
    )


def serve(name: str, service: str, options: dict[str, object]) -> None:
    def answer(request: object, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = True, name
        return response

    ends[name, service] = node(name).create_service(Trigger, service, answer, qos_profile=profile(options))


def end(name: str) -> None:
    executor.remove_node(nodes[name])
    nodes.pop(name).destroy_node()
    for each in [each for each in ends if each[0] == name]:
        del ends[each]


def read() -> None:
    for line in sys.stdin:
        jobs.append(json.loads(line))
        executor.wake()
    jobs.append(["leave"])
    executor.wake()


threading.Thread(target=read, daemon=True).start()
report(ready=True)
while True:
    executor.spin_once(timeout_sec=0.05)
    while jobs:
        name, *arguments = jobs.pop(0)
        if name == "leave":
            executor.shutdown()
            rclpy.try_shutdown()
            sys.exit(0)
        globals()[name](*arguments)
        report(done=name)
