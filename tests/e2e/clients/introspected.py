"""A ROS 2 node with a service with introspection, an action and a hidden topic. It uses them until killed."""

import rclpy
from example_interfaces.action import Fibonacci
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import qos_profile_system_default
from rclpy.service_introspection import ServiceIntrospectionState
from std_msgs.msg import String
from std_srvs.srv import SetBool


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("introspected")

    def answer(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success, response.message = request.data, "done"
        return response

    def pursue(goal: object) -> Fibonacci.Result:
        goal.publish_feedback(Fibonacci.Feedback(sequence=[0, 1]))
        goal.succeed()
        return Fibonacci.Result(sequence=[0, 1, 1])

    service = node.create_service(SetBool, "/told", answer)
    service.configure_introspection(
        node.get_clock(), qos_profile_system_default, ServiceIntrospectionState.CONTENTS
    )
    _server = ActionServer(node, Fibonacci, "/counted", pursue)
    client, wanting = node.create_client(SetBool, "/told"), ActionClient(node, Fibonacci, "/counted")
    whisper = node.create_publisher(String, "/lab/_whisper", 1)

    def again() -> None:
        if client.service_is_ready():
            client.call_async(SetBool.Request(data=True))
        if wanting.server_is_ready():
            wanting.send_goal_async(Fibonacci.Goal(order=3))
        whisper.publish(String(data="psst"))

    node.create_timer(0.2, again)
    executor = MultiThreadedExecutor(2)
    executor.add_node(node)
    print("READY", flush=True)
    executor.spin()


main()
