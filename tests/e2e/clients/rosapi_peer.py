"""Two ROS 2 nodes: parameters, topics, services and actions of types unknown to any relay. Names of the
second are denied.

They run until they are killed.
"""

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.action import ActionServer
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import Trigger
from switchboard_test_interfaces.action import Everything as EverythingAction
from switchboard_test_interfaces.msg import Nested, Primitives
from switchboard_test_interfaces.srv import Everything as EverythingService

PARAMETERS = {
    "flag": True,
    "count": 3,
    "speed": 0.5,
    "title": "Grüße",
    "raw": [b"\x01", b"\xff"],
    "flags": [True, False],
    "counts": [1, 2],
    "speeds": [0.5, 1.5],
    "titles": ["a", "b"],
    "limits.low": 1,
}


def main() -> None:
    rclpy.init()
    arm, safe = (
        rclpy.create_node(name, namespace=space) for space, name in (("/lab", "arm"), ("/vault", "safe"))
    )
    for name, value in PARAMETERS.items():
        arm.declare_parameter(name, value)
    arm.declare_parameter("fixed", 7, ParameterDescriptor(read_only=True))
    arm.declare_parameter("loose", "x", ParameterDescriptor(dynamic_typing=True))
    safe.declare_parameter("code", 1234)
    kept = [
        arm.create_publisher(Nested, "/lab/nested", 1),
        arm.create_subscription(Primitives, "/lab/in", lambda message: None, 1),
        arm.create_service(EverythingService, "/lab/everything", lambda request, response: response),
        ActionServer(arm, EverythingAction, "/lab/walk", lambda goal: EverythingAction.Result()),
        safe.create_publisher(Nested, "/vault/gold", 1),
        safe.create_service(Trigger, "/vault/open", lambda request, response: response),
        ActionServer(safe, EverythingAction, "/vault/dig", lambda goal: EverythingAction.Result()),
    ]
    executor = SingleThreadedExecutor()
    for node in (arm, safe):
        executor.add_node(node)
    print("READY", len(kept), flush=True)
    executor.spin()


main()
