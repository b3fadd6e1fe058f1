"""The graph of the smoke test of Foxglove's bridge: topics, a service, and parameters of two nodes.

Prints READY, and a line ``HEARD text`` for each message on /some_topic and /other_topic.
"""

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import SetBool

PUBLISHERS = 15
LATCHED = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)


def answer(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
    response.success, response.message = request.data, "hello"
    return response


def received(message: String) -> None:
    print("HEARD", message.data, flush=True)


rclpy.init()
peer = rclpy.create_node("bridge_peer")
peer.create_publisher(String, "/pub_topic", LATCHED).publish(String(data="hello world"))
for number in range(PUBLISHERS):
    peer.create_publisher(String, "/latched", LATCHED).publish(String(data=f"hello {number}"))
peer.create_publisher(String, "/some_topic", 10)
for topic in ("/some_topic", "/other_topic"):
    peer.create_subscription(String, topic, received, 10)
peer.create_service(SetBool, "/foo_service", answer)

first = rclpy.create_node("node_1", allow_undeclared_parameters=True)
first.declare_parameter("string_param", "hello")
first.declare_parameter("deletable_param", True, ParameterDescriptor(dynamic_typing=True))
second = rclpy.create_node("node_2")
second.declare_parameter("int_array_param", [1, 2, 3])
second.declare_parameter("float_param", 1.123)
second.declare_parameter("float_array_param", [1.1, 2.2, 3.3])
second.declare_parameter("int_param", 123)

executor = SingleThreadedExecutor()
for node in (peer, first, second):
    executor.add_node(node)
print("READY", flush=True)
executor.spin()
