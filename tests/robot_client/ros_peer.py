"""A ROS 2 node for tests, in its own process: publishes, serves, records, by commands on stdin."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
import traceback

import rclpy
from builtin_interfaces.msg import Time
from example_interfaces.action import Fibonacci
from example_interfaces.srv import AddTwoInts
from fixture_node import Pursuer
from geometry_msgs.msg import Twist, TwistStamped
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, Joy
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

LATCHED = QoSProfile(
    depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE
)
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)

node = None
ends: dict[str, object] = {}
relenting: set[str] = set()
"""Stubborn actions that cancel their goals after all."""


def tell(**what: object) -> None:
    sys.stdout.write(json.dumps({"at": time.monotonic_ns(), **what}) + "\n")
    sys.stdout.flush()


def invert(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
    tell(inverted=request.data)
    response.success = not request.data
    response.message = "inverted"
    return response


def slow(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
    time.sleep(4.0)  # longer than its caller waits
    return response


def hello(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
    response.success, response.message = True, "Hello, world!"
    return response


def hello_late(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
    time.sleep(0.4)  # longer than a caller with a short timeout waits
    return hello(request, response)


def advertise(topic: str, qos: str = "reliable") -> None:
    profile = {"latched": LATCHED, "best_effort": BEST_EFFORT, "reliable": QoSProfile(depth=10)}[qos]
    ends[topic] = node.create_publisher(String, topic, profile)


def publish(topic: str, text: str) -> None:
    ends[topic].publish(String(data=text))


def unadvertise(topic: str) -> None:
    node.destroy_publisher(ends.pop(topic))


def serve(service: str, kind: str) -> None:
    type, function = {
        "hello": (SetBool, hello),
        "hello_late": (SetBool, hello_late),
        "invert": (SetBool, invert),
        "slow": (Trigger, slow),
    }[kind]
    ends[service] = node.create_service(type, service, function, callback_group=ReentrantCallbackGroup())


def unserve(service: str) -> None:
    node.destroy_service(ends.pop(service))


def listen(topic: str, kind: str) -> None:
    def twist(message: Twist) -> None:
        tell(topic=topic, x=message.linear.x, z=message.angular.z)

    def stamped(message: TwistStamped) -> None:
        tell(topic=topic, x=message.twist.linear.x, stamp=message.header.stamp.sec)

    def joy(message: Joy) -> None:
        tell(topic=topic, axes=list(message.axes), buttons=list(message.buttons))

    def string(message: String) -> None:
        tell(topic=topic, text=message.data)

    type, function = {
        "twist": (Twist, twist),
        "stamped": (TwistStamped, stamped),
        "joy": (Joy, joy),
        "string": (String, string),
    }[kind]
    ends["<" + topic] = node.create_subscription(type, topic, function, 10)


def call(service: str, a: int, b: int) -> None:
    """Requests a sum; reports the answer."""
    client = ends.setdefault("call " + service, node.create_client(AddTwoInts, service))
    assert client.wait_for_service(20)
    future = client.call_async(AddTwoInts.Request(a=a, b=b))
    future.add_done_callback(lambda future: tell(answer=service, a=a, sum=future.result().sum))


def switch(service: str, data: bool) -> None:
    """Calls a service of the type SetBool; reports the answer."""
    client = ends.setdefault("switch " + service, node.create_client(SetBool, service))
    assert client.wait_for_service(20)

    def answered(future: object) -> None:
        answer = future.result()
        tell(switched=service, data=data, success=answer.success, message=answer.message)

    client.call_async(SetBool.Request(data=data)).add_done_callback(answered)


def act(action: str, kind: str) -> None:
    """Serves Fibonacci; ``kind`` determines the results of goals."""

    def count(goal: object) -> Fibonacci.Result:
        tell(began=action, order=goal.request.order)
        sequence = [0, 1]
        while len(sequence) < goal.request.order:
            sequence.append(sequence[-1] + sequence[-2])
            goal.publish_feedback(Fibonacci.Feedback(sequence=sequence))
        canceled = kind.endswith("forever")
        if kind == "abort":
            goal.abort()
        elif canceled:
            while not goal.is_cancel_requested:
                time.sleep(0.02)  # the pace of its feedback
                goal.publish_feedback(Fibonacci.Feedback(sequence=sequence))
            goal.canceled()
        else:
            goal.succeed()
        tell(ended=action, canceled=canceled)
        return Fibonacci.Result(sequence=sequence)

    def judge(goal: object) -> GoalResponse:
        if kind.startswith("late"):
            tell(thinks=action)
            time.sleep(1.0)  # a server that delays the acceptance of a goal
        return GoalResponse.REJECT if kind == "reject" else GoalResponse.ACCEPT

    def wished(goal: object) -> CancelResponse:
        refuses = kind.startswith("stubborn") and action not in relenting
        tell(wished=action, refused=refuses)
        return CancelResponse.REJECT if refuses else CancelResponse.ACCEPT

    ends[action] = ActionServer(
        node,
        Fibonacci,
        action,
        count,
        goal_callback=judge,
        cancel_callback=wished,
        callback_group=ReentrantCallbackGroup(),
    )


def relent(action: str) -> None:
    """Cancels goals from now on."""
    relenting.add(action)


def unact(action: str) -> None:
    ends.pop(action).destroy()


def send(action: str, order: int) -> None:
    """Sends a goal; reports all its events."""
    client = ends.setdefault("send " + action, Pursuer(node, Fibonacci, action))
    assert client.wait_for_server(20)
    future = client.send_goal_async(
        Fibonacci.Goal(order=order),
        feedback_callback=lambda message: tell(feedback=action, sequence=list(message.feedback.sequence)),
    )

    def taken(future: object) -> None:
        handle = ends["goal " + action] = future.result()
        tell(taken=action, accepted=handle.accepted)
        if handle.accepted:
            handle.get_result_async().add_done_callback(done)

    def done(future: object) -> None:
        tell(
            result=action,
            order=order,
            status=future.result().status,
            sequence=list(future.result().result.sequence),
        )

    future.add_done_callback(taken)


def cancel(action: str) -> None:
    ends["goal " + action].cancel_goal_async()


def publishers(topic: str) -> None:
    tell(publishers=[each.node_name for each in node.get_publishers_info_by_topic(topic)])


def clock(seconds: float) -> None:
    """Publishes simulated time once."""
    publisher = ends.setdefault("/clock", node.create_publisher(Clock, "/clock", 1))
    now = Time(sec=int(seconds), nanosec=round(seconds % 1 * 1e9))
    publisher.publish(Clock(clock=now))


def declare(parameter: str, value: object) -> None:
    """Declares a parameter that may be deleted."""
    node.declare_parameter(parameter, value, ParameterDescriptor(dynamic_typing=True))


def battery(topic: str, charge: float) -> None:
    publisher = ends[topic] = node.create_publisher(BatteryState, topic, 1)
    node.create_timer(0.1, lambda: publisher.publish(BatteryState(percentage=charge)))


def spin(executor: MultiThreadedExecutor) -> None:
    """Spins forever: rclpy stops at an error of one callback, such as a destroyed handle (rclpy #1355)."""
    while rclpy.ok():
        try:
            executor.spin()
        except Exception:
            traceback.print_exc()


def main() -> None:
    global node
    rclpy.init()
    node = rclpy.create_node("peer", namespace="/robot")
    executor = MultiThreadedExecutor(12)  # an active goal has one
    executor.add_node(node)
    threading.Thread(target=spin, args=(executor,), daemon=True).start()
    tell(ready=True)
    for line in sys.stdin:
        name, *arguments = json.loads(line)
        globals()[name](*arguments)
        tell(done=name)
    os._exit(0)


main()
