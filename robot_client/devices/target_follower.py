"""A module that drives a list of targets through the action ``navigate_to_pose``, and announces arrivals.

Lists come as commands of the module, and as goals of Nav2's action FollowWaypoints.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

from robot_client.devices.ros_node import RosNode
from robot_client.devices.target_list import (
    ABORTED,
    CANCELED,
    OWN_GOAL,
    SUCCEEDED,
    DriveTarget,
    TargetList,
    parse_targets,
)
from robot_client.devices.text_template import check_template
from robot_client.platforms.ros2.graph import endpoint_ids

CHECK_SECONDS = 1.0
"""Seconds between two checks of the navigator, and between two attempts to cancel a goal."""

MISSING_CHECKS = 3
"""After so many checks without a navigator the list has ended."""

NANO = 1_000_000_000
_NOTHING_TO_CANCEL = (2, 3)
"""Return codes for an unknown goal and for one that has ended (action_msgs/srv/CancelGoal)."""
_ENDED = (SUCCEEDED, CANCELED, ABORTED)

ROUTE = 0
"""Stands for the sender of a list that came by the action; connections have higher numbers."""


class TargetFollower(RosNode):
    """Commands: ``{"go": [{"x": 1, "y": 2, "heading": 0, "name": "kitchen"}, …]}`` and ``{"cancel": true}``.

    Feedback: ``{"state": "driving", "target": "kitchen", "number": 1, "of": 2}``, ``arrived``, ``done``, and ``ended``
    with ``why``. A list ends when the robot is stopped, its client disconnects, or a target can't be reached. Targets
    are refused while the robot is stopped.

    :param action: of type nav2_msgs/action/NavigateToPose
    :param frame: of the targets
    :param announce: text that is published on the topic ``say`` at each arrival, also of goals from other clients;
        ``{name}`` stands for the target's name, ``{{`` and ``}}`` for brackets. Empty: none
    :param waypoints: name of an action nav2_msgs/action/FollowWaypoints that takes lists too, for robots without Nav2's
        own, as ``follow_waypoints``. Empty: none
    """

    node_name = "target_follower"

    def __init__(
        self,
        action: str = "navigate_to_pose",
        frame: str = "map",
        announce: str = "I have arrived at {name}.",
        waypoints: str = "",
        namespace: str = "",
    ) -> None:
        check_template("announce", announce, ["name"])
        self.namespace = namespace
        self._action = action
        self._frame = frame
        self._announce = announce
        self._waypoints = waypoints
        self._list = TargetList(self._drive, self._cancel_goal, self._report)
        self._route: Any = None
        """The handle of the goal with waypoints that is under way."""
        self._missing = 0
        self._servers: frozenset[bytes] = frozenset()
        """GIDs of the navigator when it was sent the goal under way."""
        self._names: dict[bytes, str] = {}
        """Names of own goals that may still end."""
        self._ended: set[bytes] = set()
        """Goals of the latest status that have ended."""
        self._left: set[bytes] = set()
        """Own goals that go on and should not."""

    def start(self) -> None:
        """Create the action's client."""
        from action_msgs.msg import GoalStatusArray
        from action_msgs.srv import CancelGoal
        from nav2_msgs.action import FollowWaypoints, NavigateToPose
        from rclpy.action import ActionClient
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from std_msgs.msg import String

        from robot_client.services.action_server import CallbackActionServer

        self._started = self.node.get_clock().now().nanoseconds
        self._client = ActionClient(self.node, NavigateToPose, self._action)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(
            GoalStatusArray, f"{self._action}/_action/status", self._on_status, latched
        )
        self._canceller = self.node.create_client(CancelGoal, f"{self._action}/_action/cancel_goal")
        self._say = self.node.create_publisher(String, "say", 10)
        self.node.create_timer(CHECK_SECONDS, self._check)
        if self._waypoints:
            self._routes = CallbackActionServer(
                self.node,
                FollowWaypoints,
                self._waypoints,
                goal_callback=self._on_route,
                handle_accepted_callback=self._on_route_accepted,
                cancel_callback=self._on_route_cancel,
            )

    def handle(self, command: Any) -> None:
        """Begin or end a list."""
        if not isinstance(command, dict) or len(command) != 1:
            raise ValueError("a command is {'go': [targets]} or {'cancel': true}")
        if command.get("cancel") is True:
            self._list.cancel("cancelled by a client")
            return
        targets = parse_targets(command.get("go"))
        self._check_ready()
        self._list.begin(targets, self.sender)

    def _check_ready(self) -> None:
        """:raises ValueError: the robot is stopped, or there is no navigator"""
        if self.stopped:
            raise ValueError("the robot is stopped; resume it before sending targets")
        if not self._client.server_is_ready():
            raise ValueError(f"there is no navigator: no node has the action {self._action}")

    def robot_stopped(self, stopped: bool) -> None:
        """End the list when the robot is stopped."""
        if stopped:
            self._list.cancel("the robot was stopped")

    def sender_left(self, sender: int) -> None:
        """End the list of this client."""
        self._list.sender_left(sender)

    def stop(self) -> None:
        """Cancel the goal under way."""
        self._list.cancel("the module was stopped")
        # Once the navigator has answered, nothing is left to cancel.
        for _ in range(10):
            if not self._left:
                break
            self._ros_executor.spin_once(timeout_sec=0.1)

    # --- waypoints -------------------------------------------------------------------------------------------

    def _targets_of(self, goal: Any) -> list[DriveTarget]:
        """:raises ValueError: the goal has no list that can be driven"""
        if goal.number_of_loops:
            raise ValueError("number_of_loops must be 0")
        frames = {each.header.frame_id for each in goal.poses} - {"", self._frame}
        if frames:
            raise ValueError(f"poses must be in the frame {self._frame}, not in {', '.join(sorted(frames))}")
        poses = [each.pose for each in goal.poses[goal.goal_index :]]
        return parse_targets(
            [
                {"x": each.position.x, "y": each.position.y, "heading": _heading(each.orientation)}
                for each in poses
            ]
        )

    def _on_route(self, goal: Any) -> Any:
        from rclpy.action import GoalResponse

        try:
            self._targets_of(goal)
            self._check_ready()
            self._list.check_free()
        except ValueError as error:
            print(f"waypoints refused: {error}", flush=True)
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _on_route_accepted(self, handle: Any) -> None:
        handle.execute()
        self._route = handle
        self._list.begin(self._targets_of(handle.request), ROUTE)

    def _on_route_cancel(self, handle: Any) -> Any:
        from rclpy.action import CancelResponse

        if self._route is not None and handle.goal_id == self._route.goal_id:
            self._list.cancel("cancelled by a client")
        return CancelResponse.ACCEPT

    def _report(self, change: dict[str, Any]) -> None:
        """A change of the list: feedback of the module, and of the action if the list came by it."""
        from nav2_msgs.action import FollowWaypoints

        self.feedback(change)
        if self._route is None:
            return
        if change["state"] == "driving":
            current = self._route.request.goal_index + change["number"] - 1
            self._route.publish_feedback(FollowWaypoints.Feedback(current_waypoint=current))
        elif change["state"] in ("done", "ended"):
            handle, self._route = self._route, None
            self._routes.finish(handle, partial(_route_result, change))

    # --- navigate_to_pose ------------------------------------------------------------------------------------

    def _drive(self, id: bytes, target: DriveTarget) -> None:
        from nav2_msgs.action import NavigateToPose
        from unique_identifier_msgs.msg import UUID

        goal = NavigateToPose.Goal()
        goal.pose.header.frame_id = self._frame
        goal.pose.header.stamp = self.node.get_clock().now().to_msg()
        pose = goal.pose.pose
        pose.position.x, pose.position.y = target.x, target.y
        pose.orientation.z, pose.orientation.w = math.sin(target.heading / 2), math.cos(target.heading / 2)
        self._names[id] = target.name
        self._servers, self._missing = self._find_servers(), 0
        sent = self._client.send_goal_async(goal, goal_uuid=UUID(uuid=list(id)))
        sent.add_done_callback(partial(self._answered, id))

    def _answered(self, id: bytes, sent: Any) -> None:
        """The navigator has answered; if the list has ended meanwhile, the goal is cancelled once more."""
        if not sent.result().accepted:
            self._names.pop(id, None)
            self._left.discard(id)
            self._list.refused(id, "the navigator has refused it")
        elif id != self._list.goal:
            self._cancel_goal(id)

    def _cancel_goal(self, id: bytes) -> None:
        """Cancel a goal; :meth:`_check` repeats it until the goal has ended."""
        from action_msgs.srv import CancelGoal

        self._left.add(id)
        request = CancelGoal.Request()
        request.goal_info.goal_id.uuid = list(id)
        answer = self._canceller.call_async(request)
        answer.add_done_callback(partial(self._cancel_answered, id))

    def _cancel_answered(self, id: bytes, answer: Any) -> None:
        if answer.result().return_code in _NOTHING_TO_CANCEL:
            self._left.discard(id)

    def _on_status(self, message: Any) -> None:
        ended = set()
        for each in message.status_list:
            id = bytes(each.goal_info.goal_id.uuid)
            if each.status in _ENDED:
                ended.add(id)
                if id not in self._ended:
                    self._goal_ended(id, each.status, each.goal_info.stamp)
            elif id.startswith(OWN_GOAL) and id != self._list.goal and id not in self._left:
                # An earlier run of this module has sent it.
                self._cancel_goal(id)
        self._ended = ended

    def _goal_ended(self, id: bytes, status: int, stamp: Any) -> None:
        name = self._names.pop(id, "the target")
        self._left.discard(id)
        if status == SUCCEEDED and stamp.sec * NANO + stamp.nanosec >= self._started:
            self._say_arrival(name)
        self._list.goal_ended(id, status)

    def _say_arrival(self, name: str) -> None:
        from std_msgs.msg import String

        if self._announce:
            self._say.publish(String(data=self._announce.format(name=name)))

    def _check(self) -> None:
        for id in list(self._left):
            self._cancel_goal(id)
        # A navigator that was started again does not know the goal.
        servers = self._find_servers()
        there = self._servers & servers if self._servers else servers
        self._missing = 0 if there else self._missing + 1
        if self._missing >= MISSING_CHECKS:
            self._left.clear()
            self._names.clear()
            if self._list.goal is not None:
                self._list.refused(self._list.goal, "the navigator has left")

    def _find_servers(self) -> frozenset[bytes]:
        return endpoint_ids(self.node.get_publishers_info_by_topic(f"{self._action}/_action/status"))


def _heading(orientation: Any) -> float:
    """The rotation about the vertical axis, radians."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _route_result(change: dict[str, Any], handle: Any) -> Any:
    """Set the state of a goal with waypoints; its result.

    :param change: the last one of the list
    """
    from nav2_msgs.action import FollowWaypoints
    from nav2_msgs.msg import MissedWaypoint

    result, request = FollowWaypoints.Result(), handle.request
    if change["state"] == "done":
        handle.succeed()
        return result
    if handle.is_cancel_requested:
        handle.canceled()
    else:
        handle.abort()
    result.error_code = FollowWaypoints.Result.TASK_EXECUTOR_FAILED
    if hasattr(result, "error_msg"):  # not in every release of Nav2 for Jazzy
        result.error_msg = change["why"]
    first = request.goal_index + change["number"] - 1
    result.missed_waypoints = [
        MissedWaypoint(index=index, goal=request.poses[index], error_code=result.error_code)
        for index in range(first, len(request.poses))
    ]
    return result
