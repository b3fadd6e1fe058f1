"""A ROS 2 node with services and actions, as server and client, with every kind of field. Prints its events
as JSON lines.

Arguments: its task: ``serve`` (until it is killed), ``call`` a service, or ``send`` a goal; a name.
"""

import json
import sys
import time

import rclpy
from builtin_interfaces.msg import Time
from rclpy.action import ActionClient, ActionServer
from switchboard_test_interfaces.action import Everything as EverythingAction
from switchboard_test_interfaces.msg import Nested, Primitives, Sequences
from switchboard_test_interfaces.srv import Everything as EverythingService

PRIMITIVES = {
    "flag": False, "raw": b"\x07", "letter": 90, "single": 0.5, "precise": -1e300, "tiny": -128, "small": 255,
    "modest": -32768, "port": 65535, "whole": -(2**31), "count": 2**32 - 1, "far": -(2**63), "vast": 2**64 - 1,
    "text": "Grüße 🤖", "wide": "weit 🛰", "brief": "kurz", "wide_brief": "ß",
}  # fmt: skip


def nested() -> Nested:
    message = Nested(primitives=Primitives(**PRIMITIVES), last=9)
    message.header.frame_id = "map"
    message.header.stamp = Time(sec=7, nanosec=8)
    message.times = [Time(sec=1), Time(sec=2)]
    message.sequences = [Sequences(texts=["a", ""], doubles=[0.1], flags=[True, False])]
    return message


def report(**what: object) -> None:
    print(json.dumps(what), flush=True)


def serve(node: object, name: str) -> None:
    def answer(request: EverythingService.Request, response: EverythingService.Response) -> object:
        response.response = request.request
        response.answers = [True, False]
        return response

    def pursue(goal: object) -> EverythingAction.Result:
        while not node.count_subscribers(f"{name}/_action/feedback"):
            time.sleep(0.01)  # the client may not be discovered yet; earlier messages are lost
        for step in range(goal.request.steps):
            goal.publish_feedback(EverythingAction.Feedback(step=step, feedback=goal.request.goal))
        goal.succeed()
        return EverythingAction.Result(result=goal.request.goal, path=[0.5, 1.5])

    _ = (
        node.create_service(EverythingService, name, answer),
        ActionServer(node, EverythingAction, name, pursue),
    )
    report(ready=True)
    rclpy.spin(node)


def call(node: object, name: str) -> None:
    client = node.create_client(EverythingService, name)
    assert client.wait_for_service(20)
    request = EverythingService.Request(request=nested(), words=["one", "two"])
    future = client.call_async(request)
    rclpy.spin_until_future_complete(node, future, timeout_sec=20)
    response = future.result()
    same = response.response == request.request
    report(same=same, answers=list(response.answers))


def send(node: object, name: str) -> None:
    client = ActionClient(node, EverythingAction, name)
    assert client.wait_for_server(20)
    goal = EverythingAction.Goal(steps=2, goal=nested())
    seen = []
    future = client.send_goal_async(goal, feedback_callback=lambda each: seen.append(each.feedback))
    rclpy.spin_until_future_complete(node, future, timeout_sec=20)
    # rclpy reports no feedback after the result, and accepts one of each at a time.
    until = time.monotonic() + 20
    while len(seen) < goal.steps and time.monotonic() < until:
        rclpy.spin_once(node, timeout_sec=0.1)
    done = future.result().get_result_async()
    rclpy.spin_until_future_complete(node, done, timeout_sec=20)
    result = done.result()
    report(
        status=result.status,
        same=result.result.result == goal.goal,
        path=list(result.result.path),
        steps=[each.step for each in seen],
        feedback_same=all(each.feedback == goal.goal for each in seen),
    )


def main() -> None:
    what, name = sys.argv[1:]
    rclpy.init()
    node = rclpy.create_node(f"everything_{what}")
    {"serve": serve, "call": call, "send": send}[what](node, name)


main()
