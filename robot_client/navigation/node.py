"""The ROS node of the navigator: Nav2's action, topics and names around :mod:`robot_client.navigation.navigator`."""

from __future__ import annotations

import time
from functools import partial
from typing import Any, NamedTuple

from geometry_msgs.msg import PoseStamped
from geometry_msgs.msg import Twist as TwistMessage
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import OccupancyGrid, Path
from rclpy.action import ActionClient, CancelResponse, GoalResponse
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, LaserScan
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from relay_protocol.errors import Invalid, Unavailable
from robot_client.navigation import messages
from robot_client.navigation.grid import Floats, Pose2D
from robot_client.navigation.navigator import TICK, Navigator, NavigatorSettings
from robot_client.navigation.outcome import ErrorCode, GoalEnd, NavigationOutcome
from robot_client.navigation.pursuit import STANDSTILL, DriveCommand
from robot_client.navigation.sensors import SHORTEST_DEPTH
from robot_client.navigation.transform_buffer import TransformBuffer
from robot_client.services.action_server import CallbackActionServer
from robot_client.services.health import Level, ServiceFinding
from robot_client.services.node_runner import LATCHED

FEEDBACK_EVERY, LOCAL_EVERY, GLOBAL_EVERY = 4, 4, 20
"""Ticks between two messages."""
LOCAL_SIDE = 4.0
"""Metres, of the local costmap."""
ZEROS = 5
"""Ticks for which zero is published after a goal, for subscribers that are allowed to miss one."""
STANDING_CELLS = 2_000_000
"""The robot stands while the costmap of a map of another size with more cells is computed: it takes 0.1 s and more."""

_STATIC = QoSProfile(depth=100, durability=LATCHED.durability)


class NavigatorTopics(NamedTuple):
    """Names in the graph.

    :ivar scan: of type LaserScan; empty: no scanner
    :ivar depth: of type Image (16UC1, 32FC1), level; empty: no depth camera
    :ivar depth_info: its CameraInfo
    :ivar shortest_depth: metres, its shortest range
    :ivar base_frame: the robot's coordinate frame
    """

    scan: str = "scan"
    depth: str = "camera/depth/image_rect_raw"
    depth_info: str = "camera/depth/camera_info"
    map: str = "map"
    base_frame: str = "base_link"
    shortest_depth: float = SHORTEST_DEPTH

    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors that are used."""
        return tuple(name for name, topic in (("scan", self.scan), ("depth", self.depth)) if topic)


class NavigatorNode:
    """Navigates, as a node.

    :param node: to create everything with
    """

    def __init__(self, node: Any, topics: NavigatorTopics, settings: NavigatorSettings) -> None:
        self._node = node
        self._topics = topics
        self._navigator = Navigator(settings)
        self._navigator.on_path = self._publish_path
        self._transforms = TransformBuffer()
        self._goal: Any = None
        """The handle of the goal under way."""
        self._sensor_subscriptions: list[Any] = []
        self._depth_info: CameraInfo | None = None
        self._map_problem = ""
        self._zeros = 0
        self._ticks = 0
        self._create_endpoints()
        node.create_timer(TICK, self._tick)

    def finding(self) -> ServiceFinding:
        """What it does."""
        if self._navigator.costmap is None:
            return ServiceFinding(Level.STALE, self._map_problem or f"waiting for {self._topics.map}")
        problem = self._map_problem or self._navigator.refused()
        if problem:
            return ServiceFinding(Level.ERROR, problem)
        progress = self._navigator.progress(time.monotonic())
        if progress is None:
            return ServiceFinding(Level.OK, "waiting for a goal")
        missing = self._navigator.missing(time.monotonic())
        if missing is not None:
            return ServiceFinding(Level.WARN, f"waiting: {missing}")
        values = {"distance_m": f"{progress.distance_left:.2f}", "recoveries": str(progress.recoveries)}
        return ServiceFinding(Level.OK, f"navigating: {self._navigator.state.value}", values)

    @property
    def busy(self) -> bool:
        """Whether a goal is under way."""
        return self._goal is not None

    def close(self) -> None:
        """Stand still before the process ends."""
        if self._goal is not None:
            self._publish_command(STANDSTILL)

    # --- graph ---------------------------------------------------------------------------------------------

    def _create_endpoints(self) -> None:
        node = self._node
        self._cmd_vel = node.create_publisher(TwistMessage, "cmd_vel", 10)
        self._plan = node.create_publisher(Path, "plan", 1)
        self._global = node.create_publisher(OccupancyGrid, "global_costmap/costmap", LATCHED)
        self._local = node.create_publisher(OccupancyGrid, "local_costmap/costmap", LATCHED)
        node.create_subscription(OccupancyGrid, self._topics.map, self._on_map, LATCHED)
        node.create_subscription(TFMessage, "tf", self._on_transforms, 100, raw=True)
        node.create_subscription(TFMessage, "tf_static", self._transforms.add_static, _STATIC)
        node.create_subscription(PoseStamped, "goal_pose", self._on_goal_pose, 1)
        self._server = CallbackActionServer(
            node,
            NavigateToPose,
            "navigate_to_pose",
            goal_callback=self._on_goal,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
        )
        self._client = ActionClient(node, NavigateToPose, "navigate_to_pose")

    # --- inputs --------------------------------------------------------------------------------------------

    def _on_map(self, message: OccupancyGrid) -> None:
        try:
            found = messages.read_map(message)
        except Invalid as error:
            self._map_problem = str(error)
            return
        self._map_problem = ""
        old = self._navigator.costmap
        resized = old is not None and found.geometry != old.geometry
        if self._goal is not None and resized and found.occupancy.size > STANDING_CELLS:
            self._publish_command(STANDSTILL)
        self._navigator.set_map(found)

    def _on_transforms(self, message: bytes) -> None:
        self._transforms.add(message, time.monotonic())

    def _locate(self) -> None:
        """Update the robot's pose; one that is not found again becomes too old."""
        try:
            found = self._transforms.locate(self._navigator.map_frame, self._topics.base_frame)
        except Unavailable as error:
            self._navigator.refuse_pose(str(error))
        else:
            self._navigator.set_pose(found.pose, found.odometry_at, found.localiser_at)

    def _to_map(self, header: Header) -> Floats:
        """:raises Unavailable: the frame is not connected with the map's"""
        return self._transforms.lookup(
            self._navigator.map_frame, header.frame_id, messages.seconds_of(header.stamp)
        )

    def _on_scan(self, message: LaserScan) -> None:
        try:
            view = messages.scan_view(message, self._to_map(message.header))
        except Unavailable as error:
            self._navigator.refuse("scan", str(error), time.monotonic())
        else:
            self._navigator.observe("scan", view, time.monotonic())

    def _on_depth(self, message: Image) -> None:
        try:
            if self._depth_info is None:
                raise Unavailable(f"there is no camera_info on {self._topics.depth_info} yet")
            view = messages.depth_view(
                message, self._depth_info, self._to_map(message.header), self._topics.shortest_depth
            )
        except (Invalid, Unavailable) as error:
            self._navigator.refuse("depth", str(error), time.monotonic())
        else:
            self._navigator.observe("depth", view, time.monotonic())

    def _on_depth_info(self, message: CameraInfo) -> None:
        self._depth_info = message

    def _use_sensors(self, use: bool) -> None:
        """Subscribe to the sensors, or end that: images cost time, also where they come from."""
        if not use:
            ended, self._sensor_subscriptions = self._sensor_subscriptions, []
            for each in ended:
                self._node.destroy_subscription(each)
        elif not self._sensor_subscriptions:
            topics, quality = self._topics, qos_profile_sensor_data
            wanted = [
                (LaserScan, topics.scan, self._on_scan),
                (CameraInfo, topics.depth_info if topics.depth else "", self._on_depth_info),
                (Image, topics.depth, self._on_depth),
            ]
            self._sensor_subscriptions = [
                self._node.create_subscription(kind, topic, on_message, quality)
                for kind, topic, on_message in wanted
                if topic
            ]

    # --- goals ---------------------------------------------------------------------------------------------

    def _on_goal(self, request: Any) -> GoalResponse:
        try:
            self._goal_of(request.pose)
        except Unavailable as error:
            self._node.get_logger().warning(f"goal rejected: {error}")
            return GoalResponse.REJECT
        if request.behavior_tree:
            self._node.get_logger().warning("goal rejected: this navigator has no behaviour trees")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _goal_of(self, pose: PoseStamped) -> Pose2D:
        """:raises Unavailable: the pose is invalid, or its frame is not connected with the map's"""
        if not self._navigator.map_frame:
            raise Unavailable(self._map_problem or f"there is no map on {self._topics.map} yet")
        frame = pose.header.frame_id or self._navigator.map_frame
        return messages.read_pose(pose, self._transforms.lookup(self._navigator.map_frame, frame))

    def _on_accepted(self, handle: Any) -> None:
        """Begin; a goal under way is aborted, as by Nav2."""
        self._end(NavigationOutcome(GoalEnd.ABORTED, ErrorCode.NONE, "another goal took its place"))
        self._goal = handle
        handle.execute()
        goal = self._goal_of(handle.request.pose)
        self._navigator.start(goal, time.monotonic())
        self._use_sensors(True)
        self._node.get_logger().info(f"navigating to ({goal.x:.2f}, {goal.y:.2f})")

    def _on_cancel(self, handle: Any) -> CancelResponse:
        """Stand still at once; the goal ends right after."""
        if self._goal is not None and handle.goal_id == self._goal.goal_id:
            self._end(NavigationOutcome(GoalEnd.CANCELED))
        return CancelResponse.ACCEPT

    def _end(self, outcome: NavigationOutcome) -> None:
        """End the goal under way, if there is one; zero is published before all else."""
        handle, self._goal = self._goal, None
        if handle is None:
            return
        self._publish_command(STANDSTILL)
        self._zeros = ZEROS
        self._navigator.cancel()
        self._server.finish(handle, partial(_ended, outcome))
        words = f": {outcome.message} ({outcome.code})" if outcome.message else ""
        self._node.get_logger().info(f"goal {outcome.end.value}{words}")

    def _on_goal_pose(self, pose: PoseStamped) -> None:
        """Give the goal to the action, as Nav2 does, so that it can be seen and cancelled there."""
        self._client.send_goal_async(NavigateToPose.Goal(pose=pose))

    # --- time ----------------------------------------------------------------------------------------------

    def _tick(self) -> None:
        self._ticks += 1
        if self._goal is not None:
            self._locate()
            command, outcome = self._navigator.tick(time.monotonic())
            if outcome is None:
                self._publish_command(command)
                if self._ticks % FEEDBACK_EVERY == 0:
                    self._publish_feedback()
            else:
                self._end(outcome)
        elif self._zeros:
            self._zeros -= 1
            self._publish_command(STANDSTILL)
        watched = self._local.get_subscription_count() + self._global.get_subscription_count()
        self._use_sensors(self._goal is not None or watched > 0)
        if watched:
            self._locate()
            self._publish_costmaps()

    def _publish_command(self, command: DriveCommand) -> None:
        self._cmd_vel.publish(messages.twist_message(command))

    def _publish_feedback(self) -> None:
        progress, pose = self._navigator.progress(time.monotonic()), self._navigator.pose
        if progress is not None and pose is not None:
            current = messages.pose_message(self._header(), pose)
            self._goal.publish_feedback(messages.feedback_message(progress, current))

    def _publish_path(self, path: Floats) -> None:
        self._plan.publish(messages.path_message(self._header(), path))

    def _publish_costmaps(self) -> None:
        costmap, pose = self._navigator.costmap, self._navigator.pose
        if costmap is None:
            return
        if self._ticks % GLOBAL_EVERY == 0 and self._global.get_subscription_count():
            self._global.publish(messages.grid_message(self._header(), costmap.geometry, costmap.costs))
        if self._ticks % LOCAL_EVERY == 0 and self._local.get_subscription_count() and pose is not None:
            geometry, costs = costmap.window(pose.x, pose.y, LOCAL_SIDE)
            self._local.publish(messages.grid_message(self._header(), geometry, costs))

    def _header(self) -> Header:
        return Header(stamp=self._node.get_clock().now().to_msg(), frame_id=self._navigator.map_frame)


def _ended(outcome: NavigationOutcome, handle: Any) -> Any:
    """Set the state of a goal; its result."""
    if outcome.end is GoalEnd.SUCCEEDED:
        handle.succeed()
    elif handle.is_cancel_requested:
        handle.canceled()
    else:
        handle.abort()
    return messages.result_message(outcome)
