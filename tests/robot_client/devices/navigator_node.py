"""A node with the action navigate_to_pose, as a process: goals at x = 0 arrive at once, others when they are
cancelled.

A goal at x = 99 is refused, one at x = 98 is aborted.
"""

from __future__ import annotations

import threading
import time
from typing import Any

import rclpy
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from robot_client.platforms.ros2.transport import without_shared_memory


def execute(goal: Any) -> Any:
    x = goal.request.pose.pose.position.x
    print(f"drives to {x:g} in {goal.request.pose.header.frame_id}", flush=True)
    while x not in (0.0, 98.0) and not goal.is_cancel_requested:
        time.sleep(0.02)
    if goal.is_cancel_requested:
        print("cancelled", flush=True)
        goal.canceled()
    elif x == 98.0:
        goal.abort()
    else:
        goal.succeed()
    return NavigateToPose.Result()


def main() -> None:
    with without_shared_memory(rclpy.get_rmw_implementation_identifier()):
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node("navigator")
    server = ActionServer(
        node,
        NavigateToPose,
        "navigate_to_pose",
        execute,
        goal_callback=lambda goal: (
            GoalResponse.REJECT if goal.pose.pose.position.x == 99 else GoalResponse.ACCEPT
        ),
        cancel_callback=lambda goal: CancelResponse.ACCEPT,
        callback_group=ReentrantCallbackGroup(),
    )
    executor = MultiThreadedExecutor(4)
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    print("READY", flush=True)
    threading.Event().wait()
    server.destroy()


if __name__ == "__main__":
    main()
